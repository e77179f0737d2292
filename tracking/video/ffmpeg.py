"""Decode packets of a video with FFmpeg, set up to report damage."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from rafl.tracking.video.frame import quarter_turns, scale_to_eight_bits
from rafl.tracking.video.frame_order import DecodedFrame

Array = NDArray[Any]
DecodingResult = tuple["av.packet.Packet", list[DecodedFrame], bool]  # packet, frames it completes, whether damaged

# Decoders report damage only in their log, and with the same words for the next packet. Nothing of it is passed on to
# Python's logging.
av.logging.set_level(av.logging.INFO)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").addHandler(logging.NullHandler())
logging.getLogger("libav").propagate = False
# Decoders report damage instead of concealing it.
DECODER_OPTIONS = {"err_detect": "crccheck+bitstream+buffer+explode"}
# With this message H.264's decoder reports an incomplete image at once; it marks the image only when it outputs it.
CONCEALMENT_MESSAGE = "concealing"
# Encoders of these codecs never write four zero bytes if the file has length fields; lost disk sectors consist of them.
# Decoders may read them without reporting an error.
ZERO_RUN, ZERO_RUN_CODECS = bytes(4), {"h264", "hevc"}


class FFmpegDecoder:
    """FFmpeg's decoder of a stream; it works in one thread, since only then it reports damage."""

    def __init__(self, stream: "av.video.stream.VideoStream") -> None:
        stream.thread_type = "NONE"
        self.context = stream.codec_context
        self.context.thread_count = 1
        # AV1 decoders check the ends of the code only in strict mode.
        self.context.options = DECODER_OPTIONS | ({"strict": "1"} if "av1" in self.context.codec.name else {})
        self.copies = self.context.codec.intra_only
        has_lengths = (self.context.extradata or b"").startswith(b"\1")
        self.checks_zero_runs = self.context.codec.name in ZERO_RUN_CODECS and has_lengths
        self.started = False

    def decode(self, packets: list["av.packet.Packet"]) -> list[DecodingResult]:
        """Decode the next packets: each with the frames that it completes, and whether it is damaged."""
        # All decoding comes before all conversion; alternating, each would evict the other's code from the caches.
        return [self.convert(*each) for each in [(packet, *self.decode_packet(packet)) for packet in packets]]

    def convert(self, packet: "av.packet.Packet", frames: list["av.VideoFrame"], damaged: bool) -> DecodingResult:
        """Extract images from the next packet's frames; any one thread may do this.

        Args:
            packet: the packet.
            frames: those that it completes; the list is emptied.
            damaged: whether the decoder reported damage.
        """
        if self.checks_zero_runs:
            content = bytes(packet)
            # Some programs write zeros after every image.
            self.checks_zero_runs = self.started or not content.endswith(ZERO_RUN)
            damaged |= self.checks_zero_runs and ZERO_RUN in content
        self.started = True
        converted: list[DecodedFrame] = []
        while frames:
            # A decoder that needs no earlier frames is faster if its memory is returned to it early.
            converted.append(_convert_frame(frames.pop(0), self.copies))
        return packet, converted, damaged

    def decode_packet(self, packet: "av.packet.Packet") -> tuple[list["av.VideoFrame"], bool]:
        """Decode a packet to FFmpeg's frames; also return whether FFmpeg reported damage."""
        with av.logging.Capture(local=True) as messages:
            try:
                frames = self.context.decode(packet)
            except av.FFmpegError:
                return [], True
        damaged = any(level <= av.logging.ERROR or text.startswith(CONCEALMENT_MESSAGE) for level, _, text in messages)
        return frames, damaged or packet.is_corrupt


def luma_bytes(frame: "av.VideoFrame") -> int:
    """Size of a frame's first plane [bytes]."""
    return int(frame.planes[0].buffer_size)


def open_container(path: Path) -> "av.container.InputContainer":
    """Open a video file; metadata need not be valid UTF-8."""
    return av.open(str(path), metadata_errors="replace")


def read_packets(
    container: "av.container.InputContainer", stream: "av.video.stream.VideoStream", notes: list[str]
) -> Iterator["av.packet.Packet"]:
    """Yield the stream's packets; if the file is truncated or unreadable, those before, and add a note to `notes`."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except IndexError:  # PyAV raises it for a stream that begins within the file, as damage in .ts can imitate
            packets = container.demux(stream)
            continue
        except (av.FFmpegError, OSError) as error:
            notes.append(f"{container.name}: the file is truncated or damaged ({error})")
            return
        yield packet


def _convert_frame(frame: "av.VideoFrame", copy: bool) -> DecodedFrame:
    return DecodedFrame(frame.pts, None if frame.is_corrupt else grey_image(frame, copy))


def grey_image(frame: "av.VideoFrame", copy: bool) -> Array:
    """Grey image of a frame, rotated for display: its luma plane as stored, or a conversion if it has none.

    Without `copy` the image shares the decoder's memory where possible, which saves a tenth of the decoding time.
    """
    name, bits = frame.format.name, frame.format.components[0].bits
    planar = name.startswith(("yuv4", "yuvj4", "gray", "nv1", "nv2", "p01", "p21", "yuva4")) and not name.endswith("be")
    if planar and bits <= 16 and not name.startswith("grayf"):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8 if bits == 8 else np.uint16).reshape(plane.height, -1)[:, : plane.width]
        # p010 and similar formats store their bits at the upper end.
        high = name.startswith(("p01", "p21"))
        to_array = np.array if copy else np.ascontiguousarray
        image = to_array(rows) if bits == 8 else scale_to_eight_bits(rows, 16 if high else bits)
    elif bits > 8:
        image = scale_to_eight_bits(frame.to_ndarray(format="gray16le"), 16)
    else:
        image = frame.to_ndarray(format="gray")
    turns = quarter_turns(frame)
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image
