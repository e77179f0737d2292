"""A video with every marker's name and trail drawn over the picture, to look at."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from rafl.calibration.camera import Camera
from rafl.tracking.detection.detect import eight_bits
from rafl.tracking.reconstruction.gap_filling import FILLED
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.video.reader import Video

from rafl.common.files import whole_file

Array = NDArray[Any]

TRAIL = 15  # frames
COLOUR, FILLED_COLOUR, TRAIL_COLOUR = (90, 255, 90), (255, 170, 40), (60, 150, 255)  # red, green, blue
WIDEST = 1280


def shown_pixels(tracks: Tracks, name: str, camera: Camera) -> Array:
    """Where to draw the markers in a camera's picture (T, M, 2): as seen, or filled ones as projected."""
    projected = np.where((tracks.state == FILLED)[..., None], camera.project(tracks.position), np.nan)
    return np.where(np.isfinite(tracks.pixel[name]), tracks.pixel[name], projected)


def annotate(grey: NDArray, pixel: Array, filled: NDArray[np.bool_], names: tuple[str, ...], trails: Array) -> NDArray:
    """A colour picture with marks and names at pixel (M, 2) and trails (K, M, 2)."""
    picture = cv2.cvtColor(eight_bits(grey), cv2.COLOR_GRAY2RGB)
    for marker, name in enumerate(names):
        trail = trails[:, marker]
        points = np.rint(trail[np.isfinite(trail[:, 0])]).astype(np.int32)
        cv2.polylines(picture, [points], False, TRAIL_COLOUR, 1, cv2.LINE_AA)
        if not np.isfinite(pixel[marker]).all():
            continue
        colour = FILLED_COLOUR if filled[marker] else COLOUR
        x, y = np.rint(pixel[marker]).astype(int).tolist()
        cv2.circle(picture, (x, y), 3, colour, 1, cv2.LINE_AA)
        cv2.putText(picture, name, (x + 6, y - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return picture


def write_overlay(
    path: Path, video: Video, name: str, camera: Camera, tracks: Tracks, tick: Callable[[], None]
) -> None:
    """Write an H.264 video of one camera's view with names, trails and filled markers in orange.

    `tick` is called after every frame.
    """
    shrink = min(1.0, WIDEST / max(video.size))
    width, height = (max(int(side * shrink) // 2 * 2, 2) for side in video.size)
    pixel = shown_pixels(tracks, name, camera) * shrink
    row_of = tracks.rows(name)
    with whole_file(path) as temporary, av.open(str(temporary), "w", format="mp4") as output:
        stream = output.add_stream("libx264", rate=Fraction(min(tracks.fps, 25.0)).limit_denominator(100))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number, frame in enumerate(video.read()):
            tick()
            row = row_of.get(number)
            if frame.picture is None or row is None:
                continue
            small = cv2.resize(eight_bits(frame.picture), (width, height), interpolation=cv2.INTER_AREA)
            trails = pixel[max(row - TRAIL, 0) : row + 1]
            picture = annotate(small, pixel[row], tracks.state[row] == FILLED, tracks.names, trails)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        output.mux(stream.encode())
