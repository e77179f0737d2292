"""Decode HEVC with FFmpeg, and check its packets for damage that FFmpeg does not report.

FFmpeg checks neither that the code of an image ends where the image does, nor that the rows begin at the offsets in the
slice header. It outputs whatever it decodes. Therefore each packet is decoded three more times, on its own. Grey
replaces the frames that it refers to, since parsing the code does not depend on them. The three versions are:

1. the packet as it is;
2. with rows that begin at the offsets in the slice header, and other bytes after the end, which must not change the
   image;
3. with its last bytes changed, which must change the image, unless the decoder never read them.
"""

import queue
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from rafl.tracking.video.ffmpeg import DecodingResult, FFmpegDecoder, grey_image
from rafl.tracking.video.nal_units import NalUnits

Array = NDArray[Any]

# Unit types (Rec. ITU-T H.265, table 7-1). Types below 32 are slices, 32 to 34 parameter sets. Decoders drop RASL
# slices, 8 and 9, at the start of decoding, but not types 0 and 1, which have the same syntax.
SLICE_TYPE_END, PARAMETER_SET_TYPES, RASL_TYPES = 32, range(32, 35), range(8, 10)
# How many last bytes of a slice are changed, and in how many versions. The last bytes of a still image carry so little
# that one version in ten or twenty does not change the image.
END_BYTES, END_VERSIONS = 32, 16
# FFmpeg outputs the image even if frames it refers to are missing. The deblocking filter, which depends on the motion
# relative to them, is off.
SINGLE_PACKET_OPTIONS = {"flags": "+output_corrupt", "flags2": "+showall", "skip_loop_filter": "all"}


def noise_bytes(seed: int) -> bytes:
    """Random bytes without meaning, reproducible by the seed; none can be part of a start code."""
    return np.random.default_rng(seed).integers(4, 256, 2 * END_BYTES).astype(np.uint8).tobytes()


NOISE_ENDINGS = [noise_bytes(seed) for seed in range(END_VERSIONS)]


def unit_type(unit: bytes) -> int:
    """nal_unit_type of a unit."""
    return unit[0] >> 1 & 63


def is_slice(unit: bytes) -> bool:
    """Whether a unit is a slice of the base layer, which is the one decoded."""
    return unit_type(unit) < SLICE_TYPE_END and not unit[0] & 1 and not unit[1] >> 3


@dataclass
class _SinglePacketDecoder:
    """Decodes each packet as if it were a video of its own.

    Every packet gets a new decoder. A used one would take the motion of missing frames from its memory of earlier
    packets.
    """

    extradata: bytes | None
    units: NalUnits
    rows_at_offsets: bool  # begin rows at the offsets in the slice header

    def decode_image(self, units: list[bytes]) -> Array | None:
        """Image of a packet, given as units; None if the decoder outputs none."""
        context = av.codec.CodecContext.create("hevc", "r")
        if self.extradata:
            context.extradata = self.extradata
        context.thread_type, context.thread_count = ("SLICE", 2) if self.rows_at_offsets else ("NONE", 1)
        context.options = SINGLE_PACKET_OPTIONS
        with av.logging.Capture(local=True):
            try:
                frames = [*context.decode(av.Packet(self.units.join(units))), *context.decode(None)]
            except av.FFmpegError:
                frames = []
        return grey_image(frames[-1], copy=True) if frames else None


class _PacketChecker:
    """Finds damage that decoders do not report."""

    def __init__(self, extradata: bytes | None, units: NalUnits) -> None:
        self.sequential, self.at_offsets = (
            _SinglePacketDecoder(extradata, units, rows_at_offsets) for rows_at_offsets in (False, True)
        )

    def is_intact(self, units: list[bytes]) -> bool:
        """Whether the decoder reads a packet's code exactly to its end; True if it outputs no image."""
        image = self.sequential.decode_image([unit + NOISE_ENDINGS[0] if is_slice(unit) else unit for unit in units])
        if image is None:
            return True
        again = self.at_offsets.decode_image([unit + NOISE_ENDINGS[1] if is_slice(unit) else unit for unit in units])
        if again is None or not np.array_equal(image, again):
            return False
        return all(self._reads_to_end(units, index, image) for index, unit in enumerate(units) if is_slice(unit))

    def _reads_to_end(self, units: list[bytes], index: int, image: Array) -> bool:
        """Whether changing the last bytes of the unit at `index` changes the image."""
        code = units[index].rstrip(b"\0\3")  # padding that only serves the bit rate
        count = min(END_BYTES, len(code) // 2)
        for ending in NOISE_ENDINGS:
            changed = self.sequential.decode_image([*units[:index], code[:-count] + ending, *units[index + 1 :]])
            if changed is None or not np.array_equal(image, changed):
                return True
        return False


@dataclass
class HevcDecoder:
    """FFmpeg's decoder, with checkers of the packets that it decodes.

    Attributes:
        decoder: decodes the frames.
        pool: runs the checks meanwhile.
        idle: checkers that are free.
        units: splits packets.
        parameter_sets: units that the next packets need, in addition to the extradata.
        extradata_replaced: the file replaced its extradata. Packets after that are not checked.
    """

    decoder: FFmpegDecoder
    pool: Executor
    idle: "queue.SimpleQueue[_PacketChecker]"
    units: NalUnits
    parameter_sets: list[bytes] = field(default_factory=list)
    extradata_replaced: bool = False

    @classmethod
    def of(cls, stream: "av.video.stream.VideoStream", pool: Executor, threads: int) -> "HevcDecoder":
        """Decoder of a stream that nothing else reads; up to `threads` threads of `pool` check its packets."""
        decoder = FFmpegDecoder(stream)
        extradata = decoder.context.extradata
        units = NalUnits.of("hevc", extradata)
        idle: queue.SimpleQueue[_PacketChecker] = queue.SimpleQueue()
        for _ in range(threads):
            idle.put(_PacketChecker(extradata, units))
        return cls(decoder, pool, idle, units)

    def decode(self, packets: list["av.packet.Packet"]) -> list[DecodingResult]:
        """Decode the next packets: each with the frames that it completes, and whether it is damaged."""
        checks = [self.pool.submit(self._is_intact, self._standalone_units(packet)) for packet in packets]
        results = self.decoder.decode(packets)
        return [
            (packet, frames, damaged or not check.result())
            for (packet, frames, damaged), check in zip(results, checks, strict=True)
        ]

    def _standalone_units(self, packet: "av.packet.Packet") -> list[bytes]:
        """Units that suffice to decode a packet on its own; none if they are not known."""
        self.extradata_replaced |= packet.has_sidedata("new_extradata")
        units = [] if self.extradata_replaced else self.units.split(bytes(packet))
        if packet.is_keyframe:
            self.parameter_sets = []
        self.parameter_sets += [unit for unit in units if unit_type(unit) in PARAMETER_SET_TYPES]
        slices = [unit for unit in units if is_slice(unit)]
        # RASL slices become types 0 and 1, so that the decoder does not drop them.
        slices = [bytes([unit[0] - (8 << 1)]) + unit[1:] if unit_type(unit) in RASL_TYPES else unit for unit in slices]
        return [*self.parameter_sets, *slices] if slices else []

    def _is_intact(self, units: list[bytes]) -> bool:
        if not units:
            return True
        checker = self.idle.get()
        try:
            return checker.is_intact(units)
        finally:
            self.idle.put(checker)
