"""The dot under the pointer, and its way on."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from filmed import NAMES, RIG, frame_image, positions
from support import SHARED, draw_frame

from rafl.tracking.single_marker import dot_at, follow_on

LEFT = RIG.cameras["left"]
PATH = np.array([LEFT.project(positions(frame)) for frame in range(50)])


def image_of(row: int) -> np.ndarray:
    return frame_image(row, "left", np.random.default_rng(row))


@pytest.mark.parametrize("off", [(0.0, 0.0), (7.0, -5.0), (-3.0, 6.0)])
def test_dot_under_the_pointer(off: tuple[float, float]) -> None:
    found = dot_at(image_of(10), PATH[10, 7] + off, PATH[10])
    assert found is not None
    np.testing.assert_allclose(found.centre, PATH[10, 7], atol=0.1)
    assert found.sigma.max() < 0.1
    assert found.appearance.dark


def test_no_dot_between_dots() -> None:
    assert dot_at(image_of(10), PATH[10, [0, 1, 5, 6]].mean(axis=0), PATH[10]) is None
    assert dot_at(image_of(10), np.array([-500.0, 20.0]), PATH[10]) is None
    assert dot_at(image_of(10), np.array([0.0, 0.0]), np.empty((0, 2))) is None


@pytest.mark.parametrize("dark", [True, False])
def test_dot_without_markers_around(dark: bool) -> None:
    found = dot_at(draw_frame([(60.3, 70.6, 7, 7, 0)], dark=dark, noise=1.0), np.array([62.0, 69.0]), np.empty((0, 2)))
    assert found is not None
    assert found.appearance.dark == dark
    np.testing.assert_allclose(found.centre, [60.3, 70.6], atol=0.05)


def test_follow_a_lost_marker_until_its_track_goes_on() -> None:
    marker = NAMES.index("B5")
    known = PATH.copy()
    known[5:40, marker] = np.nan
    start = dot_at(image_of(5), PATH[5, marker], known[5])
    assert start is not None
    found = list(follow_on(start, marker, known, np.arange(5, 50), image_of))
    assert [row for row, _, _ in found] == list(range(6, 40))
    error = np.array([centre for _, centre, _ in found]) - PATH[6:40, marker]
    assert np.abs(error).max() < 0.15


def test_following_ends_where_the_dot_is_covered_or_another_markers() -> None:
    marker = NAMES.index("B5")
    known = PATH.copy()
    known[:, marker] = np.nan
    start = dot_at(image_of(5), PATH[5, marker], known[5])
    assert start is not None

    def covered(row: int) -> np.ndarray:
        return frame_image(row, "left", np.random.default_rng(row), (marker,) if row >= 12 else ())

    assert [row for row, _, _ in follow_on(start, marker, known, np.arange(5, 50), covered)] == list(range(6, 12))
    known[9:, 0] = PATH[9:, marker]
    assert [row for row, _, _ in follow_on(start, marker, known, np.arange(5, 50), image_of)] == list(range(6, 9))


@pytest.mark.real
def test_dot_on_a_real_frame() -> None:
    path = Path(SHARED) / "real/sway_frame/IMG00001.jpg"
    if not path.exists():
        pytest.skip("../shared/real/sway_frame is absent")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    found = dot_at(image, np.array([625.0, 931.0]), np.empty((0, 2)))
    assert found is not None
    assert np.hypot(*(found.centre - (625, 931))) < 30
