"""Packets of Motion JPEG turned into pictures by libjpeg-turbo, in half of FFmpeg's time, and files looked through.

It also tells when a picture's code is longer than the picture. FFmpeg does not: a tenth of the packets in which bytes
were overwritten come out of it as pictures that are wrong, a fiftieth here. One bit turned may read as valid to both.
"""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import av
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from rafl.tracking.video.ffmpeg import FFmpegDecoder, Outcome, grey, opened, packets_of
from rafl.tracking.video.frame import quarter_turns
from rafl.tracking.video.frame_order import Decoded

PROBED = 5  # first packets or files, of which one may be refused
ROUNDED = 1.0  # grey levels by which two decoders of the same code may differ in the mean


def is_whole(content: bytes) -> bool:
    """Whether a JPEG file is read without complaint; in less than half the time that a picture of it takes."""
    try:
        simplejpeg.decode_jpeg(content, "GRAY", min_height=1, min_width=1, min_factor=8)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class JpegDecoder:
    """The decoder of a video whose pictures are of one size; for as many threads as one likes.

    Attributes:
        shape: of the pictures as they are stored, (H, W).
        turns: quarter turns anticlockwise by which they are to be shown.
    """

    shape: tuple[int, int]
    turns: int

    @classmethod
    def of(cls, path: Path) -> "JpegDecoder | None":
        """For a video that it reads as FFmpeg does; None for others, as some cameras leave bytes where none belong."""
        agreed: list[JpegDecoder] = []
        refused = 0
        with opened(path) as container:
            stream = container.streams.video[0]
            ffmpeg = FFmpegDecoder(stream)
            for packet in islice(packets_of(container, stream, []), PROBED):
                frames, complained = ffmpeg.decoded(packet)
                if complained or len(frames) != 1:
                    continue
                frame = frames[0]
                decoder = cls((frame.height, frame.width), quarter_turns(frame))
                picture = decoder.picture(packet)
                if picture is None or abs(picture.astype(np.int16) - grey(frame, copy=False)).mean() > ROUNDED:
                    refused += 1
                else:
                    agreed.append(decoder)
        return agreed[0] if agreed and refused <= 1 else None

    def decode(self, packets: list["av.packet.Packet"]) -> list[Outcome]:
        """Packets, each with the frame in it, and whether it is damaged."""
        outcomes: list[Outcome] = []
        for packet in packets:
            picture = self.picture(packet) if packet.size and not packet.is_corrupt else None
            frames = [] if picture is None else [Decoded(packet.pts, picture, None)]
            outcomes.append((packet, frames, packet.size > 0 and picture is None))
        return outcomes

    def picture(self, packet: "av.packet.Packet") -> NDArray[np.uint8] | None:
        """Its luma plane, turned as it is to be shown; None where it is not as it should be."""
        memory = np.empty((*self.shape, 1), np.uint8)
        try:
            decoded = simplejpeg.decode_jpeg(packet, "GRAY", buffer=memory)
        except ValueError:
            return None
        if decoded.shape != memory.shape:
            return None
        return np.ascontiguousarray(np.rot90(memory[..., 0], self.turns))
