"""Grey pictures and their times out of video files and folders of images."""

import heapq
import logging
import queue
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import av
import cv2
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from groundwork import InputError

VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mxf", ".mpg", ".mpeg", ".ts"}
PICTURE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}
AHEAD = 6  # pictures decoded before they are asked for
# Decoders tell of damage in their log; what nobody listens to is nobody's business.
av.logging.set_level(av.logging.ERROR)
logging.getLogger("libav").addHandler(logging.NullHandler())
logging.getLogger("libav").propagate = False
# What makes FFmpeg's decoders report damage instead of painting over it, and how coarsely a picture was coded.
STRICT = {"err_detect": "crccheck+bitstream+buffer+explode", "export_side_data": "venc_params"}
MACROBLOCK = 16  # px: side of the squares that H.264 codes with one step
H264_PARAMETERS = 1  # FFmpeg's number for the kind of parameters that H.264 has


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes:
        time: since the first frame [s]; NaN where unknown.
        picture: grey levels of 0 to 255 (H, W), uint8, or float32 where the video has more than 8 bits;
            None where the frame is damaged.
        steps: by which H.264 rounded the changes in each square of 16 px [grey levels], (H / 16, W / 16); None where
            the decoder does not say.
    """

    time: float
    picture: NDArray | None
    steps: NDArray | None = None

    def step_at(self, places: NDArray) -> NDArray:
        """The steps at places [px], (D, 2); 0 where they are not known, (D)."""
        if self.steps is None:
            return np.zeros(len(places))
        last = np.array(self.steps.shape[::-1]) - 1
        column, row = np.clip(np.nan_to_num(places) / MACROBLOCK, 0, last).astype(int).T
        return self.steps[row, column]


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
        source = _folder_frames(self.path) if self.path.is_dir() else _file_frames(self, reading.notes)
        reading.frames = _ahead(source)
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
        readable = (picture for picture in map(_read_picture, pictures) if picture is not None)
        first = next(readable, None)
        if first is None:
            raise InputError(f"expected pictures in {path}, none of which can be read; copy them again")
        return Video(path, (first.shape[1], first.shape[0]), len(pictures), 0.0)
    try:
        with av.open(str(path)) as container:
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
    for packet in container.demux(stream):
        try:
            frames = packet.decode()
        except av.FFmpegError:
            continue
        for frame in frames:
            return _turns(frame)
    return 0


def _turns(frame: "av.VideoFrame") -> int:
    return round(frame.rotation / 90.0) % 4


def _read_picture(path: Path) -> NDArray | None:
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)


def _folder_frames(folder: Path) -> Iterator[Frame]:
    shape: tuple[int, ...] | None = None
    bits = 8
    for path in _pictures_in(folder):
        picture = _read_picture(path)
        if picture is None:
            yield Frame(np.nan, None)
            continue
        if shape is None:
            # A 16-bit file may hold 10, 12 or 14 bits; the first picture decides.
            bits = next(b for b in (8, 10, 12, 14, 16) if int(picture.max()) < 2**b)
        elif picture.shape != shape:
            raise InputError(f"expected pictures of one size in {folder}, found another in {path.name}; remove it")
        shape = picture.shape
        yield Frame(np.nan, picture if picture.dtype == np.uint8 else _scaled(picture, bits))


def _scaled(levels: NDArray, bits: int) -> NDArray[np.float32]:
    return levels.astype(np.float32) * np.float32(0.5 ** (bits - 8))


@dataclass
class _Slots:
    """Frames the container holds, in the order they are shown.

    Every packet has a slot by its time stamp. A frame that comes out of the decoder fills its own;
    slots before it that are still empty were lost.
    """

    base: float
    waiting: list[int] = field(default_factory=list)
    damaged: set[int] = field(default_factory=set)
    start: int | None = None

    def time(self, stamp: int) -> float:
        if self.start is None:
            self.start = stamp
        return (stamp - self.start) * self.base

    def up_to(self, stamp: int | None) -> Iterator[Frame]:
        """The lost frames before `stamp`, or all that are left."""
        while self.waiting and (stamp is None or self.waiting[0] < stamp):
            yield Frame(self.time(heapq.heappop(self.waiting)), None)
        if self.waiting and self.waiting[0] == stamp:
            heapq.heappop(self.waiting)


def _file_frames(video: Video, notes: list[str]) -> Iterator[Frame]:
    """Decodes packet by packet in one thread, which is what makes a decoder own up to damage.

    A damaged frame spoils those that refer to it: all up to the next key frame.
    """
    path = video.path
    number = 0
    shown: list[float] = []
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            stream.codec_context.thread_count = 1
            stream.codec_context.options = STRICT
            assert stream.time_base is not None
            slots = _Slots(float(stream.time_base))
            broken, leading = False, None
            for packet in _packets(container, stream, notes):
                if packet.size and packet.pts is not None:
                    heapq.heappush(slots.waiting, packet.pts)
                frames, trouble = _decoded(packet)
                if packet.is_keyframe:
                    # Frames shown before this key may come after it, and refer to what was broken.
                    leading = packet.pts if broken else None
                    broken = trouble
                else:
                    broken = broken or trouble
                early = leading is not None and packet.pts is not None and packet.pts < leading
                if (broken or early) and packet.pts is not None:
                    slots.damaged.add(packet.pts)
                for frame in frames:
                    spoilt = frame.is_corrupt or (broken if frame.pts is None else frame.pts in slots.damaged)
                    if frame.pts is not None:
                        yield from slots.up_to(frame.pts)
                    time = np.nan if frame.pts is None else slots.time(frame.pts)
                    picture = None if spoilt else _grey(frame)
                    shown.append(time)
                    yield Frame(time, picture, None if spoilt else _steps(frame))
                    number += 1
            if number:
                missing = list(slots.up_to(None))
                number += len(missing)
                yield from missing
    except (av.FFmpegError, OSError) as error:
        if number == 0:
            raise InputError(
                f"{path}: no frame can be decoded ({error}); copy the video again from the camera"
            ) from None
        notes.append(f"{path.name}: reading stopped after frame {number - 1} ({error})")
    if number == 0:
        raise InputError(f"expected frames in {path}, found none; copy the video again from the camera")
    notes += _contradictions(video, number, np.array(shown))


def _packets(
    container: "av.container.InputContainer", stream: "av.video.stream.VideoStream", notes: list[str]
) -> Iterator["av.packet.Packet"]:
    """The stream's packets; where the file breaks off, what came before and a note."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (av.FFmpegError, OSError) as error:
            notes.append(f"{container.name}: the file breaks off or is damaged ({error})")
            return
        yield packet


def _decoded(packet: "av.packet.Packet") -> tuple[list["av.VideoFrame"], bool]:
    """A packet's frames, and whether the decoder complained."""
    with av.logging.Capture(local=True) as messages:
        try:
            frames = packet.decode()
        except av.FFmpegError:
            return [], True
    complaints = any(level <= av.logging.ERROR for level, _, _ in messages)
    return frames, complaints or packet.is_corrupt or any(frame.is_corrupt for frame in frames)


def _contradictions(video: Video, number: int, time: NDArray) -> list[str]:
    """What the container says that its frames do not bear out."""
    notes = []
    if video.frames and video.frames != number:
        notes.append(f"{video.path.name}: the file announces {video.frames} frames and holds {number}")
    step = np.diff(time[np.isfinite(time)])
    if len(step) and (step <= 0).any():
        notes.append(f"{video.path.name}: {int((step <= 0).sum())} frames are stamped no later than the one before")
    elif len(step) > 1 and video.fps:
        rate = 1.0 / float(np.median(step))
        if abs(rate / video.fps - 1.0) > 0.02:
            notes.append(
                f"{video.path.name}: the file announces {video.fps:.6g} frames/s, its time stamps {rate:.6g}; "
                "the time stamps are used"
            )
        gaps = int((step > 1.5 * np.median(step)).sum())
        if gaps:
            notes.append(f"{video.path.name}: {gaps} gaps in the time stamps, where frames were dropped")
    return notes


def _grey(frame: "av.VideoFrame") -> NDArray:
    """The luma plane as it is stored, or the grey of a format without one, turned as it is to be shown."""
    name, bits = frame.format.name, frame.format.components[0].bits
    planar = name.startswith(("yuv4", "yuvj4", "gray", "nv1", "nv2", "p01", "p21", "yuva4")) and not name.endswith("be")
    if planar and bits <= 16 and not name.startswith("grayf"):
        plane = frame.planes[0]
        kind = np.uint8 if bits == 8 else np.uint16
        rows = np.frombuffer(plane, kind).reshape(plane.height, -1)[:, : plane.width]
        # p010 and its like keep their bits at the upper end.
        high = name.startswith(("p01", "p21"))
        picture = rows.copy() if bits == 8 else _scaled(rows, 16 if high else bits)
    elif bits > 8:
        picture = _scaled(frame.to_ndarray(format="gray16le"), 16)
    else:
        picture = frame.to_ndarray(format="gray")
    turns = _turns(frame)
    return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture


def _steps(frame: "av.VideoFrame") -> NDArray | None:
    """The steps by which an H.264 picture of 8 bits was rounded, turned as it is to be shown."""
    if frame.format.components[0].bits != 8:
        return None
    rows, columns = (-(-side // MACROBLOCK) for side in (frame.height, frame.width))
    for data in frame.side_data:
        if data.type != SideData.VIDEO_ENC_PARAMS:
            continue
        # FFmpeg's AVVideoEncParams: count, offset and size of the blocks, kind, quantiser; each block ends in its own.
        head = np.frombuffer(data, np.int32, 8)
        count, offset, size, kind, quantiser = (int(head[k]) for k in (0, 2, 4, 6, 7))
        if kind != H264_PARAMETERS or count != rows * columns or size % 4:
            continue
        blocks = np.frombuffer(data, np.int32, count * size // 4, offset).reshape(rows, columns, -1)
        steps = 0.625 * 2.0 ** ((quantiser + blocks[..., 4]) / 6.0)
        if turns := _turns(frame):
            whole = np.kron(steps, np.ones((MACROBLOCK, MACROBLOCK)))[: frame.height, : frame.width]
            half = MACROBLOCK // 2
            steps = np.rot90(whole, turns)[half::MACROBLOCK, half::MACROBLOCK]
        return steps
    return None


def _ahead(source: Iterator[Frame]) -> Iterator[Frame]:
    """The same frames, made in a thread of their own."""
    made: queue.Queue[Frame | BaseException | None] = queue.Queue(AHEAD)
    stopped = threading.Event()

    def put(item: Frame | BaseException | None) -> None:
        while not stopped.is_set():
            try:
                made.put(item, timeout=0.2)
            except queue.Full:
                continue
            return

    def work() -> None:
        try:
            for frame in source:
                put(frame)
                if stopped.is_set():
                    return
        except Exception as error:  # handed to whoever reads
            put(error)
        put(None)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while (item := made.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stopped.set()
        thread.join()
