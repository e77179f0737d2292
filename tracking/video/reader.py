"""Grey images and their times from video files and folders of images."""

import re
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.tracking.video.decoding import read_frames
from rafl.tracking.video.ffmpeg import open_container, read_packets
from rafl.tracking.video.frame import Frame, quarter_turns, scale_to_eight_bits
from rafl.tracking.video.jpeg import PROBE_COUNT, is_intact_jpeg
from rafl.tracking.video.prefetch import prefetch

Array = NDArray[Any]

VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mxf", ".mpg", ".mpeg", ".ts"}
CAPTURE_RATE_TAG = "com.android.capture.fps"  # of QuickTime and MP4 files; other makers' phones write it too
JPEG_SUFFIXES = {".jpg", ".jpeg"}
IMAGE_SUFFIXES = {".png", ".tif", ".tiff", ".bmp"} | JPEG_SUFFIXES


@dataclass
class Reading:
    """A video being read; iterate over it for its frames.

    Attributes:
        frames: the frames that are left.
        notes: contradictions found in the file; complete after the last frame.
    """

    frames: Iterator[Frame]
    notes: list[str] = field(default_factory=list)

    def __iter__(self) -> Iterator[Frame]:
        return self.frames


@dataclass(frozen=True)
class Video:
    """A video file, or a folder of numbered images.

    Attributes:
        path: of the file or folder.
        size: width and height as displayed [px].
        frames: number of frames that the container announces; 0 if it does not.
        fps: frames per second that the container announces; 0 if it does not.
        capture_fps: frames per second at which the camera recorded a slow-motion file, which plays more slowly; 0 if
            the file does not say.
        predicted_frames: whether the encoder predicted frames from others, with loss.
    """

    path: Path
    size: tuple[int, int]
    frames: int
    fps: float
    capture_fps: float = 0.0
    predicted_frames: bool = False

    def read(self) -> Reading:
        """Read every frame in order; a separate thread decodes a few frames in advance.

        Damaged frames, and those that refer to them, have no image.
        """
        reading = Reading(iter(()))
        if self.path.is_dir():
            reading.frames = prefetch(_read_folder(self.path), lambda frame: frame.image_bytes())
        else:
            reading.frames = read_frames(self.path, self.frames, self.fps, reading.notes)
        return reading


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key under which img2 comes before img10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def visible_entries(folder: Path) -> list[Path]:
    """What is in a folder, in natural order, without hidden entries: macOS puts some beside the videos."""
    return sorted((path for path in folder.iterdir() if not path.name.startswith(".")), key=natural_key)


def _image_paths(folder: Path) -> list[Path]:
    return [path for path in visible_entries(folder) if path.suffix.lower() in IMAGE_SUFFIXES]


def is_video(path: Path) -> bool:
    """Whether a path is, by its name, a video file or a folder of images."""
    if path.is_dir():
        return bool(_image_paths(path))
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_video(path: Path) -> Video:
    """Open a video; only its first frame is decoded.

    Raises:
        InputError: missing, unreadable or interlaced.
    """
    if path.is_dir():
        paths = _image_paths(path)
        readable = (image for image in map(_image_reader(paths), paths) if image is not None)
        first = next(readable, None)
        if first is None:
            raise InputError(f"expected images in {path}, none of which can be read; copy them again")
        return Video(path, (first.shape[1], first.shape[0]), len(paths), 0.0)
    try:
        with open_container(path) as container:
            if not container.streams.video:
                raise InputError(f"expected a video in {path}, found no video stream; export it again")
            stream = container.streams.video[0]
            fps = float(stream.average_rate) if stream.average_rate else 0.0
            frames = stream.frames
            size = (getattr(stream, "width", 0), getattr(stream, "height", 0))  # missing if no decoder is known
            if min(size) < 1:
                raise InputError(f"expected a video in {path}, found {size[0]} x {size[1]} px; export it again")
            first = _first_frame(container, stream)
            if first is not None and first.interlaced_frame:
                raise InputError(
                    f"{path}: expected frames that are exposed at once, found interlaced ones, with every second line "
                    "from another time; record progressive video, or make a frame of each half (ffmpeg -i VIDEO -vf "
                    "yadif=1 -crf 12 NEW.mp4; setfield=prog instead of yadif=1 if only the file's tag is wrong)"
                )
            if first is not None and quarter_turns(first) % 2:
                size = (size[1], size[0])
            codec = stream.codec_context.codec
            predicted = bool(codec.lossy and not codec.intra_only)
            return Video(path, size, frames, fps, _capture_fps(container.metadata), predicted)
    except (av.FFmpegError, OSError) as error:
        raise InputError(
            f"expected a video in {path}, which cannot be opened ({error}); copy it again from the camera"
        ) from None


def _capture_fps(metadata: dict[str, str]) -> float:
    """Frames per second at which a slow-motion file was recorded; 0 if its tags do not say."""
    try:
        rate = float(metadata.get(CAPTURE_RATE_TAG, 0.0))
    except ValueError:
        return 0.0
    return rate if 0.0 < rate < np.inf else 0.0


def _first_frame(
    container: "av.container.InputContainer", stream: "av.video.stream.VideoStream"
) -> "av.VideoFrame | None":
    """The first frame that can be decoded; None if there is none."""
    for packet in read_packets(container, stream, []):
        try:
            frames = packet.decode()
        except av.FFmpegError:
            continue
        if frames:
            return frames[0]
    return None


def _image_reader(paths: list[Path]) -> Callable[[Path], Array | None]:
    """Function that reads an image file; it returns None for an unreadable file.

    A damaged JPEG file counts as unreadable, unless several of the first files show damage, as some cameras leave stray
    bytes in every file.
    """
    probed = paths[:PROBE_COUNT]
    suspect = sum(_read_image(path) is not None and _read_image(path, strict=True) is None for path in probed)
    return partial(_read_image, strict=suspect <= 1)


def _read_image(path: Path, strict: bool = False) -> Array | None:
    """Read a grey image of up to 16 bits; None if unreadable, or with `strict` if it is a damaged JPEG file."""
    try:
        content = path.read_bytes()
        if strict and path.suffix.lower() in JPEG_SUFFIXES and not is_intact_jpeg(content):
            return None
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except (OSError, cv2.error):  # OpenCV raises the latter for files that are empty or claim a huge size
        return None


def folder_images(folder: Path) -> tuple[list[Path], Callable[[Path], Array | None]]:
    """The images of a folder in order, and a function that reads one.

    It returns grey levels from 0 to 255, (H, W); None for an unreadable file.
    """
    paths = _image_paths(folder)
    read_image = _image_reader(paths)
    first = next((image for image in map(read_image, paths) if image is not None), None)
    # A 16-bit file may hold 10, 12 or 14 bits; the first image decides.
    bits = 8 if first is None else next(b for b in (8, 10, 12, 14, 16) if int(first.max()) < 2**b)

    def read(path: Path) -> Array | None:
        image = read_image(path)
        return image if image is None or image.dtype == np.uint8 else scale_to_eight_bits(image, bits)

    return paths, read


def _read_folder(folder: Path) -> Generator[Frame]:
    """Yield the images of a folder as frames without times; unreadable ones have no image.

    Raises:
        InputError: the images differ in size.
    """
    shape: tuple[int, ...] | None = None
    paths, read_image = folder_images(folder)
    for path in paths:
        image = read_image(path)
        if image is None:
            yield Frame(np.nan, None)
            continue
        if shape is not None and image.shape != shape:
            raise InputError(f"expected images of one size in {folder}, found another size in {path.name}; remove it")
        shape = image.shape
        yield Frame(np.nan, image)
