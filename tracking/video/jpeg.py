"""Decode Motion JPEG with libjpeg-turbo, in half of FFmpeg's time, and check JPEG files for damage.

libjpeg-turbo also reports a packet whose code is longer than the image, which FFmpeg does not. Of packets in which
bytes were overwritten, FFmpeg decodes a tenth to wrong images, libjpeg-turbo a fiftieth. Neither may notice a single
flipped bit.
"""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import av
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from rafl.tracking.video.ffmpeg import DecodingResult, FFmpegDecoder, grey_image, open_container, read_packets
from rafl.tracking.video.frame import quarter_turns
from rafl.tracking.video.frame_order import DecodedFrame

PROBE_COUNT = 5  # first packets or files to check; at most one of them may be rejected
MAX_DIFFERENCE = 1.0  # mean absolute difference of two decoders on the same image [grey levels]


def is_intact_jpeg(content: bytes) -> bool:
    """Whether a JPEG file is decoded without an error; takes less than half the time of decoding it in full."""
    try:
        simplejpeg.decode_jpeg(content, "GRAY", min_height=1, min_width=1, min_factor=8)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class JpegDecoder:
    """Decoder of a video whose frames all have one size; any number of threads may share it.

    Attributes:
        shape: of the images as stored, (H, W).
        turns: anticlockwise quarter turns by which they are to be displayed.
    """

    shape: tuple[int, int]
    turns: int

    @classmethod
    def of(cls, path: Path) -> "JpegDecoder | None":
        """Decoder for a video; None if its images differ from FFmpeg's, as with cameras that leave stray bytes."""
        agreed: list[JpegDecoder] = []
        rejected = 0
        with open_container(path) as container:
            stream = container.streams.video[0]
            ffmpeg = FFmpegDecoder(stream)
            for packet in islice(read_packets(container, stream, []), PROBE_COUNT):
                frames, damaged = ffmpeg.decode_packet(packet)
                if damaged or len(frames) != 1:
                    continue
                frame = frames[0]
                decoder = cls((frame.height, frame.width), quarter_turns(frame))
                image = decoder.decode_image(packet)
                if image is None or abs(image.astype(np.int16) - grey_image(frame, copy=False)).mean() > MAX_DIFFERENCE:
                    rejected += 1
                else:
                    agreed.append(decoder)
        return agreed[0] if agreed and rejected <= 1 else None

    def decode(self, packets: list["av.packet.Packet"]) -> list[DecodingResult]:
        """Decode packets: each with its frame, and whether it is damaged."""
        results: list[DecodingResult] = []
        for packet in packets:
            image = self.decode_image(packet) if packet.size and not packet.is_corrupt else None
            frames = [] if image is None else [DecodedFrame(packet.pts, image)]
            results.append((packet, frames, packet.size > 0 and image is None))
        return results

    def decode_image(self, packet: "av.packet.Packet") -> NDArray[np.uint8] | None:
        """Decode the luma plane of a packet, rotated for display; None if it is damaged or of another size."""
        memory = np.empty((*self.shape, 1), np.uint8)
        try:
            decoded = simplejpeg.decode_jpeg(packet, "GRAY", buffer=memory)
        except ValueError:
            return None
        if decoded.shape != memory.shape:
            return None
        return np.ascontiguousarray(np.rot90(memory[..., 0], self.turns))
