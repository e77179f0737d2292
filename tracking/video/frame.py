"""One frame of a video."""

from dataclasses import dataclass
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        time: since the first frame [s]; NaN if unknown.
        image: grey levels from 0 to 255, (H, W); uint8, or float32 if the video has more than 8 bits. None if the
            frame is damaged.
    """

    time: float
    image: Array | None

    def image_bytes(self) -> int:
        """Size of the image in memory [bytes]."""
        return 0 if self.image is None else self.image.nbytes


def scale_to_eight_bits(levels: Array, bits: int) -> NDArray[np.float32]:
    """Scale grey levels of more than 8 bits to the range from 0 to 255."""
    return levels.astype(np.float32) * np.float32(0.5 ** (bits - 8))


def quarter_turns(frame: "av.VideoFrame") -> int:
    """Number of anticlockwise quarter turns by which the file says that the frame is to be displayed."""
    turns: int = round(frame.rotation / 90.0) % 4
    return turns
