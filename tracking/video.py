"""Grey pictures and their times out of video files and folders of images."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from groundwork import InputError

VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mxf", ".mpg", ".mpeg", ".ts"}
PICTURE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}


@dataclass(frozen=True)
class Video:
    """A video file, or a folder of numbered pictures.

    Attributes:
        path: of the file or folder.
        size: width, height [px].
        frames: how many, as far as the container says; 0 where it does not.
        fps: frames per second, as far as the container says; 0 where it does not.
    """

    path: Path
    size: tuple[int, int]
    frames: int
    fps: float

    def pictures(self) -> Iterator[tuple[float | None, NDArray[np.uint8]]]:
        """Each frame's time since the first [s] (None where unknown) and its grey levels (H, W).

        Raises:
            InputError: a frame cannot be decoded; names it.
        """
        return _folder_pictures(self.path) if self.path.is_dir() else _file_pictures(self.path)


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key under which img2 comes before img10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdigit() else (0, part) for part in parts]


def _pictures_in(folder: Path) -> list[Path]:
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES), key=natural_key)


def is_video(path: Path) -> bool:
    """Whether a path looks like a video file or a folder of pictures."""
    if path.is_dir():
        return bool(_pictures_in(path))
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_video(path: Path) -> Video:
    """Look at a video without decoding it.

    Raises:
        InputError: missing or unreadable.
    """
    if path.is_dir():
        pictures = _pictures_in(path)
        first = _read_picture(pictures[0])
        return Video(path, (first.shape[1], first.shape[0]), len(pictures), 0.0)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"expected a video in {path}, found no video stream; export it again")
            stream = container.streams.video[0]
            fps = float(stream.average_rate) if stream.average_rate else 0.0
            return Video(path, (stream.width, stream.height), stream.frames, fps)
    except (av.FFmpegError, OSError) as error:
        raise InputError(
            f"expected a video in {path}, which cannot be opened ({error}); copy it again from the camera"
        ) from None


def _read_picture(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise InputError(f"expected a picture in {path}, which cannot be read; replace or remove it")
    return picture


def _folder_pictures(folder: Path) -> Iterator[tuple[None, NDArray[np.uint8]]]:
    size = None
    for path in _pictures_in(folder):
        picture = _read_picture(path)
        if size is not None and picture.shape != size:
            raise InputError(f"expected pictures of one size in {folder}, found another in {path.name}; remove it")
        size = picture.shape
        yield None, picture


def _file_pictures(path: Path) -> Iterator[tuple[float | None, NDArray[np.uint8]]]:
    start = None
    number = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                if frame.is_corrupt:
                    raise InputError(f"{path}: frame {number} is damaged; copy the video again from the camera")
                time = None
                if frame.pts is not None and frame.time_base is not None:
                    moment = float(frame.pts * frame.time_base)
                    start = moment if start is None else start
                    time = moment - start
                yield time, _luma(frame)
                number += 1
    except (av.FFmpegError, OSError) as error:
        raise InputError(
            f"{path}: frame {number} cannot be decoded ({error}); copy the video again from the camera"
        ) from None
    if number == 0:
        raise InputError(f"expected frames in {path}, found none; copy the video again from the camera")


def _luma(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """The luma plane as it is stored, or the grey of a format without one."""
    if frame.format.name.startswith(("yuv4", "yuvj4", "gray8", "nv12")) and frame.format.components[0].bits == 8:
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
        return rows[:, : plane.width].copy()
    return frame.to_ndarray(format="gray")
