"""Frames of a video by their number, in any order, numbered as the tracker reads them."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np
from numpy.typing import NDArray

from rafl.tracking.video.ffmpeg import FFmpegDecoder, grey_image, open_container, read_packets
from rafl.tracking.video.frame_order import MAX_REORDERED_FRAMES
from rafl.tracking.video.jpeg import JpegDecoder
from rafl.tracking.video.reader import Video, folder_images

Array = NDArray[Any]

RECENT_FRAMES = 16  # decoded frames that are kept, so that steps back decode nothing
NEAR_FRAMES = 8  # a frame this far ahead is decoded to, not sought
MAX_SEEKS = 4  # key frames at which reading is tried to begin, each earlier than the one before


class FrameAccess(Protocol):
    """Access to single frames. One thread at a time may use it."""

    def image(self, number: int) -> Array | None:
        """Grey levels of a frame, (H, W), equal to those that the tracker reads; None if it is damaged or absent."""

    def close(self) -> None:
        """Close the file."""


def open_frames(video: Video) -> FrameAccess:
    """Access to the frames of a video."""
    if video.path.is_dir():
        return _FolderFrames(video.path)
    index = _PacketIndex.of(video.path)
    return _SequentialFrames(video) if index is None else _SoughtFrames(video.path, index)


class _FolderFrames:
    """Frames of a folder of images."""

    def __init__(self, folder: Path) -> None:
        self.paths, self.read = folder_images(folder)

    def image(self, number: int) -> Array | None:
        return self.read(self.paths[number]) if 0 <= number < len(self.paths) else None

    def close(self) -> None:
        pass


class _SequentialFrames:
    """Frames of a file whose timestamps do not tell their order: read from the start as the tracker reads them."""

    def __init__(self, video: Video) -> None:
        self.video = video
        self.frames = enumerate(iter(video.read()))
        self.recent: deque[tuple[int, Array | None]] = deque(maxlen=RECENT_FRAMES)

    def image(self, number: int) -> Array | None:
        for known, image in self.recent:
            if known == number:
                return image
        if self.recent and number < self.recent[-1][0]:
            self.frames = enumerate(iter(self.video.read()))
            self.recent.clear()
        for found, frame in self.frames:
            self.recent.append((found, frame.image))
            if found == number:
                return frame.image
        return None

    def close(self) -> None:
        self.frames = enumerate(iter(()))


class _PacketIndex:
    """The packets of a file in decoding order, and the numbers of their frames.

    Attributes:
        timestamps: display times in units of the stream's time base, in decoding order.
        number: frame number by timestamp.
        position: of each packet in decoding order, by timestamp.
        keys: positions of key frames.
    """

    def __init__(self, timestamps: list[int], keys: list[int]) -> None:
        self.timestamps = timestamps
        self.keys = keys
        self.displayed = sorted(timestamps)
        self.number = {timestamp: number for number, timestamp in enumerate(self.displayed)}
        self.position = {timestamp: position for position, timestamp in enumerate(timestamps)}

    @classmethod
    def of(cls, path: Path) -> "_PacketIndex | None":
        """The index of a file; None if the timestamps do not tell the order in which the tracker reads the frames."""
        with open_container(path) as container:
            packets = [
                (packet.pts, packet.is_keyframe)
                for packet in read_packets(container, container.streams.video[0], [])
                if packet.size
            ]
        timestamps = [pts for pts, _ in packets if pts is not None]
        if len(set(timestamps)) < len(packets) or not packets or not packets[0][1]:
            return None
        shift = np.argsort(np.argsort(timestamps)) - np.arange(len(timestamps))
        if np.abs(shift).max() > MAX_REORDERED_FRAMES:
            return None
        return cls(timestamps, [position for position, (_, key) in enumerate(packets) if key])

    def first_keys(self, timestamp: int) -> list[int]:
        """Positions of the key frames from which a frame can be decoded, the nearest first."""
        before = self.keys[: bisect_right(self.keys, self.position[timestamp])]
        return [position for position in reversed(before) if self.timestamps[position] <= timestamp]


class _SoughtFrames:
    """Frames of a file that is read from the key frame before the one asked for."""

    def __init__(self, path: Path, index: _PacketIndex) -> None:
        self.path, self.index = path, index
        self.recent: deque[tuple[int, av.VideoFrame | Array]] = deque(maxlen=RECENT_FRAMES)
        self.wanted = 0
        self.container = open_container(path)
        self._start_reading()
        is_jpeg = self.stream.codec_context.codec.name == "mjpeg"
        self.jpeg = JpegDecoder.of(path) if is_jpeg else None

    def _start_reading(self) -> None:
        """Read the newly opened file from its start."""
        self.stream = self.container.streams.video[0]
        self.decoder = FFmpegDecoder(self.stream)
        self.began = self.next_position = 0  # positions of the packet at which reading began, and of the next one
        self.decoded = self._decode(read_packets(self.container, self.stream, []))

    def _restart(self) -> None:
        self.close()
        self.container = open_container(self.path)
        self._start_reading()

    def image(self, number: int) -> Array | None:
        if not 0 <= number < len(self.index.displayed):
            return None
        for known, frame in self.recent:
            if known == number:
                return self._grey(frame)
        timestamp = self.index.displayed[number]
        if not self._is_ahead(number, timestamp):
            self._seek(timestamp)
        image = self._read_to(number)
        if image is None and self.began > 0:  # some containers lead a seek into the middle of a frame
            self._restart()
            image = self._read_to(number)
        return image

    def close(self) -> None:
        self.recent.clear()
        self.container.close()

    def _read_to(self, number: int) -> Array | None:
        self.wanted = number
        for found, frame in self.decoded:
            self.recent.append((found, frame))
            if found == number:
                return self._grey(frame)
            if found > number:  # the frame is damaged
                return None
        return None

    @staticmethod
    def _grey(frame: "av.VideoFrame | Array") -> Array | None:
        if isinstance(frame, np.ndarray):
            return frame
        return None if frame.is_corrupt else grey_image(frame, True)

    def _is_ahead(self, number: int, timestamp: int) -> bool:
        """Whether reading on is the shortest way to a frame."""
        shown = self.recent[-1][0] if self.recent else -1
        if number <= shown:
            return False
        key = self.index.first_keys(timestamp)[:1]
        return number <= shown + NEAR_FRAMES or bool(key and key[0] < self.next_position)

    def _seek(self, timestamp: int) -> None:
        """Go to a packet from which a frame can be decoded: a key frame before it, or the start of the file."""
        self.recent.clear()
        for key in self.index.first_keys(timestamp)[:MAX_SEEKS]:
            try:
                self.container.seek(self.index.timestamps[key], stream=self.stream, backward=True)
                packets = read_packets(self.container, self.stream, [])
                first = next(packets)
            except (av.FFmpegError, OSError, StopIteration):
                break
            position = self.index.position.get(first.pts) if first.pts is not None else None
            if position is not None and position <= key:
                self.began = self.next_position = position
                self.decoded = self._decode(chain([first], packets))
                return
        self._restart()

    def _decode(self, packets: Iterator["av.packet.Packet"]) -> Iterator[tuple[int, "av.VideoFrame | Array"]]:
        """Frames with their numbers. Those well before the wanted one that no other refers to are left out."""
        for packet in packets:
            if packet.pts is not None:
                self.next_position = self.index.position.get(packet.pts, self.next_position) + 1
                well_before = self.index.number.get(packet.pts, self.wanted) < self.wanted - RECENT_FRAMES
                self.decoder.context.skip_frame = "NONREF" if well_before else "DEFAULT"
            if self.jpeg is not None:
                image = self.jpeg.decode_image(packet) if packet.size and not packet.is_corrupt else None
                if image is not None:
                    yield self.index.number[packet.pts], image
                continue
            for frame in self.decoder.decode_packet(packet)[0]:
                found = self.index.number.get(frame.pts)
                if found is not None:
                    yield found, frame
