"""Arrange decoded frames in display order; frames affected by damage come without an image."""

import heapq
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.tracking.video.frame import Frame

Array = NDArray[Any]

MAX_REORDERED_FRAMES = 32  # frames that may be shown before one that they refer to; H.264 and HEVC allow 16


@dataclass(frozen=True)
class DecodedFrame:
    """A frame as the decoder outputs it.

    Attributes:
        timestamp: display time in units of the stream's time base; None if the stream does not say.
        image: see `Frame`; None if damaged.
    """

    timestamp: int | None
    image: Array | None

    def image_bytes(self) -> int:
        """Size of the image in memory [bytes]."""
        return 0 if self.image is None else self.image.nbytes


@dataclass(frozen=True)
class DecodedPacket:
    """A packet's properties, and the decoder's output after it.

    Attributes:
        timestamp: display time of the packet's frame in units of `time_base`; None if the packet does not say.
        random_access: whether the frames that are shown after this one need no frame before it (but see
            `refresh_packets`).
        time_base: unit of the timestamps [s].
        frames: the frames that the decoder has output.
        damaged: whether the decoder found damage.
        refresh_packets: number of packets before this one that are still needed, under periodic intra refresh.
        lacks_timestamp: whether the packet holds a frame without a timestamp.
    """

    timestamp: int | None
    random_access: bool
    time_base: float
    frames: list[DecodedFrame]
    damaged: bool
    refresh_packets: int = 0
    lacks_timestamp: bool = False


@dataclass(frozen=True)
class _PendingFrame:
    """A frame that has not been shown yet.

    Attributes:
        number: of its packet, in decoding order.
        first_reference: number of the earliest packet that it may refer to. This is the key frame of its group, or the
            key frame before that one if the frame is shown before its group's key frame.
        latest_timestamp: of all packets up to this one.
    """

    number: int
    first_reference: int
    latest_timestamp: int


@dataclass
class FrameOrder:
    """Arranges frames in display order, each in its slot.

    Every packet has a slot at its timestamp. A decoded frame fills its own slot. Empty slots before it are lost, and a
    frame that arrives for them later is dropped. A damaged frame also spoils those decoded after it that may refer to
    it. Some decoders report damage only when they output the frame, and frames that refer to it may be shown before
    it. With such a decoder a frame is passed on only after all frames decoded before it have been output.
    """

    pending: dict[int, _PendingFrame] = field(default_factory=dict)  # by timestamp
    empty_slots: list[int] = field(default_factory=list)  # heap of timestamps
    held: deque[DecodedFrame] = field(default_factory=deque)
    lost: set[int] = field(default_factory=set)  # timestamps of lost slots
    damaged: list[int] = field(default_factory=list)  # sorted numbers of packets
    count: int = 0  # packets so far
    first_reference: int = 0  # of frames shown after the last key frame
    leading_reference: int = 0  # first reference of frames shown before the last key frame
    key_timestamp: int | None = None  # of the last key frame
    key_number: int = 0
    unstamped: int = 0  # frames without timestamps that the decoder has not output yet
    max_unstamped: int = 0  # largest number of them before the first damage
    latest_timestamp: int | None = None  # of all packets
    start: int | None = None  # timestamp of the first frame
    time_base: float = 0.0  # unit of the timestamps [s]
    shape: tuple[int, ...] | None = None  # of the first image

    def frames(self, packets: Iterable[DecodedPacket]) -> Iterator[Frame]:
        """Yield the frames of packets, given in decoding order, as soon as their order and damage are known."""
        for packet in packets:
            self._add_packet(packet)
            if packet.damaged:
                self._mark_damaged(packet.timestamp)
            while packet.frames:
                yield from self._add_frame(packet.frames.pop(0))
            if not self.damaged:
                self.max_unstamped = max(self.max_unstamped, self.unstamped)
            yield from self._overdue_frames(self.max_unstamped)
        while self.held:
            yield from self._release(self.held.popleft())
        yield from self._lost_frames(None)
        yield from self._overdue_frames(0)

    def _add_packet(self, packet: DecodedPacket) -> None:
        """Create the slot for a packet's frame."""
        timestamp = packet.timestamp
        self.time_base = self.time_base or packet.time_base
        self.count += 1
        self.unstamped += packet.lacks_timestamp
        if packet.random_access:
            self.leading_reference, self.first_reference = self.first_reference, self.count - packet.refresh_packets
            self.key_timestamp, self.key_number = timestamp, self.count
        if timestamp is not None:
            self.latest_timestamp = (
                timestamp if self.latest_timestamp is None else max(self.latest_timestamp, timestamp)
            )
            leading = self.key_timestamp is not None and timestamp < self.key_timestamp
            first_reference = self.leading_reference if leading else self.first_reference
            self.pending[timestamp] = _PendingFrame(self.count, first_reference, self.latest_timestamp)
            heapq.heappush(self.empty_slots, timestamp)

    def _mark_damaged(self, timestamp: int | None) -> None:
        """Mark the packet with this timestamp as damaged; without a timestamp, the packet decoded last."""
        pending = None if timestamp is None else self.pending.get(timestamp)
        number = self.count if pending is None else pending.number
        if number not in self.damaged[-1:]:
            insort(self.damaged, number)

    def _add_frame(self, frame: DecodedFrame) -> Iterator[Frame]:
        """Yield the frames that can be passed on after the decoder has output this one."""
        if self.shape is None and frame.image is not None:
            self.shape = frame.image.shape
        if frame.image is None or frame.image.shape != self.shape:  # damage may also change the rotation
            self._mark_damaged(frame.timestamp)
        if frame.timestamp not in self.lost:
            self.held.append(frame)
        while self.held and (len(self.held) > MAX_REORDERED_FRAMES or self._is_ready(self.held[0], frame.timestamp)):
            yield from self._release(self.held.popleft())

    def _is_ready(self, frame: DecodedFrame, output_timestamp: int | None) -> bool:
        """Whether all frames decoded before this one have been output."""
        pending = None if frame.timestamp is None else self.pending.get(frame.timestamp)
        return pending is None or output_timestamp is None or pending.latest_timestamp <= output_timestamp

    def _release(self, frame: DecodedFrame) -> Iterator[Frame]:
        """Yield the lost frames before a frame, and the frame."""
        if frame.timestamp is None:
            self.unstamped -= 1
            yield _output_frame(np.nan, frame, self._is_intact(None))
            return
        yield from self._lost_frames(frame.timestamp)
        intact = self._is_intact(self.pending.pop(frame.timestamp, None))
        yield _output_frame(self._time(frame.timestamp), frame, intact)

    def _is_intact(self, pending: _PendingFrame | None) -> bool:
        """Whether neither the frame nor any that it may refer to is damaged."""
        if pending is None:  # the frame may have been decoded before the last key frame
            after_key = self.count - self.key_number > MAX_REORDERED_FRAMES
            pending = _PendingFrame(self.count, self.first_reference if after_key else self.leading_reference, 0)
        index = bisect_left(self.damaged, pending.first_reference)
        return index == len(self.damaged) or self.damaged[index] > pending.number

    def _lost_frames(self, timestamp: int | None) -> Iterator[Frame]:
        """Yield a frame without an image for each empty slot before `timestamp`, or for all if it is None."""
        while self.empty_slots and (timestamp is None or self.empty_slots[0] < timestamp):
            lost = heapq.heappop(self.empty_slots)
            self.pending.pop(lost, None)
            self.lost.add(lost)
            yield Frame(self._time(lost), None)
        if self.empty_slots and self.empty_slots[0] == timestamp:
            heapq.heappop(self.empty_slots)

    def _overdue_frames(self, max_unstamped: int) -> Iterator[Frame]:
        """After damage, yield the frames without timestamps that exceed the largest delay seen before, as lost."""
        while self.damaged and self.unstamped > max_unstamped:
            self.unstamped -= 1
            yield Frame(np.nan, None)

    def _time(self, timestamp: int) -> float:
        """Time since the first frame [s]."""
        if self.start is None:
            self.start = timestamp
        return (timestamp - self.start) * self.time_base


def _output_frame(time: float, frame: DecodedFrame, intact: bool) -> Frame:
    """Frame at its time, without an image unless it is intact."""
    return Frame(time, frame.image if intact else None)
