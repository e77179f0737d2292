"""Dots that stay still beside a moving body."""

import numpy as np

from rafl.tracking.linking.matching import MarkerPattern
from rafl.tracking.linking.static_dots import StaticDots

REST = np.stack(np.meshgrid(34.0 * np.arange(6), 30.0 * np.arange(3)), axis=-1).reshape(-1, 2)
OFF_BODY = np.arange(18) >= 12  # the third row does not belong to the body
ALL = np.ones(18, bool)


def moved(displacement: float) -> np.ndarray:
    """Positions [px], (18, 2), after the first two rows have moved along y, from 0.2 to 1.2 times `displacement`."""
    along = REST[:, 0] / 170.0
    positions = REST + np.stack([np.zeros(18), displacement * (0.2 + along)], axis=1)
    return np.where(OFF_BODY[:, None], REST, positions)


def after_frames(*displacements: float, seen: np.ndarray = ALL) -> StaticDots:
    """The static dots after frames with the given displacements [px]."""
    static_dots, pattern = StaticDots(18), MarkerPattern.of(REST)
    for displacement in displacements:
        static_dots.update(moved(displacement), seen, pattern)
    return static_dots


def test_still_dots_beside_a_moving_body_are_static() -> None:
    np.testing.assert_array_equal(after_frames(5.0, 20.0, 90.0).mask, OFF_BODY)


def test_no_dot_is_static_before_the_body_moves_far() -> None:
    assert not after_frames(0.0, 0.5, 3.0, 6.0).mask.any()


def test_clamped_end_is_not_static() -> None:
    """It stays still like static dots, but its neighbours do not predict any motion of it."""
    static_dots, pattern = StaticDots(18), MarkerPattern.of(REST)
    for displacement in (10.0, 30.0, 60.0):
        bent = REST + np.stack([np.zeros(18), displacement * (REST[:, 0] / 170.0) ** 3], axis=1)
        static_dots.update(bent, ALL, pattern)
    assert not static_dots.mask.any()


def test_dot_that_moves_later_is_no_longer_static() -> None:
    static_dots, pattern = after_frames(20.0, 90.0), MarkerPattern.of(REST)
    positions = moved(90.0)
    positions[15] += 9.0
    static_dots.update(positions, ALL, pattern)
    np.testing.assert_array_equal(np.flatnonzero(static_dots.mask), [12, 13, 14, 16, 17])


def test_hidden_dot_is_not_classified() -> None:
    seen = ALL.copy()
    seen[14] = False
    assert not after_frames(20.0, 90.0, seen=seen).mask[14]
