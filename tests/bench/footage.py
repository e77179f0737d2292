"""Shared by the parts of the tracking benchmark: measurements, and videos encoded from frames."""

from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np


@dataclass(frozen=True)
class Measurement:
    """One row of the results: a quantity in a case, its value, and the target it is compared with."""

    quantity: str
    case: str
    value: float
    target: str = ""


def write_video(path: Path, frames: list[np.ndarray], codec: str, options: dict[str, str], repeat: int = 1) -> None:
    """Encode grey frames (H, W) at 100 frames/s, `repeat` times, alternately forwards and backwards."""
    encoder, pixels = {"h264": ("libx264", "yuv420p"), "mjpeg": ("mjpeg", "yuvj420p"), "ffv1": ("ffv1", "gray")}[codec]
    with av.open(str(path), "w") as output:
        stream = output.add_stream(encoder, rate=100)
        stream.height, stream.width = frames[0].shape
        stream.pix_fmt, stream.options = pixels, options
        levels = "MPEG" if pixels == "yuv420p" else "JPEG"
        for number in range(repeat * len(frames)):
            # Forwards and backwards, so that the motion never jumps.
            cycle = number % (2 * len(frames) - 2) if len(frames) > 1 else 0
            grey = frames[cycle if cycle < len(frames) else 2 * len(frames) - 2 - cycle]
            frame = av.VideoFrame.from_ndarray(grey, format="gray")
            output.mux(stream.encode(frame.reformat(format=pixels, dst_color_range=levels)))
        output.mux(stream.encode())
