"""How coarsely the pictures of a video were coded, as their decoder or their headers tell.

All in steps of H.264 that do a dot as much harm, for which `rafl.tracking.reconstruction.uncertainty` was measured.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from av.video.frame import PictureType
from numpy.typing import NDArray
from rafl.tracking.video.frame import MACROBLOCK, quarter_turns

# Steps of H.264 and HEVC, by quantiser from -64, and of AV1 and VP9, by index: doubling every six, and between knots.
STEPS = 0.625 * 2.0 ** (np.arange(-64, 128) / 6.0)
KNOTS, AT_KNOTS = [0, 1, 95, 120, 137, 150, 200, 255], [4, 8, 102, 152, 203, 255, 639, 1828]
INDEXED = np.interp(np.arange(256), KNOTS, AT_KNOTS) / 8.0
# FFmpeg's numbers for the kinds of parameters that its decoders export.
VP9, H264, MPEG = 0, 1, 2
# A step of theirs does the harm of so many of H.264's times a power of it. Powers measured on 14 to 20 films each, most
# like those for H.264: x265 at crf 16 to 28, SVT-AV1 at 18 to 42, libvpx at 20 to 42, FFmpeg's MPEG-4 at 2 to 8; how
# many times, on 16 each of bodies that move along any direction.
HARM = {"hevc": (0.17, 1.48), "av1": (5.0, 0.4), "vp9": (0.64, 0.85), "mpeg4": (1.55, 1.08)}
# What x264 and x265 say of themselves, and where they searched no more thoroughly than that (their `subme`), how much
# coarser their pictures are than their steps alone would make them: everywhere, and where nothing moves fast, in most
# frames and in those made of frames before and after (B). In a hurry they let things lag. Measured on seven and four
# presets at crf 23; where nothing moves fast on 48 films of four of x264's, `veryfast` at 18 and 28 too.
SEARCHED = re.compile(rb"x26([45]) [(-].{,1500}? subme=(\d{1,2}) ", re.DOTALL)
# Who leaves no note is of unknown haste: half way between, so that sigma is wrong by less than twice, either way.
PATIENT, UNKNOWN = (1.0, 1.0, 1.0), (1.2, 1.2, 1.5)
HASTY = {
    b"4": {0: (2.4, 1.0, 1.0), 2: (1.0, 1.8, 3.9), 6: (1.2, 1.0, 1.4)},
    b"5": {0: (2.3, 1.0, 1.0), 1: (1.4, 1.0, 1.0)},
}
# A film's last frame, of which no other is made, is at least so many times coarser. Measured on 25 films of x264's
# medium preset; of `veryfast` it is as frames of kind B are.
LAST = 2.0
# Frames of which one is asked how it was coded, and fewer once so many have passed; kinds of frames come in fours and
# twelves. Each answer takes as long as a third of a frame; a dozen are too few to tell the usual step of a short film.
ASKED, LATER, MANY = 5, 113, 100
FIELDS = re.compile(r"\b(\w+_parameter_set_id|init_qp_minus26|slice_qp_delta|base_q_idx) .*= (-?\d+)\s*$")


@dataclass
class ByDecoder:
    """What decoders export of the blocks that they decode.

    Attributes:
        costly: the frames that are asked hold on to their memory.
        unsaid: haste of encoders that leave no note, as in `HASTY`.
        coarser: how much coarser a video is coded than by its steps alone; 0 where that is not known yet.
        lags: how much coarser yet where nothing moves fast, in most frames and in those of kind B.
    """

    costly: ClassVar[bool] = True
    unsaid: tuple[float, float, float] = PATIENT
    coarser: float = 0.0
    lags: Sequence[float] = (1.0, 1.0)

    def look(self, packet: "av.packet.Packet") -> None:
        """At the next packet, before its frames."""
        if not self.coarser:
            self.coarser, *self.lags = _haste(bytes(packet), self.unsaid)

    def tells_of(self, number: int, ended: bool) -> bool:
        """Whether to ask for a frame's steps: of the last ones always, which an encoder spends less on."""
        return ended or number % (ASKED if number < MANY else LATER) == 0

    def lag(self, frame: "av.VideoFrame", last: bool) -> float:
        """How much coarser a frame is yet where nothing moves fast."""
        return max(self.lags[1], LAST) if last else self.lags[frame.pict_type == PictureType.B]

    def steps(self, frame: "av.VideoFrame") -> NDArray | None:
        """Of a frame of 8 bits, (1, 1) or as it is to be shown in squares of 16 px."""
        if frame.format.components[0].bits != 8:
            return None
        rows, columns = (-(-side // MACROBLOCK) for side in (frame.height, frame.width))
        for data in frame.side_data:
            if data.type != SideData.VIDEO_ENC_PARAMS:
                continue
            # FFmpeg's AVVideoEncParams: count, offset and size of the blocks, kind, quantiser; each block ends in its
            # own.
            head = np.frombuffer(data, np.int32, 8)
            count, offset, size, kind, quantiser = (int(head[k]) for k in (0, 2, 4, 6, 7))
            if kind == VP9:
                return _harm("vp9", np.full((1, 1), INDEXED[min(max(quantiser, 0), 255)]))
            if kind not in (H264, MPEG) or count != rows * columns or size % 4:
                continue
            blocks = np.frombuffer(data, np.int32, count * size // 4, offset).reshape(rows, columns, -1)[..., 4]
            if kind == H264:
                steps = self.coarser * np.take(STEPS, blocks + (quantiser + 64), mode="clip")
            else:
                steps = _harm("mpeg4", np.maximum(blocks + quantiser, 1).astype(float))
            return _turned(steps, frame)
        return None


@dataclass
class ByHeaders:
    """What the headers of each packet's pictures say, as FFmpeg spells them out in its log.

    Attributes:
        costly: see `ByDecoder`.
        codec: HEVC or AV1, by FFmpeg's name.
        parameters: the file's own headers.
        speller: reads headers.
        coarser: see `ByDecoder`.
        usual: quantisers of HEVC, by their parameters' number.
        step: of the last packet that said.
    """

    costly: ClassVar[bool] = False
    codec: str
    parameters: bytes
    speller: "av.bitstream.BitStreamFilterContext"
    coarser: float = 0.0
    usual: dict[int, int] = field(default_factory=dict)
    step: float = np.nan

    @classmethod
    def of(cls, stream: "av.video.stream.VideoStream", codec: str) -> "ByHeaders | None":
        """Of a stream that has not been read yet; None where its own headers cannot be read."""
        with av.logging.Capture(local=True) as said:
            try:
                speller = av.bitstream.BitStreamFilterContext("trace_headers", stream)
            except av.FFmpegError:
                return None
        coarseness = cls(codec, stream.codec_context.extradata or b"", speller)
        coarseness._read(said)
        return coarseness

    def look(self, packet: "av.packet.Packet") -> None:
        """At the next packet, before its frames."""
        content = bytes(packet)
        if not self.coarser:
            self.coarser = _haste(self.parameters + content, PATIENT)[0]
        with av.logging.Capture(local=True) as said:
            try:
                self.speller.filter(av.Packet(content))
            except av.FFmpegError:
                return
        self._read(said)

    def tells_of(self, _: int, __: bool) -> bool:
        """Whether to ask for a frame's steps."""
        return bool(np.isfinite(self.step))

    def lag(self, _: "av.VideoFrame", __: bool) -> float:
        """See `ByDecoder`; of these codecs one factor stands for all frames and motions."""
        return 1.0

    def steps(self, frame: "av.VideoFrame") -> NDArray:
        """Of a frame of the last packet, (1, 1)."""
        return self.coarser * _harm(self.codec, np.full((1, 1), self.step))

    def _read(self, said: list[tuple[int, str, str]]) -> None:
        number, steps = 0, []
        for found in (FIELDS.search(line) for _, _, line in said):
            if found is None:
                continue
            name, value = found[1], int(found[2])
            if name.endswith("_pic_parameter_set_id"):
                number = value
            elif name == "init_qp_minus26":
                self.usual[number] = 26 + value
            elif name == "slice_qp_delta":
                steps.append(STEPS[min(max(self.usual.get(number, 26) + value, -64), 63) + 64])
            elif name == "base_q_idx":
                steps.append(INDEXED[min(max(value, 0), 255)])
        if steps:
            self.step = float(np.sqrt(np.mean(np.square(steps))))


def _haste(said: bytes, unsaid: tuple[float, float, float]) -> tuple[float, float, float]:
    """How much coarser a video is than by its steps alone, as `HASTY` has it, by what its encoder said, if anything."""
    found = SEARCHED.search(said)
    if found is None:
        return unsaid
    return next((times for most, times in HASTY[found[1]].items() if int(found[2]) <= most), PATIENT)


def _harm(codec: str, steps: NDArray) -> NDArray:
    """Steps of H.264 that do as much."""
    factor, power = HARM[codec]
    return factor * steps**power


def _turned(steps: NDArray, frame: "av.VideoFrame") -> NDArray:
    """Steps in squares (H / 16, W / 16), as the frame is to be shown."""
    if turns := quarter_turns(frame):
        whole = np.kron(steps, np.ones((MACROBLOCK, MACROBLOCK)))[: frame.height, : frame.width]
        half = MACROBLOCK // 2
        steps = np.rot90(whole, turns)[half::MACROBLOCK, half::MACROBLOCK]
    return steps


Coarseness = ByDecoder | ByHeaders


def coarseness_of(stream: "av.video.stream.VideoStream") -> Coarseness | None:
    """What tells how coarsely a stream was coded that has not been read yet; None where nothing does."""
    codec = stream.codec_context.codec.canonical_name
    if codec in ("hevc", "av1"):
        return ByHeaders.of(stream, codec)
    if codec == "h264":
        return ByDecoder(UNKNOWN)
    return ByDecoder() if codec in ("vp9", "mpeg4") else None
