"""Quantisation steps of a video's frames, from the decoder or from the packets' headers.

Steps of other codecs are converted to the H.264 step that causes the same error in a dot's position. The noise model in
`rafl.tracking.reconstruction.uncertainty` was measured with H.264.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from av.video.frame import PictureType
from numpy.typing import NDArray

from rafl.tracking.video.frame import MACROBLOCK_PX, quarter_turns

Array = NDArray[Any]

# Quantisation steps [grey levels]. Of H.264 and HEVC by quantiser from -64: they double every six. Of AV1 and VP9 by
# index: linear between knots.
H26X_STEPS = 0.625 * 2.0 ** (np.arange(-64, 128) / 6.0)
INDEX_KNOTS, STEPS_AT_KNOTS = [0, 1, 95, 120, 137, 150, 200, 255], [4, 8, 102, 152, 203, 255, 639, 1828]
INDEXED_STEPS = np.interp(np.arange(256), INDEX_KNOTS, STEPS_AT_KNOTS) / 8.0
# FFmpeg's numbers for the types of encoding parameters that its decoders export.
VP9_PARAMETERS, H264_PARAMETERS, MPEG2_PARAMETERS = 0, 1, 2
# (factor, power): a step s of the codec is equivalent to the H.264 step factor * s**power. Powers were measured on 14
# to 20 videos each, mostly like those for H.264: x265 at crf 16 to 28, SVT-AV1 at 18 to 42, libvpx at 20 to 42,
# FFmpeg's MPEG-4 at 2 to 8. Factors were measured on 16 videos each, of bodies that move in any direction.
STEP_EQUIVALENTS = {"hevc": (0.17, 1.48), "av1": (5.0, 0.4), "vp9": (0.64, 0.85), "mpeg4": (1.55, 1.08)}
# The note that x264 and x265 write about their settings, with the thoroughness of the motion search (`subme`).
ENCODER_NOTE = re.compile(rb"x26([45]) [(-].{,1500}? subme=(\d{1,2}) ", re.DOTALL)
# Encoder preset factors: by how much an image is coarser than its steps alone would make it. The first applies
# everywhere. The others apply to slow motion, which fast presets let lag: the second in most frames, the third in B
# frames, which are predicted from frames before and after. Each row applies up to the `subme` that is its key. Measured
# on seven presets of x264 and four of x265 at crf 23; slow motion on 48 videos of four presets of x264, `veryfast` at
# crf 18 and 28 too.
PRESET_FACTORS = {
    b"4": {0: (2.4, 1.0, 1.0), 2: (1.0, 1.8, 3.9), 6: (1.2, 1.0, 1.4)},
    b"5": {0: (2.3, 1.0, 1.0), 1: (1.4, 1.0, 1.0)},
}
# Of thorough presets, and of H.264 without a note. The latter are half way between those of fast and thorough presets,
# so that sigma is wrong by less than a factor of 2 in either direction.
THOROUGH_FACTORS, UNKNOWN_FACTORS = (1.0, 1.0, 1.0), (1.2, 1.2, 1.5)
# Smallest lag factor of a video's last frame, to which no other frame refers. Measured on 25 videos with x264's medium
# preset; with `veryfast` the last frame is like B frames.
LAST_FRAME_FACTOR = 2.0
# The steps of one in SAMPLING_INTERVAL frames are read, and from frame LATE_FRAME on of one in LATE_SAMPLING_INTERVAL.
# Neither shares a factor with 4 and 12, the periods of frame types. Reading takes a third of the time of a frame. A
# dozen samples are too few for the usual step of a short video.
SAMPLING_INTERVAL, LATE_SAMPLING_INTERVAL, LATE_FRAME = 5, 113, 100
HEADER_FIELD = re.compile(r"\b(\w+_parameter_set_id|init_qp_minus26|slice_qp_delta|base_q_idx) .*= (-?\d+)\s*$")


@dataclass
class QuantisationFromDecoder:
    """Reads the steps that decoders export for the blocks they decode.

    Attributes:
        holds_memory: sampled frames keep the decoder's memory in use.
        default_factors: encoder preset factors if the encoder leaves no note, as in `PRESET_FACTORS`.
        preset_factor: first of the encoder preset factors; 0 until the first packet is read.
        lag_factors: the other two, for most frames and for B frames.
    """

    holds_memory: ClassVar[bool] = True
    default_factors: tuple[float, float, float] = THOROUGH_FACTORS
    preset_factor: float = 0.0
    lag_factors: Sequence[float] = (1.0, 1.0)

    def read_packet(self, packet: "av.packet.Packet") -> None:
        """Read the next packet; must be called before its frames are read."""
        if not self.preset_factor:
            self.preset_factor, *self.lag_factors = _encoder_preset_factors(bytes(packet), self.default_factors)

    def is_sampled(self, number: int, ended: bool) -> bool:
        """Whether to read the steps of frame `number`.

        At the stream's end (`ended`) every frame is sampled, as encoders spend less on the last frames.
        """
        return ended or number % (SAMPLING_INTERVAL if number < LATE_FRAME else LATE_SAMPLING_INTERVAL) == 0

    def lag_factor(self, frame: "av.VideoFrame", last: bool) -> float:
        """Factor by which slow motion is coarser in a frame; `last` means that it is the video's last frame."""
        if last:
            return max(self.lag_factors[1], LAST_FRAME_FACTOR)
        factor: float = self.lag_factors[frame.pict_type == PictureType.B]
        return factor

    def equivalent_steps(self, frame: "av.VideoFrame") -> Array | None:
        """Equivalent H.264 steps of a frame [grey levels].

        The shape is (1, 1), or that of the frame's 16 px squares, rotated for display. None if the frame has no steps
        or more than 8 bits.
        """
        if frame.format.components[0].bits != 8:
            return None
        rows, columns = (-(-side // MACROBLOCK_PX) for side in (frame.height, frame.width))
        for data in frame.side_data:
            if data.type != SideData.VIDEO_ENC_PARAMS:
                continue
            # FFmpeg's AVVideoEncParams: number, offset and size of the blocks, type, quantiser. Each block ends with
            # its own quantiser.
            head = np.frombuffer(data, np.int32, 8)
            count, offset, size, kind, quantiser = (int(head[k]) for k in (0, 2, 4, 6, 7))
            if kind == VP9_PARAMETERS:
                return _equivalent_steps("vp9", np.full((1, 1), INDEXED_STEPS[min(max(quantiser, 0), 255)]))
            if kind not in (H264_PARAMETERS, MPEG2_PARAMETERS) or count != rows * columns or size % 4:
                continue
            blocks = np.frombuffer(data, np.int32, count * size // 4, offset).reshape(rows, columns, -1)[..., 4]
            if kind == H264_PARAMETERS:
                steps = self.preset_factor * np.take(H26X_STEPS, blocks + (quantiser + 64), mode="clip")
            else:
                steps = _equivalent_steps("mpeg4", np.maximum(blocks + quantiser, 1).astype(float))
            return _rotate(steps, frame)
        return None


@dataclass
class QuantisationFromHeaders:
    """Reads the step of each packet from its headers, which FFmpeg writes to its log as text.

    Attributes:
        holds_memory: see `QuantisationFromDecoder`.
        codec: hevc or av1.
        extradata: the file's own headers.
        header_filter: FFmpeg's filter that writes headers to the log.
        preset_factor: see `QuantisationFromDecoder`.
        initial_quantisers: of HEVC, by the number of the parameter set.
        step: of the last packet that contains one [grey levels].
    """

    holds_memory: ClassVar[bool] = False
    codec: str
    extradata: bytes
    header_filter: "av.bitstream.BitStreamFilterContext"
    preset_factor: float = 0.0
    initial_quantisers: dict[int, int] = field(default_factory=dict)
    step: float = np.nan

    @classmethod
    def of(cls, stream: "av.video.stream.VideoStream", codec: str) -> "QuantisationFromHeaders | None":
        """Reader for a stream from which no packet has been read; None if FFmpeg cannot read its headers."""
        with av.logging.Capture(local=True) as messages:
            try:
                header_filter = av.bitstream.BitStreamFilterContext("trace_headers", stream)
            except av.FFmpegError:
                return None
        reader = cls(codec, stream.codec_context.extradata or b"", header_filter)
        reader._read_headers(messages)
        return reader

    def read_packet(self, packet: "av.packet.Packet") -> None:
        """Read the next packet; must be called before its frames are read."""
        content = bytes(packet)
        if not self.preset_factor:
            self.preset_factor = _encoder_preset_factors(self.extradata + content, THOROUGH_FACTORS)[0]
        with av.logging.Capture(local=True) as messages:
            try:
                self.header_filter.filter(av.Packet(content))
            except av.FFmpegError:
                return
        self._read_headers(messages)

    def is_sampled(self, _: int, __: bool) -> bool:
        """Whether the step is known."""
        return bool(np.isfinite(self.step))

    def lag_factor(self, _: "av.VideoFrame", __: bool) -> float:
        """See `QuantisationFromDecoder`; for these codecs one factor covers all frames and motions."""
        return 1.0

    def equivalent_steps(self, frame: "av.VideoFrame") -> Array:
        """Equivalent H.264 step of a frame of the last packet [grey levels], (1, 1)."""
        return self.preset_factor * _equivalent_steps(self.codec, np.full((1, 1), self.step))

    def _read_headers(self, messages: list[tuple[int, str, str]]) -> None:
        number, steps = 0, []
        for found in (HEADER_FIELD.search(text) for _, _, text in messages):
            if found is None:
                continue
            name, value = found[1], int(found[2])
            if name.endswith("_pic_parameter_set_id"):
                number = value
            elif name == "init_qp_minus26":
                self.initial_quantisers[number] = 26 + value
            elif name == "slice_qp_delta":
                steps.append(H26X_STEPS[min(max(self.initial_quantisers.get(number, 26) + value, -64), 63) + 64])
            elif name == "base_q_idx":
                steps.append(INDEXED_STEPS[min(max(value, 0), 255)])
        if steps:
            self.step = float(np.sqrt(np.mean(np.square(steps))))


def _encoder_preset_factors(content: bytes, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Encoder preset factors, as in `PRESET_FACTORS`, from the encoder's note in `content`; `default` without one."""
    found = ENCODER_NOTE.search(content)
    if found is None:
        return default
    rows = PRESET_FACTORS[found[1]].items()
    return next((factors for max_subme, factors in rows if int(found[2]) <= max_subme), THOROUGH_FACTORS)


def _equivalent_steps(codec: str, steps: Array) -> Array:
    """Steps of H.264 that cause the same error as steps of a codec [grey levels]."""
    factor, power = STEP_EQUIVALENTS[codec]
    equivalent: Array = factor * steps**power
    return equivalent


def _rotate(steps: Array, frame: "av.VideoFrame") -> Array:
    """Rotate steps of 16 px squares, (H / 16, W / 16), as the frame is rotated for display."""
    if turns := quarter_turns(frame):
        per_pixel = np.kron(steps, np.ones((MACROBLOCK_PX, MACROBLOCK_PX)))[: frame.height, : frame.width]
        half = MACROBLOCK_PX // 2
        steps = np.rot90(per_pixel, turns)[half::MACROBLOCK_PX, half::MACROBLOCK_PX]
    return steps


QuantisationReader = QuantisationFromDecoder | QuantisationFromHeaders


def quantisation_reader_of(stream: "av.video.stream.VideoStream") -> QuantisationReader | None:
    """Reader for a stream from which no packet has been read; None if the codec gives no quantisation steps."""
    codec = stream.codec_context.codec.canonical_name
    if codec in ("hevc", "av1"):
        return QuantisationFromHeaders.of(stream, codec)
    if codec == "h264":
        return QuantisationFromDecoder(UNKNOWN_FACTORS)
    return QuantisationFromDecoder() if codec in ("vp9", "mpeg4") else None
