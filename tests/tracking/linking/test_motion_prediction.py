"""Prediction of the next places against motions that each order predicts exactly."""

import numpy as np
import pytest
from rafl.tracking.linking.motion_prediction import Motion

RANDOM = np.random.default_rng(2)
START, VELOCITY, ACCELERATION = RANDOM.uniform(-5.0, 5.0, (3, 7, 2))
SPACING = np.full(7, 30.0)
EVERYBODY = np.ones(7, dtype=bool)
NOBODY = ~EVERYBODY


def followed(path, frames: int) -> Motion:
    """A motion that has seen some frames of a path."""
    motion = Motion(path(0))
    for frame in range(1, frames):
        motion.judge(path(frame), EVERYBODY, SPACING)
        motion.remember(path(frame), NOBODY)
    return motion


def steady(t):
    return START + VELOCITY * t


def speeding(t):
    return steady(t) + 0.5 * ACCELERATION * t**2


def swinging(t):
    return 100.0 * START + 20.0 * VELOCITY * np.cos(0.4 * t) + 20.0 * ACCELERATION * np.sin(0.4 * t)


@pytest.mark.parametrize(("path", "frames", "order"), [(steady, 4, 1), (speeding, 6, 2), (swinging, 40, 3)])
def test_the_order_that_fits_takes_over(path, frames: int, order: int) -> None:
    motion = followed(path, frames)
    assert int(np.argmin(motion.surprise)) == order
    np.testing.assert_allclose(motion.expected(), path(frames), atol=1e-9)


def test_surprise_is_the_root_mean_square_miss_in_spacings() -> None:
    """At rest so far, then every marker but an unseen one jumps by 3 px along x: no order foresaw it."""
    motion = Motion(START)
    motion.remember(START, NOBODY)
    known = np.arange(7) > 0
    jumped = np.where(known[:, None], START + np.array([3.0, 0.0]), np.nan)
    motion.judge(jumped, known, SPACING)
    np.testing.assert_allclose(motion.surprise[:2], 0.1)
    assert np.isinf(motion.surprise[2:]).all()
    motion.judge(START, known, SPACING)
    np.testing.assert_allclose(motion.surprise[:2], 0.07)  # fading
    motion.judge(START, NOBODY, SPACING)
    np.testing.assert_allclose(motion.surprise[:2], 0.07)  # a picture without markers surprises nobody


def test_places_given_out_stay_as_they_were() -> None:
    motion = followed(steady, 4)
    last = motion.last
    kept = last.copy()
    motion.remember(steady(9), NOBODY)
    np.testing.assert_array_equal(last, kept)


def test_a_marker_that_joins_is_predicted_like_the_others() -> None:
    motion = followed(speeding, 6)
    late = np.stack([speeding(t)[0] + 4.0 for t in range(2, 6)])
    motion.join(late)
    np.testing.assert_allclose(motion.expected()[-1], speeding(6)[0] + 4.0, atol=1e-9)


def test_who_comes_back_elsewhere_has_not_jumped() -> None:
    """One was believed 9 px beside its way while it was out of sight: it moves on as the others do."""
    motion = followed(steady, 3)
    beside = np.where(np.arange(7)[:, None] == 2, 9.0, 0.0)
    for frame in (3, 4, 5):
        motion.remember(steady(frame) + beside, NOBODY)
    motion.remember(steady(6), np.arange(7) == 2)
    np.testing.assert_allclose(motion.expected(), steady(7), atol=1e-9)


def test_what_is_forgotten_is_not_predicted_from() -> None:
    motion = followed(swinging, 20)
    motion.forget()
    motion.remember(START, NOBODY)
    np.testing.assert_array_equal(motion.expected(), START)
    assert np.isinf(motion.surprise).all()
