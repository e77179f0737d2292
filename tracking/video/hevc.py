"""Packets of HEVC turned into pictures by FFmpeg, and looked through for damage that it says nothing of.

It looks neither whether a picture's code ends where the picture does nor whether rows begin where the file says, and
gives out what it reads in code that no encoder wrote. So each packet is decoded thrice more, on its own and with grey
in place of the pictures it refers to, since what a code is made up of does not depend on them: as it is; with rows that
begin where the file says and other bytes after its end, which change nothing; and with other last bytes, which change
the picture, unless its reader never came to them.
"""

import queue
from concurrent.futures import Executor
from dataclasses import dataclass, field

import av
import numpy as np
from numpy.typing import NDArray
from rafl.tracking.video.ffmpeg import FFmpegDecoder, Outcome, grey
from rafl.tracking.video.nal_units import Units

# Kinds of units (Rec. ITU-T H.265, table 7-1): those below 32 are parts of pictures, 32 to 34 parameters; decoders
# leave out 8 and 9 where they begin with them, but not 0 and 1, which are coded alike.
CODED, PARAMETERS, SKIPPED = 32, range(32, 35), range(8, 10)
# Of a part, the last bytes that are changed, and in how many ways: the ends of still pictures say so little that one in
# ten or twenty ways makes no difference.
ENDS, WAYS = 32, 16
# A picture comes out though what it refers to is missing, and is not smoothed by how that was said to move.
ALONE = {"flags": "+output_corrupt", "flags2": "+showall", "skip_loop_filter": "all"}


def noise(seed: int) -> bytes:
    """Bytes that stand for nothing, the same for the same seed, none of which is taken for a mark between units."""
    return np.random.default_rng(seed).integers(4, 256, 2 * ENDS).astype(np.uint8).tobytes()


NOISE = [noise(seed) for seed in range(WAYS)]


def kind(unit: bytes) -> int:
    """What a unit holds."""
    return unit[0] >> 1 & 63


def is_part(unit: bytes) -> bool:
    """Whether a unit is part of a picture, of the layer that is decoded."""
    return kind(unit) < CODED and not unit[0] & 1 and not unit[1] >> 3


@dataclass
class _Alone:
    """Takes each packet for a video of its own.

    Each time by a new decoder: a used one takes the motion of pictures that it does not have from whatever was in its
    memory before.
    """

    parameters: bytes | None
    units: Units
    rows_apart: bool

    def picture(self, units: list[bytes]) -> NDArray | None:
        context = av.codec.CodecContext.create("hevc", "r")
        if self.parameters:
            context.extradata = self.parameters
        context.thread_type, context.thread_count = ("SLICE", 2) if self.rows_apart else ("NONE", 1)
        context.options = ALONE
        with av.logging.Capture(local=True):
            try:
                frames = [*context.decode(av.Packet(self.units.joined(units))), *context.decode(None)]
            except av.FFmpegError:
                frames = []
        return grey(frames[-1], copy=True) if frames else None


class _Looker:
    """Finds damage that decoders read in silence."""

    def __init__(self, parameters: bytes | None, units: Units) -> None:
        self.rows_on, self.rows_apart = (_Alone(parameters, units, rows_apart) for rows_apart in (False, True))

    def is_sound(self, units: list[bytes]) -> bool:
        """Whether a picture's code is read to its end and no further; True where its decoder has no picture."""
        plain = self.rows_on.picture([unit + NOISE[0] if is_part(unit) else unit for unit in units])
        if plain is None:
            return True
        again = self.rows_apart.picture([unit + NOISE[1] if is_part(unit) else unit for unit in units])
        if again is None or not np.array_equal(plain, again):
            return False
        return all(self._reads_to_its_end(units, part, plain) for part, unit in enumerate(units) if is_part(unit))

    def _reads_to_its_end(self, units: list[bytes], part: int, plain: NDArray) -> bool:
        """Whether the picture changes with that part's last bytes."""
        code = units[part].rstrip(b"\0\3")  # what may stand there for no reason but the rate
        some = min(ENDS, len(code) // 2)
        for other in NOISE:
            changed = self.rows_on.picture([*units[:part], code[:-some] + other, *units[part + 1 :]])
            if changed is None or not np.array_equal(plain, changed):
                return True
        return False


@dataclass
class HevcDecoder:
    """FFmpeg's decoder and those that look through what it decodes.

    Attributes:
        first: whose pictures are taken.
        pool: where packets are looked through meanwhile.
        idle: who can.
        units: how to tell them apart.
        parameters: units that what comes next is decoded by, beside those at the file's beginning.
        renewed: the file gave others for its beginning's; what comes after is not looked through.
    """

    first: FFmpegDecoder
    pool: Executor
    idle: "queue.SimpleQueue[_Looker]"
    units: Units
    parameters: list[bytes] = field(default_factory=list)
    renewed: bool = False

    @classmethod
    def of(cls, stream: "av.video.stream.VideoStream", pool: Executor, threads: int) -> "HevcDecoder":
        """Of a stream that nothing else reads; its packets are looked through by so many threads of a pool."""
        first = FFmpegDecoder(stream)
        parameters = first.context.extradata
        units = Units.of("hevc", parameters)
        idle: queue.SimpleQueue[_Looker] = queue.SimpleQueue()
        for _ in range(threads):
            idle.put(_Looker(parameters, units))
        return cls(first, pool, idle, units)

    def decode(self, packets: list["av.packet.Packet"]) -> list[Outcome]:
        """The next packets, each with the frames that it completes, and whether it is damaged."""
        looks = [self.pool.submit(self._is_sound, self._needed(packet)) for packet in packets]
        outcomes = self.first.decode(packets)
        return [
            (packet, frames, damaged or not look.result())
            for (packet, frames, damaged), look in zip(outcomes, looks, strict=True)
        ]

    def _needed(self, packet: "av.packet.Packet") -> list[bytes]:
        """The units that a packet's picture is decoded from on its own; none where that is not known."""
        self.renewed |= packet.has_sidedata("new_extradata")
        units = [] if self.renewed else self.units.split(bytes(packet))
        if packet.is_keyframe:
            self.parameters = []
        self.parameters += [unit for unit in units if kind(unit) in PARAMETERS]
        parts = [unit for unit in units if is_part(unit)]
        parts = [bytes([unit[0] - (8 << 1)]) + unit[1:] if kind(unit) in SKIPPED else unit for unit in parts]
        return [*self.parameters, *parts] if parts else []

    def _is_sound(self, units: list[bytes]) -> bool:
        if not units:
            return True
        looker = self.idle.get()
        try:
            return looker.is_sound(units)
        finally:
            self.idle.put(looker)
