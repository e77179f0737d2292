"""Overlay videos: each marker with its name and trail drawn over the frames of one camera."""

import io
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import Camera
from rafl.common.files import write_bytes
from rafl.tracking.detection.detect import to_eight_bits
from rafl.tracking.reconstruction.gap_filling import FILLED
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.video.reader import Video

Array = NDArray[Any]

TRAIL_FRAMES = 15
COLOUR, FILLED_COLOUR, TRAIL_COLOUR = (90, 255, 90), (255, 170, 40), (60, 150, 255)  # red, green, blue
MAX_SIDE_PX = 1280  # longer side of an overlay video


def display_pixels(tracks: Tracks, name: str, camera: Camera) -> Array:
    """Pixels (T, M, 2) at which to draw the markers in a camera's frames.

    These are the measured pixels; a filled marker is drawn at the projection of its 3-D position.
    """
    measured, _ = tracks.in_frames(name)
    projected = np.where((tracks.state == FILLED)[..., None], camera.project(tracks.position), np.nan)
    return np.where(np.isfinite(measured), measured, projected)


def annotate(grey: Array, pixel: Array, filled: NDArray[np.bool_], names: tuple[str, ...], trails: Array) -> Array:
    """Draw markers and names at pixel (M, 2), and trails (K, M, 2), over a grey image; returns an RGB image."""
    image: Array = cv2.cvtColor(to_eight_bits(grey), cv2.COLOR_GRAY2RGB)
    for marker, name in enumerate(names):
        trail = trails[:, marker]
        points = np.rint(trail[np.isfinite(trail[:, 0])]).astype(np.int32)
        cv2.polylines(image, [points], False, TRAIL_COLOUR, 1, cv2.LINE_AA)
        if not np.isfinite(pixel[marker]).all():
            continue
        colour = FILLED_COLOUR if filled[marker] else COLOUR
        x, y = np.rint(pixel[marker]).astype(int).tolist()
        cv2.circle(image, (x, y), 3, colour, 1, cv2.LINE_AA)
        cv2.putText(image, name, (x + 6, y - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return image


def write_overlay(
    path: Path, video: Video, name: str, camera: Camera, tracks: Tracks, tick: Callable[[], None]
) -> None:
    """Write an H.264 video of one camera's frames with marker names and trails. Filled markers are orange.

    `tick` is called after every frame.
    """
    shrink = min(1.0, MAX_SIDE_PX / max(video.size))
    width, height = (max(int(side * shrink) // 2 * 2, 2) for side in video.size)
    pixel = display_pixels(tracks, name, camera) * shrink
    row_of = tracks.rows_by_frame(name)
    content = io.BytesIO()
    with av.open(content, "w", format="mp4") as output:
        stream = output.add_stream("libx264", rate=Fraction(min(tracks.fps, 25.0)).limit_denominator(100))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number, frame in enumerate(video.read()):
            tick()
            row = row_of.get(number)
            if frame.image is None or row is None:
                continue
            small = cv2.resize(to_eight_bits(frame.image), (width, height), interpolation=cv2.INTER_AREA)
            trails = pixel[max(row - TRAIL_FRAMES, 0) : row + 1]
            image = annotate(small, pixel[row], tracks.state[row] == FILLED, tracks.names, trails)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        output.mux(stream.encode())
    write_bytes(path, content.getbuffer())
