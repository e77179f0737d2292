"""Frames out of a video file, decoded packet by packet; what is damaged is left out."""

import gc
import heapq
import logging
import os
import queue
import re
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from groundwork import InputError
from tracking.frame import MACROBLOCK, Frame, scaled

# Decoders tell of damage in their log, the same words again for the next packet; what nobody listens to is nobody's
# business.
av.logging.set_level(av.logging.ERROR)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").addHandler(logging.NullHandler())
logging.getLogger("libav").propagate = False
# What makes FFmpeg's decoders report damage instead of painting over it, and how coarsely a picture was coded.
STRICT = {"err_detect": "crccheck+bitstream+buffer+explode", "export_side_data": "venc_params"}
H264_PARAMETERS = 1  # FFmpeg's number for the kind of parameters that H.264 has
# Frames of which one is asked how it was coded: kinds of frames come in fours and twelves.
ASKED = 7
STEPS = 0.625 * 2.0 ** (np.arange(-64, 128) / 6.0)  # by quantiser, from -64
# What x264 says of itself in its first packet, and how much coarser its pictures are than their steps alone would make
# them where it searched no more thoroughly than that (its `subme`). Measured on seven presets at crf 23: in a hurry it
# lets everything lag.
SEARCHED = re.compile(rb"x264 - core.{,400}? subme=(\d{1,2}) ", re.DOTALL)
COARSER = ((2, 2.2), (6, 1.4))
# Decoders that refuse what is damaged, and need not be heard: this one writes dozens of lines a frame into its log, for
# each of which PyAV waits for Python's lock, though nobody is to see them.
OPEN = {"mjpeg"}
# Decoders side by side, of videos each of whose pictures stands for itself: one more for so many bytes a picture, which
# take about as long as following the dots in it. More than it needs would only keep the follower from its work.
MOST_DECODERS, BYTES_EACH = 4, 40_000
_heard: list[str] = []  # the decoders at work that must be heard; the log is one for the whole program
DEEPEST = 32  # frames that may be shown before one that they refer to: H.264 and HEVC allow 16


def frames_of_file(path: Path, frames: int, fps: float, notes: list[str]) -> Iterator[Frame]:
    """Every frame of a video file in order; damaged ones, and those that refer to them, without a picture.

    Each decoder works in one thread, which is what makes it own up to damage.

    Args:
        path: of the file.
        frames: how many the container announces; 0 where it does not.
        fps: frames per second that it announces; 0 where it does not.
        notes: is added what contradicts itself.

    Raises:
        InputError: nothing decodes.
    """
    shown: list[float] = []
    try:
        with ExitStack() as stack:
            container = stack.enter_context(av.open(str(path)))
            codec = container.streams.video[0].codec_context.codec
            stack.enter_context(_log_of(codec.name))
            count = min(MOST_DECODERS, os.cpu_count() or 1, _decoders_worth(path)) if codec.intra_only else 1
            containers = [container, *(stack.enter_context(av.open(str(path))) for _ in range(1, count))]
            decoders = [_strict(item.streams.video[0]) for item in containers]
            for frame in stack.enter_context(closing(_frames(container, decoders, notes))):
                shown.append(frame.time)
                yield frame
    except (av.FFmpegError, OSError) as error:
        if not shown:
            raise InputError(
                f"{path}: no frame can be decoded ({error}); copy the video again from the camera"
            ) from None
        notes.append(f"{path.name}: reading stopped after frame {len(shown) - 1} ({error})")
    if not shown:
        raise InputError(f"expected frames in {path}, found none; copy the video again from the camera")
    notes += _contradictions(path.name, frames, fps, np.array(shown))


def _decoders_worth(path: Path) -> int:
    """How many decoders keep pace with following the dots, by the size of a video's first packet."""
    with av.open(str(path)) as container:
        first = next(_packets(container, container.streams.video[0], []), None)
        return 1 + (0 if first is None else first.size // BYTES_EACH)


@contextmanager
def _log_of(decoder: str) -> Iterator[None]:
    """The log is on while a video is read, but for decoders that need not be heard where no other is at work."""
    quiet = decoder in OPEN
    if not quiet:
        _heard.append(decoder)
    av.logging.set_level(None if quiet and not _heard else av.logging.ERROR)
    try:
        yield
    finally:
        if not quiet:
            _heard.remove(decoder)
        av.logging.set_level(av.logging.ERROR)


def _strict(stream: "av.video.stream.VideoStream") -> "av.CodecContext":
    stream.thread_type = "NONE"
    stream.codec_context.thread_count = 1
    stream.codec_context.options = STRICT
    return stream.codec_context


def _frames(
    container: "av.container.InputContainer", decoders: list["av.CodecContext"], notes: list[str]
) -> Generator[Frame]:
    stream = container.streams.video[0]
    assert stream.time_base is not None
    tells = stream.codec_context.name == "h264"
    alone = stream.codec_context.codec.intra_only
    order = _Order(float(stream.time_base))
    number = 0
    coarser = 0.0  # not known yet
    shape: tuple[int, ...] | None = None
    for packet, frames, trouble in _all_decoded(_packets(container, stream, notes), decoders):
        order.expect(packet)
        if tells and not coarser:
            coarser = _coarser(bytes(packet))
        if trouble:
            order.spoil(packet.pts)
        while frames:
            frame = frames.pop(0)
            asked = tells and number % ASKED == 0
            # A decoder that needs no earlier pictures works the quicker the sooner it has its memory back.
            stamp, picture = frame.pts, None if frame.is_corrupt else _grey(frame, copy=alone or asked)
            shape = picture.shape if shape is None and picture is not None else shape
            if picture is None or picture.shape != shape:  # damage may turn pictures, too
                order.spoil(stamp)
            steps = _steps(frame, coarser) if asked and picture is not None else None
            del frame
            if asked:
                gc.collect(0)  # a frame and its side data hold on to each other, and to the decoder's memory
            yield from order.shown(_Decoded(stamp, picture, steps))
            number += 1
    yield from order.rest()


@dataclass(frozen=True)
class _Decoded:
    """A frame as it comes out of the decoder."""

    stamp: int | None
    picture: NDArray | None
    steps: NDArray | None


@dataclass(frozen=True)
class _Packet:
    """Where a frame stands among the others.

    Attributes:
        number: in the order of decoding.
        group: key frames up to and with this one.
        leading: shown before the key frame of its group, so that it may refer to the group before.
        last: the latest time stamp of all that were decoded up to it.
    """

    number: int
    group: int
    leading: bool
    last: int


@dataclass
class _Order:
    """Puts frames into the order in which they are shown, each in its slot.

    Every packet has a slot by its time stamp. A frame that comes out of the decoder fills its own; slots before it
    that are still empty were lost, and what comes for them later is dropped. A damaged frame spoils those of its group
    that were decoded after it. Some decoders own up to damage only when the frame comes out, and frames that refer to
    it may be shown before it: none is given on before all that were decoded before it are out.
    """

    base: float
    packets: dict[int, _Packet] = field(default_factory=dict)
    waiting: list[int] = field(default_factory=list)
    held: deque[_Decoded] = field(default_factory=deque)
    gone: set[int] = field(default_factory=set)  # stamps of lost slots
    broken: dict[int, int] = field(default_factory=dict)  # by group, the first damaged packet
    count: int = 0
    group: int = 0
    key: int | None = None
    last: int | None = None  # latest stamp of all packets
    start: int | None = None

    def expect(self, packet: "av.packet.Packet") -> None:
        """Takes note of a packet that is about to be decoded."""
        stamp = packet.pts
        if packet.is_keyframe:
            self.group += 1
            self.key = stamp
        self.count += 1
        if packet.size and stamp is not None:
            self.last = stamp if self.last is None else max(self.last, stamp)
            leading = self.key is not None and stamp < self.key
            self.packets[stamp] = _Packet(self.count, self.group, leading, self.last)
            heapq.heappush(self.waiting, stamp)

    def spoil(self, stamp: int | None) -> None:
        """What is stamped so is damaged; without a stamp, what was decoded last."""
        packet = None if stamp is None else self.packets.get(stamp)
        number, group = (self.count, self.group) if packet is None else (packet.number, packet.group)
        self.broken[group] = min(number, self.broken.get(group, number))

    def shown(self, frame: _Decoded) -> Iterator[Frame]:
        """The frames that can be given on once this one is out."""
        if frame.stamp not in self.gone:
            self.held.append(frame)
        while self.held and (len(self.held) > DEEPEST or self._is_ready(self.held[0], frame.stamp)):
            yield from self._given_on(self.held.popleft())

    def rest(self) -> Iterator[Frame]:
        """All that is left when the decoder is empty."""
        while self.held:
            yield from self._given_on(self.held.popleft())
        yield from self._lost(None)

    def _is_ready(self, frame: _Decoded, out: int | None) -> bool:
        packet = None if frame.stamp is None else self.packets.get(frame.stamp)
        return packet is None or out is None or packet.last <= out

    def _given_on(self, frame: _Decoded) -> Iterator[Frame]:
        if frame.stamp is None:
            sound = self.group not in self.broken
            yield Frame(np.nan, frame.picture if sound else None, frame.steps if sound else None)
            return
        yield from self._lost(frame.stamp)
        sound = self._is_sound(self.packets.pop(frame.stamp, None))
        yield Frame(self._time(frame.stamp), frame.picture if sound else None, frame.steps if sound else None)

    def _is_sound(self, packet: _Packet | None) -> bool:
        if packet is None:
            return self.group not in self.broken
        if packet.leading and packet.group - 1 in self.broken:
            return False
        return packet.number < self.broken.get(packet.group, packet.number + 1)

    def _lost(self, stamp: int | None) -> Iterator[Frame]:
        """The slots before `stamp`, or all that are left."""
        while self.waiting and (stamp is None or self.waiting[0] < stamp):
            lost = heapq.heappop(self.waiting)
            self.packets.pop(lost, None)
            self.gone.add(lost)
            yield Frame(self._time(lost), None)
        if self.waiting and self.waiting[0] == stamp:
            heapq.heappop(self.waiting)

    def _time(self, stamp: int) -> float:
        if self.start is None:
            self.start = stamp
        return (stamp - self.start) * self.base


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


def _all_decoded(
    packets: Iterable["av.packet.Packet"], decoders: list["av.CodecContext"]
) -> Iterator[tuple["av.packet.Packet", list["av.VideoFrame"], bool]]:
    """Packets in their order, each with its frames and whether the decoder complained."""
    if len(decoders) == 1:
        yield from ((packet, *_decoded(packet, decoders[0])) for packet in packets)
        return
    idle: queue.SimpleQueue[av.CodecContext] = queue.SimpleQueue()
    for decoder in decoders:
        idle.put(decoder)

    def work(packet: "av.packet.Packet") -> tuple[list["av.VideoFrame"], bool]:
        decoder = idle.get()
        try:
            return _decoded(packet, decoder)
        finally:
            idle.put(decoder)

    begun: deque[tuple[av.packet.Packet, Future[tuple[list[av.VideoFrame], bool]]]] = deque()
    with ThreadPoolExecutor(len(decoders)) as pool:
        for packet in packets:
            begun.append((packet, pool.submit(work, packet)))
            if len(begun) > len(decoders):
                packet, result = begun.popleft()
                yield packet, *result.result()
        for packet, result in begun:
            yield packet, *result.result()


def _decoded(packet: "av.packet.Packet", decoder: "av.CodecContext") -> tuple[list["av.VideoFrame"], bool]:
    """A packet's frames, and whether the decoder complained."""
    with av.logging.Capture(local=True) as messages:
        try:
            frames = decoder.decode(packet)
        except av.FFmpegError:
            return [], True
    complaints = any(level <= av.logging.ERROR for level, _, _ in messages)
    return frames, complaints or packet.is_corrupt


def _contradictions(name: str, frames: int, fps: float, time: NDArray) -> list[str]:
    """What the container says that its frames do not bear out."""
    notes = []
    if frames and frames != len(time):
        notes.append(f"{name}: the file announces {frames} frames and holds {len(time)}")
    step = np.diff(time[np.isfinite(time)])
    if len(step) and (step <= 0).any():
        notes.append(f"{name}: {int((step <= 0).sum())} frames are stamped no later than the one before")
    elif len(step) > 1 and fps:
        rate = 1.0 / float(np.median(step))
        if abs(rate / fps - 1.0) > 0.02:
            notes.append(
                f"{name}: the file announces {fps:.6g} frames/s, its time stamps {rate:.6g}; the time stamps are used"
            )
        gaps = int((step > 1.5 * np.median(step)).sum())
        if gaps:
            notes.append(f"{name}: {gaps} gaps in the time stamps, where frames were dropped")
    return notes


def quarter_turns(frame: "av.VideoFrame") -> int:
    """How many quarter turns anticlockwise a frame asks to be shown by."""
    return round(frame.rotation / 90.0) % 4


def _grey(frame: "av.VideoFrame", copy: bool) -> NDArray:
    """The luma plane as it is stored, or the grey of a format without one, turned as it is to be shown.

    Without `copy` it lies in the decoder's own memory where it can, which takes a tenth of the time of decoding less.
    """
    name, bits = frame.format.name, frame.format.components[0].bits
    planar = name.startswith(("yuv4", "yuvj4", "gray", "nv1", "nv2", "p01", "p21", "yuva4")) and not name.endswith("be")
    if planar and bits <= 16 and not name.startswith("grayf"):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8 if bits == 8 else np.uint16).reshape(plane.height, -1)[:, : plane.width]
        # p010 and its like keep their bits at the upper end.
        high = name.startswith(("p01", "p21"))
        whole = np.array if copy else np.ascontiguousarray
        picture = whole(rows) if bits == 8 else scaled(rows, 16 if high else bits)
    elif bits > 8:
        picture = scaled(frame.to_ndarray(format="gray16le"), 16)
    else:
        picture = frame.to_ndarray(format="gray")
    turns = quarter_turns(frame)
    return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture


def _coarser(packet: bytes) -> float:
    """How much coarser than by its steps alone a video is coded, by what its first packet says of the encoder."""
    said = SEARCHED.search(packet)
    if said is None:
        return 1.0
    return next((times for most, times in COARSER if int(said[1]) <= most), 1.0)


def _steps(frame: "av.VideoFrame", coarser: float) -> NDArray | None:
    """The steps by which an H.264 picture of 8 bits was rounded, so much coarser, turned as it is to be shown."""
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
        steps = np.take(coarser * STEPS, blocks[..., 4] + (quantiser + 64), mode="clip")
        if turns := quarter_turns(frame):
            whole = np.kron(steps, np.ones((MACROBLOCK, MACROBLOCK)))[: frame.height, : frame.width]
            half = MACROBLOCK // 2
            steps = np.rot90(whole, turns)[half::MACROBLOCK, half::MACROBLOCK]
        return steps
    return None
