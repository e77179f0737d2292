"""One frame of a video."""

from dataclasses import dataclass

import av
import numpy as np
from numpy.typing import NDArray

MACROBLOCK = 16  # px: side of the squares that H.264 and MPEG-4 code with one step


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        time: since the first frame [s]; NaN where unknown.
        picture: grey levels of 0 to 255 (H, W), uint8, or float32 where the video has more than 8 bits;
            None where the frame is damaged.
        steps: by which H.264 rounded the changes in each square of 16 px [grey levels], (H / 16, W / 16), or by which
            it would do a dot as much harm as the video's codec did, (1, 1) where that is said of whole pictures; larger
            where the encoder says that it was in a hurry; None in most frames, and where nothing is said.
        lag: so many times coarser than these steps it is where nothing moves fast, if its encoder was in a hurry or no
            other frame is made of it.
    """

    time: float
    picture: NDArray | None
    steps: NDArray | None = None
    lag: float = 1.0

    def size(self) -> int:
        """Of the picture [bytes]."""
        return 0 if self.picture is None else self.picture.nbytes

    def step_at(self, places: NDArray) -> NDArray:
        """The steps at places [px], (D, 2); NaN where they are not known, (D)."""
        if self.steps is None:
            return np.full(len(places), np.nan)
        last = np.array(self.steps.shape[::-1]) - 1
        column, row = np.clip(np.nan_to_num(places) / MACROBLOCK, 0, last).astype(int).T
        return self.steps[row, column]


def scaled(levels: NDArray, bits: int) -> NDArray[np.float32]:
    """Grey levels of more than 8 bits as those of 0 to 255."""
    return levels.astype(np.float32) * np.float32(0.5 ** (bits - 8))


def quarter_turns(frame: "av.VideoFrame") -> int:
    """How many quarter turns anticlockwise a frame asks to be shown by."""
    return round(frame.rotation / 90.0) % 4
