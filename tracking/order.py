"""Frames in the order in which they are shown; those that damage has spoilt without a picture."""

import heapq
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tracking.frame import Frame

DEEPEST = 32  # frames that may be shown before one that they refer to: H.264 and HEVC allow 16


@dataclass(frozen=True)
class Decoded:
    """A frame as it comes out of the decoder.

    Attributes:
        stamp: when it is shown, in the stream's own unit; None where it does not say.
        picture: grey levels, see `Frame`; None where damaged.
        steps: by which it was rounded, see `Frame`.
    """

    stamp: int | None
    picture: NDArray | None
    steps: NDArray | None


@dataclass(frozen=True)
class Piece:
    """What a packet says of the frame in it, and what came out of the decoder after it.

    Attributes:
        stamp: when its frame is shown, in the stream's own unit; None where it does not say, or holds none.
        key: whether its frame is decoded without others.
        unit: of the stamp [s].
        frames: those that were ready.
        complained: whether the decoder found damage.
    """

    stamp: int | None
    key: bool
    unit: float
    frames: list[Decoded]
    complained: bool

    def size(self) -> int:
        """Of its pictures [bytes]."""
        return sum(frame.picture.nbytes for frame in self.frames if frame.picture is not None)


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
class Order:
    """Puts frames into the order in which they are shown, each in its slot.

    Every packet has a slot by its time stamp. A frame that comes out of the decoder fills its own; slots before it
    that are still empty were lost, and what comes for them later is dropped. A damaged frame spoils those of its group
    that were decoded after it. Some decoders own up to damage only when the frame comes out, and frames that refer to
    it may be shown before it: none is given on before all that were decoded before it are out.
    """

    packets: dict[int, _Packet] = field(default_factory=dict)
    waiting: list[int] = field(default_factory=list)
    held: deque[Decoded] = field(default_factory=deque)
    gone: set[int] = field(default_factory=set)  # stamps of lost slots
    broken: dict[int, int] = field(default_factory=dict)  # by group, the first damaged packet
    count: int = 0
    group: int = 0
    key: int | None = None
    last: int | None = None  # latest stamp of all packets
    start: int | None = None
    base: float = 0.0  # seconds in a unit of the stamps
    shape: tuple[int, ...] | None = None  # of the first picture

    def frames(self, pieces: Iterable[Piece]) -> Iterator[Frame]:
        """The frames of pieces in the order of decoding, as they can be given on."""
        for piece in pieces:
            self._expect(piece)
            if piece.complained:
                self._spoil(piece.stamp)
            while piece.frames:
                yield from self._shown(piece.frames.pop(0))
        while self.held:
            yield from self._given_on(self.held.popleft())
        yield from self._lost(None)

    def _expect(self, piece: Piece) -> None:
        """Takes note of a packet whose frame is to come out."""
        stamp = piece.stamp
        self.base = self.base or piece.unit
        if piece.key:
            self.group += 1
            self.key = stamp
        self.count += 1
        if stamp is not None:
            self.last = stamp if self.last is None else max(self.last, stamp)
            leading = self.key is not None and stamp < self.key
            self.packets[stamp] = _Packet(self.count, self.group, leading, self.last)
            heapq.heappush(self.waiting, stamp)

    def _spoil(self, stamp: int | None) -> None:
        """What is stamped so is damaged; without a stamp, what was decoded last."""
        packet = None if stamp is None else self.packets.get(stamp)
        number, group = (self.count, self.group) if packet is None else (packet.number, packet.group)
        self.broken[group] = min(number, self.broken.get(group, number))

    def _shown(self, frame: Decoded) -> Iterator[Frame]:
        """The frames that can be given on once this one is out."""
        if self.shape is None and frame.picture is not None:
            self.shape = frame.picture.shape
        if frame.picture is None or frame.picture.shape != self.shape:  # damage may turn pictures, too
            self._spoil(frame.stamp)
        if frame.stamp not in self.gone:
            self.held.append(frame)
        while self.held and (len(self.held) > DEEPEST or self._is_ready(self.held[0], frame.stamp)):
            yield from self._given_on(self.held.popleft())

    def _is_ready(self, frame: Decoded, out: int | None) -> bool:
        packet = None if frame.stamp is None else self.packets.get(frame.stamp)
        return packet is None or out is None or packet.last <= out

    def _given_on(self, frame: Decoded) -> Iterator[Frame]:
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
