"""What the tracking benchmark's parts share: a measurement, and videos made of pictures."""

from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np


@dataclass(frozen=True)
class Row:
    """One measurement: of what, in which case, the value, and what was asked of it."""

    what: str
    case: str
    value: float
    asked: str = ""


def write_video(path: Path, pictures: list[np.ndarray], codec: str, options: dict[str, str], repeat: int = 1) -> None:
    encoder, pixels = {"h264": ("libx264", "yuv420p"), "mjpeg": ("mjpeg", "yuvj420p"), "ffv1": ("ffv1", "gray")}[codec]
    with av.open(str(path), "w") as output:
        stream = output.add_stream(encoder, rate=100)
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt, stream.options = pixels, options
        levels = "MPEG" if pixels == "yuv420p" else "JPEG"
        for number in range(repeat * len(pictures)):
            # There and back again, so that nothing jumps.
            cycle = number % (2 * len(pictures) - 2) if len(pictures) > 1 else 0
            picture = pictures[cycle if cycle < len(pictures) else 2 * len(pictures) - 2 - cycle]
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            output.mux(stream.encode(frame.reformat(format=pixels, dst_color_range=levels)))
        output.mux(stream.encode())
