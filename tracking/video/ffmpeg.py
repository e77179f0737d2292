"""Packets of a video turned into pictures by FFmpeg, so that it owns up to damage."""

import gc
import logging
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from rafl.tracking.video.frame import quarter_turns, scaled
from rafl.tracking.video.frame_order import Decoded
from rafl.tracking.video.quantisation import Coarseness, coarseness_of

Outcome = tuple["av.packet.Packet", list[Decoded], bool]  # the frames that a packet completes, whether it is damaged

# Decoders tell of damage in their log, the same words again for the next packet, and readers of headers what these say;
# what nobody listens to is nobody's business.
av.logging.set_level(av.logging.INFO)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").addHandler(logging.NullHandler())
logging.getLogger("libav").propagate = False
# What makes FFmpeg's decoders report damage instead of painting over it, and export how coarsely a picture was coded.
STRICT = {"err_detect": "crccheck+bitstream+buffer+explode", "export_side_data": "venc_params"}
# What the decoder of H.264 says at once of a picture that lacks parts, which it marks as damaged only when it shows it.
PAINTED_OVER = "concealing"
# What H.264 and HEVC never write where a file tells how long their units are, and what lost sectors look like; their
# decoders may read on in silence.
NEVER, WRITERS = bytes(4), {"h264", "hevc"}


class FFmpegDecoder:
    """FFmpeg's decoder of a stream, in one thread, which is what makes it own up to damage."""

    def __init__(self, stream: "av.video.stream.VideoStream") -> None:
        stream.thread_type = "NONE"
        self.context = stream.codec_context
        self.context.thread_count = 1
        # Decoders of AV1 look at the ends of codes only if they are to be strict.
        self.context.options = STRICT | ({"strict": "1"} if "av1" in self.context.codec.name else {})
        self.copies = self.context.codec.intra_only
        self.coarseness = coarseness_of(stream)
        self.watched = self.context.codec.name in WRITERS and (self.context.extradata or b"").startswith(b"\1")
        self.begun = False
        self.number = 0

    def decode(self, packets: list["av.packet.Packet"]) -> list[Outcome]:
        """The next packets, each with the frames that it completes, and whether it is damaged."""
        # First all decoding, then all else: each time the one has driven the other's code out of the caches.
        return [self.taken(*each) for each in [(packet, *self.decoded(packet)) for packet in packets]]

    def taken(self, packet: "av.packet.Packet", frames: list["av.VideoFrame"], complained: bool) -> Outcome:
        """What is needed of the next packet's frames, in whatever thread, and whether it is damaged."""
        if self.coarseness is not None:
            self.coarseness.look(packet)
        if self.watched:
            content = bytes(packet)
            # Some programs write zeros after every picture.
            self.watched = self.begun or not content.endswith(NEVER)
            complained |= self.watched and NEVER in content
        self.begun = True
        taken: list[Decoded] = []
        ended = packet.size == 0
        while frames:
            asked = self.coarseness is not None and self.coarseness.tells_of(self.number, ended)
            told = self.coarseness if asked else None
            costly = told is not None and told.costly
            lag = 1.0 if self.coarseness is None else self.coarseness.lag(frames[0], ended and len(frames) == 1)
            # A decoder that needs no earlier pictures works the quicker the sooner it has its memory back.
            taken.append(_taken(frames.pop(0), self.copies or costly, told, lag))
            self.number += 1
            if costly:
                gc.collect(0)  # a frame and its side data hold on to each other, and to the decoder's memory
        return packet, taken, complained

    def decoded(self, packet: "av.packet.Packet") -> tuple[list["av.VideoFrame"], bool]:
        """FFmpeg's frames, and whether it complained."""
        with av.logging.Capture(local=True) as messages:
            try:
                frames = self.context.decode(packet)
            except av.FFmpegError:
                return [], True
        complaints = any(level <= av.logging.ERROR or text.startswith(PAINTED_OVER) for level, _, text in messages)
        return frames, complaints or packet.is_corrupt


def luma_size(frame: "av.VideoFrame") -> int:
    """Of a frame's first plane [bytes]."""
    return int(frame.planes[0].buffer_size)


def opened(path: Path) -> "av.container.InputContainer":
    """A video file, in whatever letters a camera wrote its name and time."""
    return av.open(str(path), metadata_errors="replace")


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
        except IndexError:  # PyAV's, of a stream that begins amid the file, as damage in .ts makes one seem to
            packets = container.demux(stream)
            continue
        except (av.FFmpegError, OSError) as error:
            notes.append(f"{container.name}: the file breaks off or is damaged ({error})")
            return
        yield packet


def _taken(frame: "av.VideoFrame", copy: bool, told: Coarseness | None, lag: float) -> Decoded:
    """What is needed of a frame; its steps only where something tells of them."""
    picture = None if frame.is_corrupt else grey(frame, copy)
    return Decoded(frame.pts, picture, None if told is None or picture is None else told.steps(frame), lag)


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
