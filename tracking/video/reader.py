"""Grey pictures and their times out of video files and folders of images."""

import re
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from rafl.tracking.video.decoding import frames_of_file
from rafl.tracking.video.ffmpeg import opened, packets_of
from rafl.tracking.video.frame import Frame, quarter_turns, scaled
from rafl.tracking.video.jpeg import PROBED, is_whole
from rafl.tracking.video.prefetch import ahead

from rafl.common.errors import InputError

VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mxf", ".mpg", ".mpeg", ".ts"}
JPEG_SUFFIXES = {".jpg", ".jpeg"}
PICTURE_SUFFIXES = {".png", ".tif", ".tiff", ".bmp"} | JPEG_SUFFIXES


@dataclass
class Reading:
    """A video being read: iterate for its frames.

    Attributes:
        notes: what was found on the way that contradicts itself; complete after the last frame.
    """

    frames: Iterator[Frame]
    notes: list[str] = field(default_factory=list)

    def __iter__(self) -> Iterator[Frame]:
        return self.frames


@dataclass(frozen=True)
class Video:
    """A video file, or a folder of numbered pictures.

    Attributes:
        path: of the file or folder.
        size: width, height, as shown [px].
        frames: how many, as far as the container says; 0 where it does not.
        fps: frames per second, as far as the container says; 0 where it does not.
    """

    path: Path
    size: tuple[int, int]
    frames: int
    fps: float

    def read(self) -> Reading:
        """Every frame in order, decoded in a thread of its own, a few ahead.

        Damaged frames come without a picture, and so do those that refer to them.
        """
        reading = Reading(iter(()))
        if self.path.is_dir():
            reading.frames = ahead(_folder_frames(self.path), lambda frame: frame.size())
        else:
            reading.frames = frames_of_file(self.path, self.frames, self.fps, reading.notes)
        return reading


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key under which img2 comes before img10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def _pictures_in(folder: Path) -> list[Path]:
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES), key=natural_key)


def is_video(path: Path) -> bool:
    """Whether a path looks like a video file or a folder of pictures."""
    if path.is_dir():
        return bool(_pictures_in(path))
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_video(path: Path) -> Video:
    """Look at a video; only its first frame is decoded.

    Raises:
        InputError: missing or unreadable.
    """
    if path.is_dir():
        pictures = _pictures_in(path)
        readable = (picture for picture in map(_reader_of(pictures), pictures) if picture is not None)
        first = next(readable, None)
        if first is None:
            raise InputError(f"expected pictures in {path}, none of which can be read; copy them again")
        return Video(path, (first.shape[1], first.shape[0]), len(pictures), 0.0)
    try:
        with opened(path) as container:
            if not container.streams.video:
                raise InputError(f"expected a video in {path}, found no video stream; export it again")
            stream = container.streams.video[0]
            fps = float(stream.average_rate) if stream.average_rate else 0.0
            frames = stream.frames
            size = (getattr(stream, "width", 0), getattr(stream, "height", 0))  # absent where no decoder is known
            if min(size) < 1:
                raise InputError(f"expected a video in {path}, found {size[0]} x {size[1]} px; export it again")
            if _quarter_turns(container, stream) % 2:
                size = (size[1], size[0])
            return Video(path, size, frames, fps)
    except (av.FFmpegError, OSError) as error:
        raise InputError(
            f"expected a video in {path}, which cannot be opened ({error}); copy it again from the camera"
        ) from None


def _quarter_turns(container: "av.container.InputContainer", stream: "av.video.stream.VideoStream") -> int:
    """How many quarter turns anticlockwise the first frame asks to be shown by."""
    for packet in packets_of(container, stream, []):
        try:
            frames = packet.decode()
        except av.FFmpegError:
            continue
        for frame in frames:
            return quarter_turns(frame)
    return 0


def _reader_of(pictures: list[Path]) -> Callable[[Path], NDArray | None]:
    """Gives a file's picture; None where it cannot be read, or is a JPEG with damage that the others do not have."""
    begun = pictures[:PROBED]
    odd = sum(_read_picture(path) is not None and _read_picture(path, strict=True) is None for path in begun)
    return partial(_read_picture, strict=odd <= 1)


def _read_picture(path: Path, strict: bool = False) -> NDArray | None:
    try:
        content = path.read_bytes()
        if strict and path.suffix.lower() in JPEG_SUFFIXES and not is_whole(content):
            return None
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except (OSError, cv2.error):  # OpenCV's, of files that are empty or claim to be huge
        return None


def _folder_frames(folder: Path) -> Generator[Frame]:
    shape: tuple[int, ...] | None = None
    bits = 8
    pictures = _pictures_in(folder)
    read = _reader_of(pictures)
    for path in pictures:
        picture = read(path)
        if picture is None:
            yield Frame(np.nan, None)
            continue
        if shape is None:
            # A 16-bit file may hold 10, 12 or 14 bits; the first picture decides.
            bits = next(b for b in (8, 10, 12, 14, 16) if int(picture.max()) < 2**b)
        elif picture.shape != shape:
            raise InputError(f"expected pictures of one size in {folder}, found another in {path.name}; remove it")
        shape = picture.shape
        yield Frame(np.nan, picture if picture.dtype == np.uint8 else scaled(picture, bits))
