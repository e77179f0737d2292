"""Reidentification of dots when part of a body comes back into sight."""

import numpy as np
from support import curled_strip

from rafl.tracking.linking.reidentification import reidentify, unambiguous_dots
from rafl.tracking.linking.shape_prior import PredictedPosition, ShapePrior

SPACING = np.full(14, 30.0)
NONE_CONFIRMED = np.full(14, -1)
PRIOR = ShapePrior(curled_strip(0.0))
for angle in np.linspace(-0.45, 0.45, 31):
    PRIOR.add_shape(curled_strip(angle), np.ones(14, bool))


def test_all_markers_of_a_known_shape_are_reidentified(random: np.random.Generator) -> None:
    for turn in (-0.37, 0.07, 0.41):
        mixed = random.permutation(14)
        match, agreed = reidentify(PRIOR, curled_strip(turn)[mixed], NONE_CONFIRMED, SPACING)
        np.testing.assert_array_equal(mixed[match], np.arange(14))
        assert agreed.all()


def test_a_tip_is_reidentified_from_an_earlier_shape(random: np.random.Generator) -> None:
    """Eight of fourteen dots are visible, far from their rest positions, beside two false detections."""
    shown = random.permutation(np.arange(6, 14))
    dots = np.concatenate([curled_strip(0.4)[shown], [[-50.0, 10.0], [20.0, 170.0]]])
    match, agreed = reidentify(PRIOR, dots, NONE_CONFIRMED, SPACING)
    np.testing.assert_array_equal(np.flatnonzero(agreed), np.arange(6, 14))
    np.testing.assert_array_equal(shown[match[6:]], np.arange(6, 14))


def test_two_dots_alone_are_ambiguous() -> None:
    for pair in range(7):
        match, agreed = reidentify(PRIOR, curled_strip(0.2)[2 * pair : 2 * pair + 2], NONE_CONFIRMED, SPACING)
        assert not agreed.any() or ((agreed & (match >= 0)).sum() == 2 and (np.flatnonzero(agreed) // 2 == pair).all())


def test_an_unknown_shape_is_not_reidentified() -> None:
    dots = curled_strip(0.2)
    dots[:, 1] *= -1.6
    assert not reidentify(PRIOR, dots, NONE_CONFIRMED, SPACING)[1].any()


def test_confirmed_matches_are_kept() -> None:
    dots = curled_strip(0.3)
    confirmed = np.where(np.arange(14) < 4, np.arange(14), -1)
    match, agreed = reidentify(PRIOR, dots, confirmed, SPACING)
    np.testing.assert_array_equal(match, np.arange(14))
    assert agreed.all()


def unambiguous(distance: float, sigma: float, queried: int = 8) -> bool:
    """Whether a dot at this distance from a marker's predicted position is its own; the last six markers are hidden."""
    predicted = PredictedPosition(curled_strip(0.2), np.where(np.arange(14) < 8, 0.0, sigma))
    dots = predicted.position.copy()
    dots[queried] += [distance, 0.0]
    return bool(unambiguous_dots(predicted, dots, np.array([queried]), np.arange(14) >= 8, SPACING)[0])


def test_a_dot_near_its_prediction_and_far_from_others_is_unambiguous() -> None:
    assert unambiguous(0.0, 2.0)
    assert unambiguous(5.0, 4.0)


def test_a_dot_is_ambiguous_if_the_prediction_is_uncertain() -> None:
    assert not unambiguous(0.0, 15.0)


def test_a_dot_is_ambiguous_if_another_marker_is_as_near() -> None:
    assert not unambiguous(14.0, 8.0)


def test_a_dot_too_far_from_the_prediction_is_rejected() -> None:
    assert not unambiguous(14.0, 0.5)
