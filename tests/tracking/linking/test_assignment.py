"""Dots of a frame assigned to markers, given the belief about all of them."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from support import curled_strip

from rafl.tracking.linking import assignment
from rafl.tracking.linking.assignment import assign_dots
from rafl.tracking.linking.shape_prior import Belief, ShapePrior

SPACING = 30.0
DOT_SIGMA = 0.05
UNKNOWN = np.full(14, np.inf)


def assign(
    belief: Belief, dots: np.ndarray, last: np.ndarray | None = None, confirmed: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    count = len(belief.position)
    confirmed = np.full(count, -1) if confirmed is None else confirmed
    last = belief.position if last is None else last
    return assign_dots([belief], dots, np.full(len(dots), DOT_SIGMA), confirmed, last, SPACING)


def grid(columns: int = 9, rows: int = 3) -> np.ndarray:
    x, y = np.meshgrid(40 + SPACING * np.arange(columns), 80 + SPACING * np.arange(rows))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def bent(rest: np.ndarray, angle: float) -> np.ndarray:
    """Bend with constant curvature to `angle` [rad] at the far end; sections stay straight."""
    length = np.ptp(rest[:, 0])
    s = (rest[:, 0] - rest[:, 0].min()) / length
    turn = angle * s
    fine = np.linspace(0, 1, 500)
    line = np.cumsum(np.stack([np.cos(angle * fine), np.sin(angle * fine)], axis=1), axis=0) * length / 500
    middle = np.stack([np.interp(s, fine, line[:, k]) for k in range(2)], axis=1)
    across = rest[:, 1] - rest[:, 1].mean()
    return middle + across[:, None] * np.stack([-np.sin(turn), np.cos(turn)], axis=1) + [60.0, 300.0]


def unknown_motion(before: np.ndarray) -> Belief:
    """The belief about the frame after `before`, if nothing is known about the motion."""
    return ShapePrior(before).predict(before, np.full(len(before), 0.3 * SPACING))


@pytest.mark.parametrize("angle", [0.35, -0.35])
def test_displacements_larger_than_a_spacing(angle: float, random: np.random.Generator) -> None:
    """The motion is unknown, and the tip jumps by more than a spacing."""
    before, after = bent(grid(), 0.1), bent(grid(), 0.1 + angle)
    assert np.linalg.norm(after - before, axis=1).max() > 38
    mixed = random.permutation(27)
    match, certain = assign(unknown_motion(before), after[mixed])
    np.testing.assert_array_equal(mixed[match], np.arange(27))
    assert certain.all()


def test_hidden_and_false_dots() -> None:
    before, after = bent(grid(), 0.0), bent(grid(), 0.25)
    shown = np.delete(np.arange(27), [3, 4, 12, 13, 21])
    dots = np.concatenate([after[shown], [[150.0, 200.0], [300.0, 420.0]]])
    match, _ = assign(unknown_motion(before), dots)
    np.testing.assert_array_equal(np.flatnonzero(match < 0), [3, 4, 12, 13, 21])
    np.testing.assert_array_equal(shown[match[match >= 0]], np.flatnonzero(match >= 0))


def test_static_dots_keep_their_markers() -> None:
    """A row of marks beside the body stays where it is while the body moves by nearly two spacings."""
    body, marks = grid(6, 2), np.stack([40 + 44.0 * np.arange(4), np.full(4, 190.0)], axis=1)
    before = np.concatenate([body, marks])
    dots = np.concatenate([body + np.array([8.0, 50.0]), marks])
    match, _ = assign(unknown_motion(before), dots, before)
    np.testing.assert_array_equal(match, np.arange(16))


@pytest.mark.parametrize("turn", [-0.37, 0.07, 0.41])
def test_all_markers_are_found_again_in_a_known_shape(turn: float, random: np.random.Generator) -> None:
    prior = ShapePrior(curled_strip(0.0))
    for angle in np.linspace(-0.45, 0.45, 31):
        prior.add_shape(curled_strip(angle), np.ones(14, bool))
    mixed = random.permutation(14)
    beliefs = [prior.predict(shape, np.full(14, 15.0)) for shape in prior.sample_shapes(16)]
    dots = curled_strip(turn)[mixed]
    match, certain = assign_dots(beliefs, dots, np.full(14, DOT_SIGMA), np.full(14, -1), beliefs[0].position, SPACING)
    np.testing.assert_array_equal(mixed[match], np.arange(14))
    assert certain.all()


def test_two_dots_alone_are_uncertain() -> None:
    prior = ShapePrior(curled_strip(0.0))
    for pair in range(7):
        _, certain = assign(prior.predict(curled_strip(0.0), UNKNOWN), curled_strip(0.2)[2 * pair : 2 * pair + 2])
        assert not certain.any()


def test_a_shift_by_one_spacing_is_uncertain_without_the_motion() -> None:
    """Seven of nine columns are visible. Only the motion tells which."""
    dots = grid()[(grid()[:, 0] > 60) & (grid()[:, 0] < 260)]
    prior = ShapePrior(grid())
    assert not assign(prior.predict(grid(), np.full(27, np.inf)), dots)[1].any()
    match, certain = assign(prior.predict(grid(), np.full(27, 0.05 * SPACING)), dots)
    np.testing.assert_array_equal(grid()[certain], dots[match[certain]])
    assert certain.sum() == len(dots)


def test_confirmed_dots_decide_about_the_others() -> None:
    dots = curled_strip(0.3)
    confirmed = np.where(np.arange(14) < 4, np.arange(14), -1)
    belief = ShapePrior(curled_strip(0.0)).predict(curled_strip(0.0), UNKNOWN)
    match, certain = assign(belief, dots, confirmed=confirmed)
    np.testing.assert_array_equal(match, np.arange(14))
    assert certain.all()


@pytest.mark.parametrize(("distance", "sigma", "expected"), [(1.0, 1.0, True), (1.0, 30.0, False), (14.0, 1.0, False)])
def test_a_dot_is_certain_near_its_marker_and_far_from_others(distance: float, sigma: float, expected: bool) -> None:
    """The last two markers are hidden, 24 px apart; one dot appears beside one of them."""
    truth = curled_strip(0.2)
    dots = np.concatenate([truth[:12], truth[12:13] + np.array([distance, 0.0])])
    confirmed = np.where(np.arange(14) < 12, np.arange(14), -1)
    covariance = np.zeros((28, 28))
    covariance[range(24, 28), range(24, 28)] = sigma**2
    match, certain = assign(Belief(truth, covariance), dots, confirmed=confirmed)
    assert bool(certain[12] and match[12] == 12) == expected


def test_ratio_is_that_of_the_joint_density(random: np.random.Generator) -> None:
    """Growing a hypothesis marker by marker gives the density of all dots together."""
    root = random.normal(size=(8, 8))
    covariance, mean = root @ root.T + 0.1 * np.eye(8), 100.0 * np.arange(8.0)
    dots = (mean + random.multivariate_normal(np.zeros(8), covariance)).reshape(4, 2)
    variance, log_area = np.full(4, 0.3), 12.0
    match = np.full(4, -1)
    ratio = assignment._grow(
        mean, covariance, dots, variance, np.full((4, 2), np.inf), 0.0, log_area, -1, -1, -np.inf, match
    )
    np.testing.assert_array_equal(match, np.arange(4))
    expected = multivariate_normal(mean, covariance + 0.3 * np.eye(8)).logpdf(dots.ravel())
    assert ratio == pytest.approx(expected + 4 * log_area, rel=1e-9)
