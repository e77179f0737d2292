"""Frames out of a video file, decoded packet by packet; what is damaged is left out."""

import gc
import logging
import os
import queue
import re
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from groundwork import InputError
from tracking.ahead import ahead
from tracking.frame import MACROBLOCK, Frame, scaled
from tracking.order import Decoded, Order, Piece

# Decoders tell of damage in their log, the same words again for the next packet; what nobody listens to is nobody's
# business.
av.logging.set_level(av.logging.ERROR)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").addHandler(logging.NullHandler())
logging.getLogger("libav").propagate = False
# What makes FFmpeg's decoders report damage instead of painting over it, and how coarsely a picture was coded.
STRICT = {"err_detect": "crccheck+bitstream+buffer+explode", "export_side_data": "venc_params"}
H264_PARAMETERS = 1  # FFmpeg's number for the kind of parameters that H.264 has
# Frames of which one is asked how it was coded, and fewer once so many have passed; kinds of frames come in fours and
# twelves. Each answer takes as long as a third of a frame.
ASKED, LATER, MANY = 7, 29, 140
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


def frames_of_file(path: Path, frames: int, fps: float, notes: list[str]) -> Iterator[Frame]:
    """Every frame of a video file in order; damaged ones, and those that refer to them, without a picture.

    They are decoded in a thread of their own, a few ahead; each decoder works in one thread, which is what makes it
    own up to damage.

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
        with closing(ahead(_pieces(path, notes), lambda piece: piece.size())) as pieces:
            for frame in Order().frames(pieces):
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


def _pieces(path: Path, notes: list[str]) -> Generator[Piece]:
    """A video file's packets and what they decode to; whatever can be left to another thread is."""
    with ExitStack() as stack:
        container = stack.enter_context(av.open(str(path)))
        stream = container.streams.video[0]
        codec = stream.codec_context.codec
        stack.enter_context(_log_of(codec.name))
        count = min(MOST_DECODERS, os.cpu_count() or 1, _decoders_worth(path)) if codec.intra_only else 1
        containers = [container, *(stack.enter_context(av.open(str(path))) for _ in range(1, count))]
        decoders = [_strict(item.streams.video[0]) for item in containers]
        tells = codec.name == "h264"
        number = 0
        coarser = 0.0  # not known yet
        for packet, frames, complained in _all_decoded(_packets(container, stream, notes), decoders):
            if tells and not coarser:
                coarser = _coarser(bytes(packet))
            taken = []
            while frames:
                asked = tells and number % (ASKED if number < MANY else LATER) == 0
                # A decoder that needs no earlier pictures works the quicker the sooner it has its memory back.
                taken.append(_taken(frames.pop(0), codec.intra_only or asked, coarser if asked else None))
                number += 1
                if asked:
                    gc.collect(0)  # a frame and its side data hold on to each other, and to the decoder's memory
            stamp = packet.pts if packet.size else None
            yield Piece(stamp, packet.is_keyframe, float(packet.time_base), taken, complained)


def _taken(frame: "av.VideoFrame", copy: bool, coarser: float | None) -> Decoded:
    """What is needed of a frame; its steps only where `coarser` is given."""
    picture = None if frame.is_corrupt else _grey(frame, copy)
    return Decoded(frame.pts, picture, None if coarser is None or picture is None else _steps(frame, coarser))


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
