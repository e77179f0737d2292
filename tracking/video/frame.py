"""One frame of a video."""

from dataclasses import dataclass
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

MACROBLOCK_PX = 16  # side of the squares that H.264 and MPEG-4 encode with one quantisation step


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        time: since the first frame [s]; NaN if unknown.
        image: grey levels from 0 to 255, (H, W); uint8, or float32 if the video has more than 8 bits. None if the
            frame is damaged.
        quantisation_steps: H.264 quantisation step of each 16 px square [grey levels], (H / 16, W / 16). Fast encoder
            presets give larger values. For other codecs it is the H.264 step that would cause the same error in a
            dot's position, (1, 1) if the codec has one step for the whole frame. None in most frames, which are not
            sampled, and if the step is not known.
        lag_factor: by which slow motion is coarser than `quantisation_steps` says. It exceeds 1 for fast encoder
            presets and for a frame that no other frame refers to.
    """

    time: float
    image: Array | None
    quantisation_steps: Array | None = None
    lag_factor: float = 1.0

    def image_bytes(self) -> int:
        """Size of the image in memory [bytes]."""
        return 0 if self.image is None else self.image.nbytes

    def quantisation_step_at(self, positions: Array) -> Array:
        """Quantisation steps [grey levels], (D), at positions [px], (D, 2); NaN where not known."""
        if self.quantisation_steps is None:
            return np.full(len(positions), np.nan)
        last = np.array(self.quantisation_steps.shape[::-1]) - 1
        column, row = np.clip(np.nan_to_num(positions) / MACROBLOCK_PX, 0, last).astype(int).T
        steps: Array = self.quantisation_steps[row, column]
        return steps


def scale_to_eight_bits(levels: Array, bits: int) -> NDArray[np.float32]:
    """Scale grey levels of more than 8 bits to the range from 0 to 255."""
    return levels.astype(np.float32) * np.float32(0.5 ** (bits - 8))


def quarter_turns(frame: "av.VideoFrame") -> int:
    """Number of anticlockwise quarter turns by which the file says that the frame is to be displayed."""
    turns: int = round(frame.rotation / 90.0) % 4
    return turns
