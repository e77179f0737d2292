import numpy as np
import pytest
from support import draw_frame

from rafl.calibration.board import DotGridPattern

STEP = np.array([[110.0, -8.0], [14.0, 104.0]])  # along x and y [px]
CORNER = np.array([120.0, 640.0])  # of the ringed dots
RINGED = {(0, 0), (5, 0), (0, -3)}


def target(random: np.random.Generator) -> tuple[np.ndarray, dict[tuple[int, int], np.ndarray]]:
    """A target of dots, larger than the image of 1000 x 800 px, and the dots that are wholly inside it."""
    places = {(x, y): CORNER + np.array([x, y]) @ STEP for x in range(-4, 12) for y in range(-9, 5)}
    near = [place for place in places.values() if (place > -15).all() and (place < np.array([1015, 815])).all()]
    dots = [(*place, 20.0, 19.0, 0.3) for place in near]
    image = draw_frame(dots, (1000, 800), blur=1.5, noise=1.5).astype(float)
    rings = [(*places[index], 7.0, 7.0, 0.0) for index in RINGED]
    holes = draw_frame(rings, (1000, 800), dark=False, blur=1.5).astype(float)
    share = np.clip((holes - holes.min()) / (holes.max() - holes.min()), 0, 1)
    image = (1.0 - share) * image + share * 165.0
    image *= np.linspace(1.0, 0.4, 800)[:, None]  # light from above
    inside = {i: p for i, p in places.items() if (p > 22).all() and (p < np.array([977, 777])).all()}
    return np.rint(image).astype(np.uint8), inside


def test_ringed_dots_give_origin_and_axes(random: np.random.Generator) -> None:
    image, inside = target(random)
    pattern = DotGridPattern(kind="dot-grid", rings=(5, -3), spacing_mm=10)
    found = pattern.find(image)
    assert found.origin_known
    indices = [tuple(i) for i in np.rint(found.points / 0.01).astype(int).tolist()]
    assert set(indices) == set(inside)
    errors = found.pixels - [inside[i] for i in indices]
    assert np.sqrt((errors**2).mean()) < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.02
    # Turned by half a turn, the same dots have the same places on the board.
    turned = pattern.find(np.ascontiguousarray(image[::-1, ::-1]))
    assert turned.origin_known
    assert {tuple(i) for i in np.rint(turned.points / 0.01).astype(int).tolist()} == set(inside)


def test_part_of_a_plain_grid_has_no_origin(random: np.random.Generator) -> None:
    image, inside = target(random)
    found = DotGridPattern(kind="dot-grid", dots=(16, 14), spacing_mm=10).find(image)
    assert len(found.points) == len(inside)
    assert not found.origin_known


def test_image_without_dots_gives_no_points() -> None:
    assert (
        len(DotGridPattern(kind="dot-grid", dots=(4, 4), spacing_mm=10).find(np.full((90, 80), 99, np.uint8)).points)
        == 0
    )


@pytest.mark.parametrize("keys", [{}, {"dots": (9, 6), "rings": (5, 3)}, {"rings": (0, 3)}])
def test_description_numbers_the_dots_in_one_way(keys: dict[str, tuple[int, int]]) -> None:
    with pytest.raises(ValueError, match="expected"):
        DotGridPattern(kind="dot-grid", spacing_mm=10, **keys)
