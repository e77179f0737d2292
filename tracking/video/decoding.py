"""Decode a video file packet by packet, without the damaged frames."""

import os
import queue
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from itertools import islice, starmap
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.tracking.video.ffmpeg import DecodingResult, FFmpegDecoder, luma_bytes, open_container, read_packets
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.frame_order import DecodedPacket, FrameOrder
from rafl.tracking.video.jpeg import JpegDecoder
from rafl.tracking.video.nal_units import NalUnits, RandomAccessPoints
from rafl.tracking.video.prefetch import prefetch

Array = NDArray[Any]
Decoder = Callable[[list["av.packet.Packet"]], list[DecodingResult]]

PACKETS_PER_TASK = 4
# Intra-only videos, in which no frame refers to another, are decoded by one decoder, and one more for each
# BYTES_PER_DECODER of a packet. Decoding that many bytes takes about as long as tracking the dots of a frame. More
# decoders would only slow down the tracking.
MAX_DECODERS, BYTES_PER_DECODER = 4, 40_000


def read_frames(path: Path, frames: int, fps: float, notes: list[str]) -> Iterator[Frame]:
    """Yield every frame of a video file in order; damaged ones, and those that refer to them, have no image.

    A separate thread decodes a few frames in advance. Each decoder works in one thread, since only then it reports
    damage.

    Args:
        path: of the file.
        frames: number of frames that the container announces; 0 if it does not.
        fps: frames per second that the container announces; 0 if it does not.
        notes: contradictions in the file are appended.

    Raises:
        InputError: nothing can be decoded.
    """
    times: list[float] = []
    try:
        with closing(_decoded_packets(path, notes)) as packets:
            for frame in FrameOrder().frames(packets):
                times.append(frame.time)
                yield frame
    except (av.FFmpegError, OSError) as error:
        if not times:
            raise InputError(
                f"{path}: no frame can be decoded ({error}); copy the video again from the camera"
            ) from None
        notes.append(f"{path.name}: reading stopped after frame {len(times) - 1} ({error})")
    if not times:
        raise InputError(f"expected frames in {path}, found none; copy the video again from the camera")
    notes += _contradictions(path.name, frames, fps, np.array(times))


def _decoded_packets(path: Path, notes: list[str]) -> Generator[DecodedPacket]:
    """Yield a video file's packets and what they decode to, in advance in another thread."""
    with ExitStack() as stack:
        container = stack.enter_context(open_container(path))
        stream = container.streams.video[0]
        results = stack.enter_context(closing(_decoding_results(path, container, stream, notes)))
        extradata = stream.codec_context.extradata
        units = NalUnits.of(extradata) if stream.codec_context.codec.name == "h264" else None
        access_points = None if units is None else RandomAccessPoints(units)
        for packet, frames, damaged in results:
            timestamp = packet.pts if packet.size else None
            if access_points is None:
                refresh_packets = 0 if packet.is_keyframe else None
            else:
                refresh_packets = access_points.refresh_packets(packet)
            yield DecodedPacket(
                timestamp,
                refresh_packets is not None,
                float(packet.time_base),
                frames,
                damaged,
                refresh_packets or 0,
                lacks_timestamp=packet.size > 0 and timestamp is None,
            )


def _decoding_results(
    path: Path, container: "av.container.InputContainer", stream: "av.video.stream.VideoStream", notes: list[str]
) -> Generator[DecodingResult]:
    """Yield a file's packets and what they decode to; as much of the work as possible runs in other threads."""
    codec = stream.codec_context.codec
    packets = read_packets(container, stream, notes)
    if not codec.intra_only:
        # The only decoder has a thread to itself; any other work there would delay it.
        decoder = FFmpegDecoder(stream)
        decoded = ((packet, *decoder.decode_packet(packet)) for packet in packets)
        with closing(prefetch(decoded, lambda item: sum(map(luma_bytes, item[1])))) as items:
            yield from starmap(decoder.convert, items)
        return
    with ExitStack() as stack:
        count = min(MAX_DECODERS, os.cpu_count() or 1, _useful_decoder_count(path))
        decoders: list[Decoder]
        if codec.name == "mjpeg" and (jpeg := JpegDecoder.of(path)) is not None:
            decoders = [jpeg.decode] * count
        else:
            streams = [stream]
            streams += [stack.enter_context(open_container(path)).streams.video[0] for _ in range(1, count)]
            decoders = [FFmpegDecoder(each).decode for each in streams]
        results = _decode_all(packets, decoders)
        yield from stack.enter_context(
            closing(prefetch(results, lambda result: sum(frame.image_bytes() for frame in result[1])))
        )


def _useful_decoder_count(path: Path) -> int:
    """How many decoders keep pace with tracking the dots, judged by the size of a video's first packet."""
    with open_container(path) as container:
        first = next(read_packets(container, container.streams.video[0], []), None)
        return 1 + (0 if first is None else first.size // BYTES_PER_DECODER)


def _decode_all(packets: Iterator["av.packet.Packet"], decoders: list[Decoder]) -> Generator[DecodingResult]:
    """Yield what packets decode to, in their order; each decoder works in a thread of its own if there are several."""
    batches = iter(lambda: list(islice(packets, PACKETS_PER_TASK)), [])
    if len(decoders) == 1:
        for batch in batches:
            yield from decoders[0](batch)
        return
    idle: queue.SimpleQueue[Decoder] = queue.SimpleQueue()
    for decoder in decoders:
        idle.put(decoder)

    def decode(batch: list["av.packet.Packet"]) -> list[DecodingResult]:
        decoder = idle.get()
        try:
            return decoder(batch)
        finally:
            idle.put(decoder)

    tasks: deque[Future[list[DecodingResult]]] = deque()
    with ThreadPoolExecutor(len(decoders)) as pool:
        for batch in batches:
            tasks.append(pool.submit(decode, batch))
            if len(tasks) > len(decoders):
                yield from tasks.popleft().result()
        for task in tasks:
            yield from task.result()


def _contradictions(name: str, frames: int, fps: float, time: Array) -> list[str]:
    """Describe what the container announces and its frames contradict; `time` is that of the frames [s], (T)."""
    notes = []
    if frames and frames != len(time):
        notes.append(f"{name}: the file announces {frames} frames and holds {len(time)}")
    step = np.diff(time[np.isfinite(time)])
    if len(step) and (step <= 0).any():
        notes.append(f"{name}: {int((step <= 0).sum())} frames have a timestamp no later than the frame before")
    elif len(step) > 1 and fps:
        rate = 1.0 / float(np.median(step))
        if abs(rate / fps - 1.0) > 0.02:
            notes.append(
                f"{name}: the file announces {fps:.6g} frames/s, its timestamps {rate:.6g}; the timestamps are used"
            )
        gaps = int((step > 1.5 * np.median(step)).sum())
        if gaps:
            notes.append(f"{name}: {gaps} gaps in the timestamps, where frames were dropped")
    return notes
