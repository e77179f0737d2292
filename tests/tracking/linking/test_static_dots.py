"""Dots that keep still beside a body that moves."""

import numpy as np
from rafl.tracking.linking.matching import Pattern
from rafl.tracking.linking.static_dots import Marks

REST = np.stack(np.meshgrid(34.0 * np.arange(6), 30.0 * np.arange(3)), axis=-1).reshape(-1, 2)
BESIDE = np.arange(18) >= 12  # the third row does not belong to the body
EVERYONE = np.ones(18, bool)


def moved(way: float) -> np.ndarray:
    """The first two rows turned about the first column and gone that far."""
    along = REST[:, 0] / 170.0
    place = REST + np.stack([np.zeros(18), way * (0.2 + along)], axis=1)
    return np.where(BESIDE[:, None], REST, place)


def looking(*ways: float, seen: np.ndarray = EVERYONE) -> Marks:
    marks, pattern = Marks(18), Pattern.of(REST)
    for way in ways:
        marks.look(moved(way), seen, pattern)
    return marks


def test_who_stays_where_the_others_would_carry_it_is_a_mark() -> None:
    np.testing.assert_array_equal(looking(5.0, 20.0, 90.0).known, BESIDE)


def test_nobody_is_a_mark_before_anything_moves_far() -> None:
    assert not looking(0.0, 0.5, 3.0, 6.0).known.any()


def test_a_clamped_end_is_no_mark() -> None:
    """It keeps still as marks do; but no neighbours would carry it away."""
    marks, pattern = Marks(18), Pattern.of(REST)
    for way in (10.0, 30.0, 60.0):
        bent = REST + np.stack([np.zeros(18), way * (REST[:, 0] / 170.0) ** 3], axis=1)
        marks.look(bent, EVERYONE, pattern)
    assert not marks.known.any()


def test_who_moves_after_all_is_a_mark_no_more() -> None:
    marks, pattern = looking(20.0, 90.0), Pattern.of(REST)
    off = moved(90.0)
    off[15] += 9.0
    marks.look(off, EVERYONE, pattern)
    np.testing.assert_array_equal(np.flatnonzero(marks.known), [12, 13, 14, 16, 17])


def test_who_is_out_of_sight_is_not_judged() -> None:
    seen = EVERYONE.copy()
    seen[14] = False
    assert not looking(20.0, 90.0, seen=seen).known[14]
