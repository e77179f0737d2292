"""Prediction of the next positions against motions that each order predicts exactly."""

from collections.abc import Callable

import numpy as np
import pytest

from rafl.tracking.linking.motion_prediction import MotionPredictor

RANDOM = np.random.default_rng(2)
START, VELOCITY, ACCELERATION = RANDOM.uniform(-5.0, 5.0, (3, 7, 2))
SPACING = np.full(7, 30.0)
ALL = np.ones(7, dtype=bool)
NONE = ~ALL

Path = Callable[[float], np.ndarray]


def followed(path: Path, frames: int) -> MotionPredictor:
    """A predictor after some frames of a path."""
    predictor = MotionPredictor(path(0))
    for frame in range(1, frames):
        predictor.update_errors(path(frame), ALL, SPACING)
        predictor.add_frame(path(frame), NONE)
    return predictor


def uniform(t: float) -> np.ndarray:
    return START + VELOCITY * t


def accelerated(t: float) -> np.ndarray:
    return uniform(t) + 0.5 * ACCELERATION * t**2


def oscillating(t: float) -> np.ndarray:
    return 100.0 * START + 20.0 * VELOCITY * np.cos(0.4 * t) + 20.0 * ACCELERATION * np.sin(0.4 * t)


@pytest.mark.parametrize(("path", "frames", "order"), [(uniform, 4, 1), (accelerated, 6, 2), (oscillating, 40, 3)])
def test_the_order_that_fits_the_motion_is_used(path: Path, frames: int, order: int) -> None:
    predictor = followed(path, frames)
    assert int(np.argmin(predictor.errors)) == order
    np.testing.assert_allclose(predictor.predict(), path(frames), atol=1e-9)


def test_error_is_the_root_mean_square_in_spacings() -> None:
    """The markers are at rest, then all visible ones jump by 3 px along x, which no order predicts."""
    predictor = MotionPredictor(START)
    predictor.add_frame(START, NONE)
    known = np.arange(7) > 0
    jumped = np.where(known[:, None], START + np.array([3.0, 0.0]), np.nan)
    predictor.update_errors(jumped, known, SPACING)
    np.testing.assert_allclose(predictor.errors[:2], 0.1)
    assert np.isinf(predictor.errors[2:]).all()
    predictor.update_errors(START, known, SPACING)
    np.testing.assert_allclose(predictor.errors[:2], 0.07)  # the error decays
    predictor.update_errors(START, NONE, SPACING)
    np.testing.assert_allclose(predictor.errors[:2], 0.07)  # a frame without markers changes nothing


def test_returned_positions_do_not_change_later() -> None:
    predictor = followed(uniform, 4)
    last = predictor.last
    kept = last.copy()
    predictor.add_frame(uniform(9), NONE)
    np.testing.assert_array_equal(last, kept)


def test_added_marker_is_predicted_like_the_others() -> None:
    predictor = followed(accelerated, 6)
    late = np.stack([accelerated(t)[0] + 4.0 for t in range(2, 6)])
    predictor.add_marker(late)
    np.testing.assert_allclose(predictor.predict()[-1], accelerated(6)[0] + 4.0, atol=1e-9)


def test_reappearing_marker_keeps_its_motion() -> None:
    """A hidden marker was predicted 9 px off its path. When it reappears, it goes on as the others do."""
    predictor = followed(uniform, 3)
    offset = np.where(np.arange(7)[:, None] == 2, 9.0, 0.0)
    for frame in (3, 4, 5):
        predictor.add_frame(uniform(frame) + offset, NONE)
    predictor.add_frame(uniform(6), np.arange(7) == 2)
    np.testing.assert_allclose(predictor.predict(), uniform(7), atol=1e-9)


def test_reset_discards_the_motion() -> None:
    predictor = followed(oscillating, 20)
    predictor.reset()
    predictor.add_frame(START, NONE)
    np.testing.assert_array_equal(predictor.predict(), START)
    assert np.isinf(predictor.errors).all()
