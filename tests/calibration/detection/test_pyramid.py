import numpy as np
import pytest

from rafl.calibration.detection.pyramid import refine_corners, search_levels


@pytest.mark.parametrize(
    ("size", "sides"), [((640, 480), [640]), ((1280, 720), [640, 1280]), ((3280, 2464), [820, 1640])]
)
def test_search_runs_from_coarse_to_fine(size: tuple[int, int], sides: list[int]) -> None:
    levels = list(search_levels(np.zeros(size[::-1], np.uint8)))
    assert [max(level.image.shape) for level in levels] == sides
    for level in levels:
        # The first pixel of a copy covers as many pixels of the image as the factor says.
        np.testing.assert_allclose(level.to_image(np.zeros(2)), 0.5 * level.factor - 0.5)


def test_corners_of_four_squares_are_refined() -> None:
    y, x = np.mgrid[:80, :160].astype(float)
    corners = np.array([[38.7, 41.3], [118.7, 41.3]])
    first, second = (np.tanh(x - u) * np.tanh(y - v) for u, v in corners)
    image = np.rint(128 + 60 * np.where(x < 80, first, second)).astype(np.uint8)
    found = refine_corners(image, corners + np.array([[-2.0, 2.0], [1.5, -2.0]]), 0.1)
    np.testing.assert_allclose(found, corners, atol=0.05)
