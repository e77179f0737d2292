"""Whether a candidate moves with the body, stays still, or is recognised again."""

import numpy as np
import pytest

from rafl.tracking.linking.late_marker_candidate import Candidate, Observation


def swing(count: int) -> np.ndarray:
    """Positions of six markers in `count` frames, on a body that swings by 20 px at its end [px], (count, 6, 2)."""
    deflection = 20.0 * np.sin(1.1 * np.arange(count))[:, None] * np.linspace(0.1, 1.0, 6) ** 2
    return np.stack([np.tile(30.0 * np.arange(6), (count, 1)), deflection], axis=-1)


def candidate(positions: np.ndarray, rest: np.ndarray) -> Candidate:
    """A candidate observed at positions in the image and on the body at rest [px], (count, 2) each."""
    item = Candidate()
    for frame, body in enumerate(swing(len(positions))):
        item.observations.append(Observation(2 * frame, rest[frame], positions[frame], body))
    return item


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("amplitude", [0.1, 0.5])
def test_small_motion_with_the_body_is_detected(seed: int, amplitude: float) -> None:
    """The amplitude is in px; the position predicted from the others has a sigma of 2 px."""
    random = np.random.default_rng(seed)
    motion = amplitude * np.sin(1.1 * np.arange(20))[:, None] * [0.3, 1.0]
    rest = random.normal(0.0, 2.0, (20, 2))
    attached = candidate(motion + random.normal(0.0, 0.06 * amplitude, motion.shape), rest)
    independent = candidate(random.normal(0.0, 0.7 * amplitude, motion.shape), rest)
    assert attached.moves_with_body()
    assert not independent.moves_with_body()


def test_larger_spread_on_the_body_needs_a_larger_explained_share() -> None:
    """The body's end has a spread of 14 px; the dot's spread on the body is 7.5 px, 5 px or 11 px."""
    random = np.random.default_rng(6)
    motion = 2.0 * np.sin(1.1 * np.arange(30))[:, None] * [0.3, 1.0]
    rest = 7.5 * np.stack([np.cos(2.0 * np.arange(30)), np.sin(2.0 * np.arange(30))], axis=-1)
    precise, noisy = (motion + random.normal(0.0, sigma, motion.shape) for sigma in (0.03, 0.25))
    assert candidate(precise, rest).moves_with_body()
    assert not candidate(noisy, rest).moves_with_body()
    assert candidate(noisy, 0.7 * rest).moves_with_body()
    assert not candidate(precise, 1.5 * rest).moves_with_body()


def test_nothing_moves_with_a_body_that_stays_still() -> None:
    random = np.random.default_rng(7)
    item, body = Candidate(), np.array([[0.0, 0.0], [30.0, 0.0]])
    for frame in range(20):
        item.observations.append(Observation(frame, np.zeros(2), random.normal(0.0, 0.3, 2), body))
    assert not item.moves_with_body()


def test_camera_shake_is_not_motion_with_the_body() -> None:
    static, moving = Candidate(), Candidate()
    for frame in range(20):
        shake = np.array([0.4 * np.sin(1.1 * frame), 0.0])
        body = np.array([[0.0, 0.0], [30.0, 0.0]])
        static.observations.append(Observation(frame, np.zeros(2), shake, body + shake))
        moving.observations.append(Observation(frame, np.zeros(2), shake, body + 5.0 * shake))
    assert not static.moves_with_body()
    assert moving.moves_with_body()


def test_large_motion_with_the_body_is_detected_after_a_few_observations() -> None:
    random = np.random.default_rng(1)
    positions = swing(6)[:, 5] + [30.0, 0.0]
    rest = random.normal(0.0, 1.0, positions.shape)
    assert candidate(positions, rest).moves_with_body()
    assert not candidate(positions[:3], rest[:3]).moves_with_body()
    assert not candidate(np.zeros((6, 2)), rest - swing(6)[:, 5]).moves_with_body()


def test_dot_that_shakes_with_the_camera_is_static() -> None:
    random = np.random.default_rng(2)
    static = candidate(random.normal(0.0, 0.3, (40, 2)), random.normal(0.0, 0.5, (40, 2)))
    assert static.is_long_static()
    assert not candidate(random.normal(0.0, 1.5, (40, 2)), random.normal(0.0, 0.5, (40, 2))).is_long_static()
    assert not candidate(np.zeros((5, 2)), np.zeros((5, 2))).is_long_static()


def test_distance_is_measured_on_the_body_or_in_the_image() -> None:
    item = candidate(np.tile([50.0, 80.0], (4, 1)), np.array([[48.0, 70.0], [52.0, 90.0], [48.0, 70.0], [52.0, 90.0]]))
    assert item.distance_to(np.array([48.0, 71.0]), np.array([70.0, 80.0])) == pytest.approx(1.0)
    assert item.distance_to(np.array([48.0, 60.0]), np.array([50.0, 80.0])) == pytest.approx(3.0)
    assert item.distance_to(np.array([48.0, 40.0]), np.array([50.0, 40.0])) == pytest.approx(30.0)


def test_motion_after_a_long_rest_is_detected_soon() -> None:
    random = np.random.default_rng(3)
    rest = random.normal(0.0, 0.1, (506, 2))
    positions = np.concatenate([np.zeros((500, 2)), swing(6)[:, 5] - [150.0, 0.0]])
    assert candidate(positions[:500], rest[:500]).is_long_static()
    moved = candidate(positions, rest)
    assert moved.moves_with_body()
    assert not moved.is_long_static()
    assert len(moved.observations) < 50


def test_attached_dot_moves_less_on_the_body_than_in_the_image() -> None:
    body = np.array([[0.0, 0.0], [20.0, 0.0]])
    attached, beside = Candidate(), Candidate()
    for frame in range(10):
        motion, still = np.array([0.0, 8.0 * np.sin(frame)]), np.array([40.0, 0.1 * frame % 2])
        attached.observations.append(Observation(frame, still, np.array([40.0, 0.0]) + motion, body + motion))
        beside.observations.append(Observation(frame, np.array([40.0, 0.0]) - motion, still, body + motion))
    assert attached.moves_less_on_body()
    assert not beside.moves_less_on_body()
