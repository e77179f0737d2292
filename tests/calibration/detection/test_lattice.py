import numpy as np
import pytest

from rafl.calibration.detection.lattice import Lattice, Node, grow_lattice, place_by_rings, place_by_size

IMAGE = (1000, 800)


def lattice(columns: int, rows: int, corner: tuple[float, float] = (200.0, 200.0), turn: float = 0.0) -> Lattice:
    """Points 50 px apart, numbered from somewhere, in an image turned by an angle [rad] about `corner`."""
    indices = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    cosine, sine = np.cos(turn), np.sin(turn)
    pixels = 50.0 * indices @ np.array([[cosine, sine], [-sine, cosine]]) + corner
    return Lattice(indices + np.array([3, -7]), pixels)


def test_growth_follows_points_and_stops_at_their_end() -> None:
    points = {(x, y) for x in range(6) for y in range(4)} - {(2, 2)}

    def observe(indices: list[tuple[int, int]], nodes: list[Node]) -> np.ndarray:
        rounded = [tuple(np.rint((node.pixel - 100.0) / 30.0).astype(int)) for node in nodes]
        return np.array([100.0 + 30.0 * np.array(r) if r in points else [np.nan, np.nan] for r in rounded])

    start = {(0, 0): Node(np.array([130.0, 130.0]), np.array([[29.0, 1.0], [1.0, 31.0]]))}
    found = Lattice.of(grow_lattice(start, observe))
    assert {(x + 1, y + 1) for x, y in found.indices.tolist()} == points
    np.testing.assert_allclose(found.pixels, 100.0 + 30.0 * (found.indices + 1))


@pytest.mark.parametrize("turn", [0.3, -0.3])
def test_origin_is_the_corner_nearest_the_top_left(turn: float) -> None:
    for found in lattice(5, 3, turn=turn).turned():
        placed, whole = place_by_size(found, (5, 3), IMAGE)
        assert placed is not None
        assert whole
        (first,) = placed.pixels[(placed.indices == 0).all(axis=1)]
        np.testing.assert_allclose(first, (200.0, 200.0), atol=1e-9)


def test_board_of_another_size_is_told_from_a_part_that_the_image_border_cuts() -> None:
    assert place_by_size(lattice(5, 3), (5, 4), IMAGE) == (None, False)
    assert place_by_size(lattice(5, 3), (4, 3), IMAGE) == (None, False)
    placed, whole = place_by_size(lattice(5, 3, corner=(200.0, 30.0)), (5, 4), IMAGE)
    assert placed is not None
    assert not whole


@pytest.mark.parametrize("turn", range(4))
def test_rings_give_the_origin_in_every_orientation(turn: int) -> None:
    found = [*lattice(9, 8).turned()][turn]
    places = 50.0 * np.array([[1, 5], [6, 5], [1, 2]]) + 200.0  # corner, 5 to the right, 3 up
    ringed = np.array([np.abs(places - pixel).sum(axis=1).min() < 1e-6 for pixel in found.pixels])
    placed, known = place_by_rings(found, ringed, (5, -3))
    assert known
    np.testing.assert_allclose(placed.pixels, 50.0 * placed.indices + places[0], atol=1e-9)
    # A second corner would do as well if the others did not contradict it.
    _, known = place_by_rings(found, np.zeros(len(ringed), dtype=bool), (5, -3))
    assert not known
