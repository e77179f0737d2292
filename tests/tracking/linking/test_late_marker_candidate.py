import numpy as np
import pytest
from rafl.tracking.linking.late_marker_candidate import Candidate, Look


def swing(looks: int) -> np.ndarray:
    """Six markers' places, look by look, of a body that swings by 20 px at its end, (looks, 6, 2)."""
    way = 20.0 * np.sin(1.1 * np.arange(looks))[:, None] * np.linspace(0.1, 1.0, 6) ** 2
    return np.stack([np.tile(30.0 * np.arange(6), (looks, 1)), way], axis=-1)


def candidate(place: np.ndarray, rest: np.ndarray) -> Candidate:
    """What such looks come to: places in the picture and on the body, (looks, 2) each."""
    item = Candidate()
    for frame, body in enumerate(swing(len(place))):
        item.looks.append(Look(2 * frame, rest[frame], place[frame], body))
    return item


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("way", [0.1, 0.5])
def test_what_hardly_moves_is_carried_if_it_moves_with_the_body(seed: int, way: float) -> None:
    """By so many pixels, where the others put it to within 4 px only."""
    random = np.random.default_rng(seed)
    ways = way * np.sin(1.1 * np.arange(20))[:, None] * [0.3, 1.0]
    rest = random.normal(0.0, 2.0, (20, 2))
    with_it = candidate(ways + random.normal(0.0, 0.06 * way, ways.shape), rest)
    alone = candidate(random.normal(0.0, 0.7 * way, ways.shape), rest)
    assert with_it.carried()
    assert not alone.carried()


def test_the_farther_it_seems_to_stray_the_more_of_its_way_the_body_must_explain() -> None:
    """The body's end moves by 14 px in the mean square; the others put the dot to within 7.5 px, 5 px, 11 px only."""
    random = np.random.default_rng(6)
    way = 2.0 * np.sin(1.1 * np.arange(30))[:, None] * [0.3, 1.0]
    rest = 7.5 * np.stack([np.cos(2.0 * np.arange(30)), np.sin(2.0 * np.arange(30))], axis=-1)
    close, loose = (way + random.normal(0.0, sigma, way.shape) for sigma in (0.03, 0.25))
    assert candidate(close, rest).carried()
    assert not candidate(loose, rest).carried()
    assert candidate(loose, 0.7 * rest).carried()
    assert not candidate(close, 1.5 * rest).carried()


def test_beside_a_body_that_keeps_still_nothing_is_carried() -> None:
    random = np.random.default_rng(7)
    item = Candidate()
    for frame in range(20):
        item.looks.append(Look(frame, np.zeros(2), random.normal(0.0, 0.3, 2), np.array([[0.0, 0.0], [30.0, 0.0]])))
    assert not item.carried()


def test_what_moves_with_a_body_that_keeps_still_shakes_with_the_camera() -> None:
    item, moving = Candidate(), Candidate()
    for frame in range(20):
        shake = np.array([0.4 * np.sin(1.1 * frame), 0.0])
        body = np.array([[0.0, 0.0], [30.0, 0.0]])
        item.looks.append(Look(frame, np.zeros(2), shake, body + shake))
        moving.looks.append(Look(frame, np.zeros(2), shake, body + 5.0 * shake))
    assert not item.carried()
    assert moving.carried()


def test_what_is_carried_far_is_known_after_a_few_looks() -> None:
    random = np.random.default_rng(1)
    place = swing(6)[:, 5] + [30.0, 0.0]
    rest = random.normal(0.0, 1.0, place.shape)
    assert candidate(place, rest).carried()
    assert not candidate(place[:3], rest[:3]).carried()
    assert not candidate(np.zeros((6, 2)), rest - swing(6)[:, 5]).carried()


def test_what_shakes_with_the_camera_stands_still() -> None:
    random = np.random.default_rng(2)
    still = candidate(random.normal(0.0, 0.3, (40, 2)), random.normal(0.0, 0.5, (40, 2)))
    assert still.still()
    assert still.still(most=3.0)
    assert not still.still(most=0.1)
    assert still.settled()
    assert not candidate(np.zeros((5, 2)), np.zeros((5, 2))).still()


def test_a_dot_is_known_again_by_its_place_on_the_body_or_in_the_picture() -> None:
    item = candidate(np.tile([50.0, 80.0], (4, 1)), np.array([[48.0, 70.0], [52.0, 90.0], [48.0, 70.0], [52.0, 90.0]]))
    assert item.gap(np.array([48.0, 71.0]), np.array([70.0, 80.0])) == pytest.approx(1.0)
    assert item.gap(np.array([48.0, 60.0]), np.array([50.0, 80.0])) == pytest.approx(3.0)
    assert item.gap(np.array([48.0, 40.0]), np.array([50.0, 40.0])) == pytest.approx(30.0)


def test_what_rested_for_long_is_known_soon_after_it_moves() -> None:
    random = np.random.default_rng(3)
    rest = random.normal(0.0, 0.1, (506, 2))
    place = np.concatenate([np.zeros((500, 2)), swing(6)[:, 5] - [150.0, 0.0]])
    assert candidate(place[:500], rest[:500]).settled()
    moved = candidate(place, rest)
    assert moved.carried()
    assert not moved.settled()
    assert len(moved.looks) < 50


def test_a_dot_that_seems_to_move_more_on_the_body_than_in_the_picture_does_not_ride_on_it() -> None:
    body = np.array([[0.0, 0.0], [20.0, 0.0]])
    riding, beside = Candidate(), Candidate()
    for frame in range(10):
        way = np.array([0.0, 8.0 * np.sin(frame)])
        riding.looks.append(Look(frame, np.array([40.0, 0.1 * frame % 2]), np.array([40.0, 0.0]) + way, body + way))
        beside.looks.append(Look(frame, np.array([40.0, 0.0]) - way, np.array([40.0, 0.1 * frame % 2]), body + way))
    assert riding.rides()
    assert not beside.rides()
