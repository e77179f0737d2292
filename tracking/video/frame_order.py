"""Frames in the order in which they are shown; those that damage has spoilt without a picture."""

import heapq
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rafl.tracking.video.frame import Frame

DEEPEST = 32  # frames that may be shown before one that they refer to: H.264 and HEVC allow 16


@dataclass(frozen=True)
class Decoded:
    """A frame as it comes out of the decoder.

    Attributes:
        stamp: when it is shown, in the stream's own unit; None where it does not say.
        picture: grey levels, see `Frame`; None where damaged.
        steps: by which it was rounded, see `Frame`.
        lag: see `Frame`.
    """

    stamp: int | None
    picture: NDArray | None
    steps: NDArray | None
    lag: float = 1.0

    def size(self) -> int:
        """Of the picture [bytes]."""
        return 0 if self.picture is None else self.picture.nbytes


@dataclass(frozen=True)
class Piece:
    """What a packet says of the frame in it, and what came out of the decoder after it.

    Attributes:
        stamp: when its frame is shown, in the stream's own unit; None where it does not say.
        key: whether nothing before its frame is needed for those that are shown after it.
        unit: of the stamp [s].
        frames: those that were ready.
        complained: whether the decoder found damage.
        since: how many packets before a key frame's it needs, where pictures are renewed bit by bit.
        unstamped: holds a frame without a stamp.
        told: whether the decoder tells of all damage with the packet, not only with the frame.
    """

    stamp: int | None
    key: bool
    unit: float
    frames: list[Decoded]
    complained: bool
    since: int = 0
    unstamped: bool = False
    told: bool = False


@dataclass(frozen=True)
class _Packet:
    """Where a frame stands among the others.

    Attributes:
        number: in the order of decoding.
        first: the number of the earliest that it may refer to: its group's key frame, or, if it is shown before that,
            the key frame before.
        last: the latest time stamp of all that were decoded up to it.
    """

    number: int
    first: int
    last: int


@dataclass
class Order:
    """Puts frames into the order in which they are shown, each in its slot.

    Every packet has a slot by its time stamp. A frame that comes out of the decoder fills its own; slots before it
    that are still empty were lost, and what comes for them later is dropped. A damaged frame spoils those decoded after
    it that may refer to it. Some decoders own up to damage only when the frame comes out, and frames that refer to
    it may be shown before it: of theirs none is given on before all that were decoded before it are out.
    """

    packets: dict[int, _Packet] = field(default_factory=dict)
    waiting: list[int] = field(default_factory=list)
    held: deque[Decoded] = field(default_factory=deque)
    gone: set[int] = field(default_factory=set)  # stamps of lost slots
    damaged: list[int] = field(default_factory=list)  # numbers of packets, in their order
    count: int = 0
    first: int = 0  # that frames from the last key frame on may refer to
    before: int = 0  # that those shown before it may
    key: int | None = None  # the last one's stamp
    key_number: int = 0
    unstamped: int = 0  # frames without stamps that are to come
    depth: int = 0  # the most of them before any was damaged
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
                yield from self._shown(piece.frames.pop(0), piece.told)
            if not self.damaged:
                self.depth = max(self.depth, self.unstamped)
            yield from self._overdue(self.depth)
        while self.held:
            yield from self._given_on(self.held.popleft())
        yield from self._lost(None)
        yield from self._overdue(0)

    def _expect(self, piece: Piece) -> None:
        """Takes note of a packet whose frame is to come out."""
        stamp = piece.stamp
        self.base = self.base or piece.unit
        self.count += 1
        self.unstamped += piece.unstamped
        if piece.key:
            self.before, self.first = self.first, self.count - piece.since
            self.key, self.key_number = stamp, self.count
        if stamp is not None:
            self.last = stamp if self.last is None else max(self.last, stamp)
            leading = self.key is not None and stamp < self.key
            self.packets[stamp] = _Packet(self.count, self.before if leading else self.first, self.last)
            heapq.heappush(self.waiting, stamp)

    def _spoil(self, stamp: int | None) -> None:
        """What is stamped so is damaged; without a stamp, what was decoded last."""
        packet = None if stamp is None else self.packets.get(stamp)
        number = self.count if packet is None else packet.number
        if number not in self.damaged[-1:]:
            insort(self.damaged, number)

    def _shown(self, frame: Decoded, told: bool) -> Iterator[Frame]:
        """The frames that can be given on once this one is out."""
        if self.shape is None and frame.picture is not None:
            self.shape = frame.picture.shape
        if frame.picture is None or frame.picture.shape != self.shape:  # damage may turn pictures, too
            self._spoil(frame.stamp)
        if frame.stamp not in self.gone:
            self.held.append(frame)
        while self.held and (told or len(self.held) > DEEPEST or self._is_ready(self.held[0], frame.stamp)):
            yield from self._given_on(self.held.popleft())

    def _is_ready(self, frame: Decoded, out: int | None) -> bool:
        packet = None if frame.stamp is None else self.packets.get(frame.stamp)
        return packet is None or out is None or packet.last <= out

    def _given_on(self, frame: Decoded) -> Iterator[Frame]:
        if frame.stamp is None:
            self.unstamped -= 1
            yield _shown_at(np.nan, frame, self._is_sound(None))
            return
        yield from self._lost(frame.stamp)
        sound = self._is_sound(self.packets.pop(frame.stamp, None))
        yield _shown_at(self._time(frame.stamp), frame, sound)

    def _is_sound(self, packet: _Packet | None) -> bool:
        if packet is None:  # it may be one that was decoded before the last key frame
            packet = _Packet(self.count, self.first if self.count - self.key_number > DEEPEST else self.before, 0)
        place = bisect_left(self.damaged, packet.first)
        return place == len(self.damaged) or self.damaged[place] > packet.number

    def _lost(self, stamp: int | None) -> Iterator[Frame]:
        """The slots before `stamp`, or all that are left."""
        while self.waiting and (stamp is None or self.waiting[0] < stamp):
            lost = heapq.heappop(self.waiting)
            self.packets.pop(lost, None)
            self.gone.add(lost)
            yield Frame(self._time(lost), None)
        if self.waiting and self.waiting[0] == stamp:
            heapq.heappop(self.waiting)

    def _overdue(self, depth: int) -> Iterator[Frame]:
        """Frames without stamps, once damaged ones are among them, of which more are to come than ever before."""
        while self.damaged and self.unstamped > depth:
            self.unstamped -= 1
            yield Frame(np.nan, None)

    def _time(self, stamp: int) -> float:
        if self.start is None:
            self.start = stamp
        return (stamp - self.start) * self.base


def _shown_at(time: float, frame: Decoded, sound: bool) -> Frame:
    """A frame in its place, which shows nothing unless it is sound."""
    return Frame(time, frame.picture, frame.steps, frame.lag) if sound else Frame(time, None)
