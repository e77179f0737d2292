import cv2
import numpy as np
import pytest

from rafl.calibration.detection.chessboard import find_chessboard

VIEW = np.array([[1.3, 0.15, 280.0], [-0.14, 1.15, 250.0], [1.2e-4, 1e-4, 1.0]])  # board [px of the print] to image
SQUARE = 40.0
CORNERS = (13, 8)


def photograph(random: np.random.Generator, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A chessboard with a light margin before a cluttered background, 1600 x 1200 px, under uneven light."""
    size = (1600, 1200)
    clutter = cv2.resize(random.integers(0, 255, (15, 20), dtype=np.uint8), size, interpolation=cv2.INTER_CUBIC)
    u, v = np.meshgrid(*(np.arange(2 * n) / 2.0 - 0.25 for n in size))
    inverse = np.linalg.inv(VIEW)
    place = np.stack([u - shift[0], v - shift[1], np.ones_like(u)], axis=-1) @ inverse.T
    x, y = np.moveaxis(place[..., :2] / place[..., 2:] / SQUARE, -1, 0)
    columns, rows = CORNERS[0] + 1, CORNERS[1] + 1
    on_sheet = (x > -1) & (y > -1) & (x < columns + 1) & (y < rows + 1)
    dark = (x > 0) & (y > 0) & (x < columns) & (y < rows) & ((np.floor(x) + np.floor(y)) % 2 == 0)
    board = cv2.resize(np.where(dark, 40.0, 180.0) * (0.6 + 0.4 * u / size[0]), size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(on_sheet.astype(float), size, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(share * board + (1.0 - share) * clutter, (0, 0), 1.2)
    return np.clip(np.rint(image + random.normal(0, 2, image.shape)), 0, 255).astype(np.uint8)


def true_pixels(indices: np.ndarray, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Pixels of inner corners, numbered from 0."""
    places = SQUARE * (indices[None] + 1.0)
    return cv2.perspectiveTransform(places.astype(float), VIEW)[0] + shift


@pytest.mark.parametrize("described", [CORNERS, (6, 4), (8, 13)])
def test_all_corners_are_found_whatever_is_described(described: tuple[int, int], random: np.random.Generator) -> None:
    found = find_chessboard(photograph(random), described)
    assert found is not None
    assert sorted(found.size) == sorted(CORNERS)
    expected = true_pixels(np.stack(np.meshgrid(*map(np.arange, CORNERS)), axis=-1).reshape(-1, 2))
    distance = np.linalg.norm(found.pixels[:, None] - expected, axis=2).min(axis=1)
    assert len(found.pixels) == len(expected)
    assert np.sqrt((distance**2).mean()) < 0.05


def test_board_partly_outside_the_image_is_found(random: np.random.Generator) -> None:
    shift = (480.0, -400.0)
    found = find_chessboard(photograph(random, shift), CORNERS)
    assert found is not None
    first = found.from_first_corner()
    expected = true_pixels(np.stack(np.meshgrid(*map(np.arange, CORNERS)), axis=-1).reshape(-1, 2), shift)
    inside = ((expected > 40.0) & (expected < np.array([1560.0, 1160.0]))).all(axis=1)
    assert 30 < inside.sum() < 90
    assert len(first.pixels) >= 0.9 * inside.sum()
    assert np.linalg.norm(found.pixels[:, None] - expected, axis=2).min(axis=1).max() < 0.3


def test_clutter_without_a_board_gives_nothing(random: np.random.Generator) -> None:
    clutter = cv2.resize(random.integers(0, 255, (45, 60), dtype=np.uint8), (1200, 900), interpolation=cv2.INTER_CUBIC)
    assert find_chessboard(clutter, CORNERS) is None
