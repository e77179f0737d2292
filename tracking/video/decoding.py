"""Frames out of a video file, decoded packet by packet; what is damaged is left out."""

import os
import queue
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from itertools import islice, starmap
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from rafl.tracking.video.ffmpeg import FFmpegDecoder, Outcome, luma_size, opened, packets_of
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.frame_order import Order, Piece
from rafl.tracking.video.hevc import HevcDecoder
from rafl.tracking.video.jpeg import JpegDecoder
from rafl.tracking.video.nal_units import Renewals, Units
from rafl.tracking.video.prefetch import ahead

from rafl.common.errors import InputError

Decoder = Callable[[list["av.packet.Packet"]], list[Outcome]]

TOGETHER = 4  # packets
# Decoders side by side, of videos each of whose pictures stands for itself: one more for so many bytes a picture, which
# take about as long as following the dots in it. More than it needs would only keep the follower from its work.
MOST_DECODERS, BYTES_EACH = 4, 40_000


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
        with closing(_pieces(path, notes)) as pieces:
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
    """A video file's packets and what they decode to, ahead in another thread."""
    with ExitStack() as stack:
        container = stack.enter_context(opened(path))
        stream = container.streams.video[0]
        outcomes = stack.enter_context(closing(_outcomes(path, container, stream, notes)))
        extradata = stream.codec_context.extradata
        units = Units.of("h264", extradata) if stream.codec_context.codec.name == "h264" else None
        renewals, told = None if units is None else Renewals(units), units is not None
        for packet, frames, damaged in outcomes:
            stamp = packet.pts if packet.size else None
            if units is not None and packet.size:
                told = told and units.parts(bytes(packet)) == 1  # where there are several, one may be lost in silence
            since = (0 if packet.is_keyframe else None) if renewals is None else renewals.since(packet)
            unstamped = packet.size > 0 and stamp is None
            yield Piece(stamp, since is not None, float(packet.time_base), frames, damaged, since or 0, unstamped, told)


def _outcomes(
    path: Path, container: "av.container.InputContainer", stream: "av.video.stream.VideoStream", notes: list[str]
) -> Generator[Outcome]:
    """A file's packets and what they decode to; whatever can be left to other threads is."""
    codec = stream.codec_context.codec
    packets = packets_of(container, stream, notes)
    if not codec.intra_only and codec.name != "hevc":
        # The one decoder has a thread to itself: what else there is to do would keep it waiting.
        decoder = FFmpegDecoder(stream)
        decoded = ((packet, *decoder.decoded(packet)) for packet in packets)
        with closing(ahead(decoded, lambda each: sum(map(luma_size, each[1])))) as made:
            yield from starmap(decoder.taken, made)
        return
    with ExitStack() as stack:
        count = min(MOST_DECODERS, os.cpu_count() or 1, _decoders_worth(path)) if codec.intra_only else 1
        decoders: list[Decoder]
        if codec.name == "mjpeg" and (jpeg := JpegDecoder.of(path)) is not None:
            decoders = [jpeg.decode] * count
        elif codec.name == "hevc":
            cores = os.cpu_count() or 1
            decoders = [HevcDecoder.of(stream, stack.enter_context(ThreadPoolExecutor(cores)), cores).decode]
        else:
            streams = [stream]
            streams += [stack.enter_context(opened(path)).streams.video[0] for _ in range(1, count)]
            decoders = [FFmpegDecoder(each).decode for each in streams]
        outcomes = _all_decoded(packets, decoders)
        yield from stack.enter_context(closing(ahead(outcomes, lambda each: sum(frame.size() for frame in each[1]))))


def _decoders_worth(path: Path) -> int:
    """How many decoders keep pace with following the dots, by the size of a video's first packet."""
    with opened(path) as container:
        first = next(packets_of(container, container.streams.video[0], []), None)
        return 1 + (0 if first is None else first.size // BYTES_EACH)


def _all_decoded(packets: Iterator["av.packet.Packet"], decoders: list[Decoder]) -> Generator[Outcome]:
    """What comes of packets, in their order."""
    handfuls = iter(lambda: list(islice(packets, TOGETHER)), [])
    if len(decoders) == 1:
        for handful in handfuls:
            yield from decoders[0](handful)
        return
    idle: queue.SimpleQueue[Decoder] = queue.SimpleQueue()
    for decoder in decoders:
        idle.put(decoder)

    def work(handful: list["av.packet.Packet"]) -> list[Outcome]:
        decoder = idle.get()
        try:
            return decoder(handful)
        finally:
            idle.put(decoder)

    begun: deque[Future[list[Outcome]]] = deque()
    with ThreadPoolExecutor(len(decoders)) as pool:
        for handful in handfuls:
            begun.append(pool.submit(work, handful))
            if len(begun) > len(decoders):
                yield from begun.popleft().result()
        for result in begun:
            yield from result.result()


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
