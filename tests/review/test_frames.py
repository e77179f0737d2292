"""The images that are served are the frames that the tracker reads, whatever the file is like."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import simplejpeg
from filmed import frame_image, read_counter, write_film
from support import SHARED

from rafl.review.tracks.frames import FrameStore
from rafl.tracking.single_marker import dot_at, follow_on
from rafl.tracking.video.reader import open_video

SWAY = SHARED / "real/sway_frame"


def decoded(content: bytes | None) -> np.ndarray:
    assert content is not None
    return np.asarray(simplejpeg.decode_jpeg(content, "GRAY")[..., 0])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("uneven", [False, True])
def test_counter_in_the_image(tmp_path: Path, turned: bool, uneven: bool) -> None:
    """H.264 with B frames, at even and uneven times, also from a telephone that was held upright."""
    path, random = tmp_path / "a.mp4", np.random.default_rng(2)
    times = np.cumsum(random.integers(120, 400, 60)) if uneven else None
    write_film(path, [frame_image(frame, "left", random) for frame in range(60)], times)
    if turned:  # a display matrix of a clockwise quarter turn
        content, one = bytearray(path.read_bytes()), 0x10000
        matrix = content.index(b"tkhd") + 44
        content[matrix : matrix + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 320 * one, 0, 0x40000000)
        path.write_bytes(content)
    store = FrameStore(open_video(path))
    tracked = [frame.image for frame in open_video(path).read()]
    for number in (0, 1, 2, 59, 30, 31, 29, 28, 5, 58):
        image = decoded(store.jpeg(number))
        assert image.shape == ((400, 320) if turned else (320, 400))
        assert read_counter(np.rot90(image) if turned else image) == number
        np.testing.assert_array_equal(store.image(number), tracked[number])
    assert store.jpeg(60) is None
    store.close()


@pytest.mark.real
@pytest.mark.skipif(not SWAY.is_dir(), reason="../shared/real/sway_frame is absent")
def test_real_images() -> None:
    """A dot of a laboratory's recording is fitted under the pointer and followed on."""
    store = FrameStore(open_video(SWAY))
    paths = sorted(SWAY.glob("*.jpg"))
    np.testing.assert_array_equal(store.image(40), cv2.imread(str(paths[40]), cv2.IMREAD_GRAYSCALE))
    image = store.image(0)
    assert image is not None
    start = dot_at(image, np.array([630.0, 940.0]), np.empty((0, 2)))
    assert start is not None
    found = list(follow_on(start, 0, np.full((12, 1, 2), np.nan), np.arange(12), store.image))
    assert [row for row, _, _ in found] == list(range(1, 12))
    assert np.abs([centre - start.centre for _, centre, _ in found]).max() < 30.0
    store.close()
