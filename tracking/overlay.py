"""A video with every marker's name and trail drawn over the picture, to look at."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from groundwork import whole_file
from tracking.tracks import FILLED, Tracks
from tracking.video import Video

TRAIL = 15  # frames
COLOUR, FILLED_COLOUR = (90, 255, 90), (255, 170, 40)
WIDEST = 1280


def write_overlay(path: Path, video: Video, camera: str, tracks: Tracks, tick: Callable[[], None]) -> None:
    """Write an H.264 video of one camera's view with names, trails and filled markers in orange.

    `tick` is called after every frame.
    """
    shrink = min(1.0, WIDEST / max(video.size))
    width, height = (int(side * shrink) // 2 * 2 for side in video.size)
    pixel = tracks.pixel[camera] * shrink
    with whole_file(path) as temporary, av.open(str(temporary), "w", format="mp4") as output:
        stream = output.add_stream("libx264", rate=Fraction(min(tracks.fps, 25.0)).limit_denominator(100))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number, (_, grey) in enumerate(video.pictures()):
            if number >= len(tracks.time):
                break
            small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
            picture = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
            for marker, name in enumerate(tracks.names):
                colour = FILLED_COLOUR if tracks.state[number, marker] == FILLED else COLOUR
                trail = pixel[max(number - TRAIL, 0) : number + 1, marker]
                points = np.rint(trail[np.isfinite(trail[:, 0])]).astype(np.int32)
                cv2.polylines(picture, [points], False, colour, 1, cv2.LINE_AA)
                if np.isfinite(pixel[number, marker, 0]):
                    x, y = np.rint(pixel[number, marker]).astype(int).tolist()
                    cv2.circle(picture, (x, y), 3, colour, 1, cv2.LINE_AA)
                    place = (x + 6, y - 8)
                    cv2.putText(picture, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            tick()
        output.mux(stream.encode())
