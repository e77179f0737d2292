"""Packets of a video turned into pictures by FFmpeg, so that it owns up to damage."""

import gc
import logging
import re
from collections.abc import Iterator

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from tracking.frame import MACROBLOCK, scaled
from tracking.order import Decoded

Outcome = tuple["av.packet.Packet", list[Decoded], bool]  # the frames that a packet completes, whether it is damaged

# Decoders tell of damage in their log, the same words again for the next packet; what nobody listens to is nobody's
# business.
av.logging.set_level(av.logging.ERROR)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").addHandler(logging.NullHandler())
logging.getLogger("libav").propagate = False
# What makes FFmpeg's decoders report damage instead of painting over it, and how coarsely a picture was coded.
STRICT = {"err_detect": "crccheck+bitstream+buffer+explode", "export_side_data": "venc_params"}
# What H.264 and HEVC never write where a file tells how long their units are, and what lost sectors look like; their
# decoders may read on in silence.
NEVER, WRITERS = bytes(4), {"h264", "hevc"}
H264_PARAMETERS = 1  # FFmpeg's number for the kind of parameters that H.264 has
# Frames of which one is asked how it was coded, and fewer once so many have passed; kinds of frames come in fours and
# twelves. Each answer takes as long as a third of a frame.
ASKED, LATER, MANY = 7, 59, 70
STEPS = 0.625 * 2.0 ** (np.arange(-64, 128) / 6.0)  # by quantiser, from -64
# What x264 says of itself in its first packet, and how much coarser its pictures are than their steps alone would make
# them where it searched no more thoroughly than that (its `subme`). Measured on seven presets at crf 23: in a hurry it
# lets everything lag.
SEARCHED = re.compile(rb"x264 - core.{,400}? subme=(\d{1,2}) ", re.DOTALL)
COARSER = ((2, 2.4), (6, 1.4))


class FFmpegDecoder:
    """FFmpeg's decoder of a stream, in one thread, which is what makes it own up to damage."""

    def __init__(self, stream: "av.video.stream.VideoStream") -> None:
        stream.thread_type = "NONE"
        self.context = stream.codec_context
        self.context.thread_count = 1
        # Decoders of AV1 look at the ends of codes only if they are to be strict.
        self.context.options = STRICT | ({"strict": "1"} if "av1" in self.context.codec.name else {})
        self.copies = self.context.codec.intra_only
        self.tells = self.context.codec.name == "h264"
        self.watched = self.context.codec.name in WRITERS and (self.context.extradata or b"").startswith(b"\1")
        self.begun = False
        self.number = 0
        self.coarser = 0.0  # not known yet

    def decode(self, packets: list["av.packet.Packet"]) -> list[Outcome]:
        """The next packets, each with the frames that it completes, and whether it is damaged."""
        # First all decoding, then all else: each time the one has driven the other's code out of the caches.
        decoded = [(packet, *self.decoded(packet)) for packet in packets]
        return [(each[0], *self._taken(*each)) for each in decoded]

    def _taken(
        self, packet: "av.packet.Packet", frames: list["av.VideoFrame"], complained: bool
    ) -> tuple[list[Decoded], bool]:
        """What is needed of a packet's frames, and whether it is damaged."""
        if self.tells and not self.coarser:
            self.coarser = _coarser(bytes(packet))
        if self.watched:
            content = bytes(packet)
            # Some programs write zeros after every picture.
            self.watched = self.begun or not content.endswith(NEVER)
            complained |= self.watched and NEVER in content
        self.begun = True
        taken = []
        while frames:
            asked = self.tells and self.number % (ASKED if self.number < MANY else LATER) == 0
            # A decoder that needs no earlier pictures works the quicker the sooner it has its memory back.
            taken.append(_taken(frames.pop(0), self.copies or asked, self.coarser if asked else None))
            self.number += 1
            if asked:
                gc.collect(0)  # a frame and its side data hold on to each other, and to the decoder's memory
        return taken, complained

    def decoded(self, packet: "av.packet.Packet") -> tuple[list["av.VideoFrame"], bool]:
        """FFmpeg's frames, and whether it complained."""
        with av.logging.Capture(local=True) as messages:
            try:
                frames = self.context.decode(packet)
            except av.FFmpegError:
                return [], True
        complaints = any(level <= av.logging.ERROR for level, _, _ in messages)
        return frames, complaints or packet.is_corrupt


def packets_of(
    container: "av.container.InputContainer", stream: "av.video.stream.VideoStream", notes: list[str]
) -> Iterator["av.packet.Packet"]:
    """The stream's packets; where the file breaks off, what came before and a note."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (av.FFmpegError, OSError) as error:
            notes.append(f"{container.name}: the file breaks off or is damaged ({error})")
            return
        yield packet


def _taken(frame: "av.VideoFrame", copy: bool, coarser: float | None) -> Decoded:
    """What is needed of a frame; its steps only where `coarser` is given."""
    picture = None if frame.is_corrupt else grey(frame, copy)
    return Decoded(frame.pts, picture, None if coarser is None or picture is None else _steps(frame, coarser))


def quarter_turns(frame: "av.VideoFrame") -> int:
    """How many quarter turns anticlockwise a frame asks to be shown by."""
    return round(frame.rotation / 90.0) % 4


def grey(frame: "av.VideoFrame", copy: bool) -> NDArray:
    """The luma plane as it is stored, or the grey of a format without one, turned as it is to be shown.

    Without `copy` it lies in the decoder's own memory where it can, which takes a tenth of the time of decoding less.
    """
    name, bits = frame.format.name, frame.format.components[0].bits
    planar = name.startswith(("yuv4", "yuvj4", "gray", "nv1", "nv2", "p01", "p21", "yuva4")) and not name.endswith("be")
    if planar and bits <= 16 and not name.startswith("grayf"):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8 if bits == 8 else np.uint16).reshape(plane.height, -1)[:, : plane.width]
        # p010 and its like keep their bits at the upper end.
        high = name.startswith(("p01", "p21"))
        whole = np.array if copy else np.ascontiguousarray
        picture = whole(rows) if bits == 8 else scaled(rows, 16 if high else bits)
    elif bits > 8:
        picture = scaled(frame.to_ndarray(format="gray16le"), 16)
    else:
        picture = frame.to_ndarray(format="gray")
    turns = quarter_turns(frame)
    return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture


def _coarser(packet: bytes) -> float:
    """How much coarser than by its steps alone a video is coded, by what its first packet says of the encoder."""
    said = SEARCHED.search(packet)
    if said is None:
        return 1.0
    return next((times for most, times in COARSER if int(said[1]) <= most), 1.0)


def _steps(frame: "av.VideoFrame", coarser: float) -> NDArray | None:
    """The steps by which an H.264 picture of 8 bits was rounded, so much coarser, turned as it is to be shown."""
    if frame.format.components[0].bits != 8:
        return None
    rows, columns = (-(-side // MACROBLOCK) for side in (frame.height, frame.width))
    for data in frame.side_data:
        if data.type != SideData.VIDEO_ENC_PARAMS:
            continue
        # FFmpeg's AVVideoEncParams: count, offset and size of the blocks, kind, quantiser; each block ends in its own.
        head = np.frombuffer(data, np.int32, 8)
        count, offset, size, kind, quantiser = (int(head[k]) for k in (0, 2, 4, 6, 7))
        if kind != H264_PARAMETERS or count != rows * columns or size % 4:
            continue
        blocks = np.frombuffer(data, np.int32, count * size // 4, offset).reshape(rows, columns, -1)
        steps = np.take(coarser * STEPS, blocks[..., 4] + (quantiser + 64), mode="clip")
        if turns := quarter_turns(frame):
            whole = np.kron(steps, np.ones((MACROBLOCK, MACROBLOCK)))[: frame.height, : frame.width]
            half = MACROBLOCK // 2
            steps = np.rot90(whole, turns)[half::MACROBLOCK, half::MACROBLOCK]
        return steps
    return None
