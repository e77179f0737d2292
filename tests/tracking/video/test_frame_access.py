"""A frame asked for by its number is the one that the tracker reads under this number."""

import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support import ramp_frame, write_video

from rafl.tracking.video.frame_access import open_frames
from rafl.tracking.video.reader import open_video

ORDER = [0, 1, 36, 37, 38, 39, 38, 20, 21, 22, 5, 30, 29, 28, 27, 0, 40, 17, -1]


def noisy_frames(count: int = 40) -> list[np.ndarray]:
    random = np.random.default_rng(3)
    return [(ramp_frame(number % 12) + random.integers(0, 20, (64, 96))).astype(np.uint8) for number in range(count)]


def assert_same_frames(path: Path) -> None:
    expected = [frame.image for frame in open_video(path).read()]
    frames = open_frames(open_video(path))
    for number in ORDER:
        found = frames.image(number)
        if 0 <= number < len(expected) and expected[number] is not None:
            np.testing.assert_array_equal(found, expected[number])
        else:
            assert found is None
    frames.close()


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options"),
    [
        ("a.mp4", "libx264", "yuv420p", {"bf": "3", "g": "12"}),
        ("b.mp4", "libx264", "yuv420p", {"x264-params": "open-gop=1:keyint=10:bframes=4"}),
        ("c.ts", "libx264", "yuv420p", {"bf": "2", "g": "8"}),
        ("d.mkv", "libx264", "yuv420p", {"x264-params": "intra-refresh=1:keyint=10"}),
        ("e.mov", "mjpeg", "yuvj420p", {}),
        ("f.avi", "mjpeg", "yuvj420p", {}),
        ("g.avi", "mpeg4", "yuv420p", {"bf": "2"}),
        ("h.mkv", "ffv1", "gray", {}),
        ("i.mp4", "libx265", "yuv420p", {"x265-params": "log-level=none:keyint=10"}),
        ("j.mpg", "mpeg2video", "yuv420p", {"bf": "2"}),
    ],
)
def test_frames_in_any_order(tmp_path: Path, name: str, codec: str, pixels: str, options: dict[str, str]) -> None:
    write_video(tmp_path / name, codec, pixels, rate=50, options=options, frames=noisy_frames())
    assert_same_frames(tmp_path / name)


def test_rotated_file_with_a_variable_frame_rate(tmp_path: Path) -> None:
    """A telephone writes both."""
    path = tmp_path / "a.mp4"
    random = np.random.default_rng(5)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.options = {"bf": "3", "g": "15"}
        stream.codec_context.time_base = Fraction(1, 3000)
        for number, time in enumerate(np.cumsum(random.integers(80, 140, 40))):
            frame = av.VideoFrame.from_ndarray(noisy_frames()[number], format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = int(time), Fraction(1, 3000)
            output.mux(stream.encode(frame))
        output.mux(stream.encode())
    content, one = bytearray(path.read_bytes()), 0x10000
    matrix = content.index(b"tkhd") + 44
    content[matrix : matrix + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 64 * one, 0, 0x40000000)
    path.write_bytes(content)
    assert open_video(path).size == (64, 96)
    assert_same_frames(path)


def test_folder_of_images(tmp_path: Path) -> None:
    for number, image in enumerate(noisy_frames()):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image.astype(np.uint16) * 16)
    (tmp_path / "17.png").write_bytes(b"not an image")
    assert_same_frames(tmp_path)


def test_times_that_do_not_ascend_are_read_in_order(tmp_path: Path) -> None:
    """Two recordings in one file, of which the second begins at time 0 again."""
    for name in ("a.ts", "b.ts"):
        write_video(tmp_path / name, "mpeg2video", "yuv420p", frames=noisy_frames(20))
    path = tmp_path / "both.ts"
    path.write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    assert_same_frames(path)
