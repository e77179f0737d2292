"""Hidden markers predicted from earlier shapes, which the prior's generic modes alone cannot represent."""

import numpy as np
import pytest
from support import curled_strip

from rafl.tracking.linking.shape_prior import MAX_SHAPES, ShapePrior

HIDDEN = np.arange(14) >= 8  # the three pairs at the tip
ALL = np.ones(14, bool)


def hidden_errors(prior: ShapePrior, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the hidden markers' predicted positions, and the predicted standard deviations [px], (6)."""
    predicted = prior.predict(np.where(HIDDEN[:, None], np.nan, truth), np.where(HIDDEN, np.inf, 0.0))
    np.testing.assert_array_equal(predicted.position[~HIDDEN], truth[~HIDDEN])
    assert (predicted.sigma[~HIDDEN] == 0.0).all()
    return np.linalg.norm(predicted.position - truth, axis=1)[HIDDEN], predicted.sigma[HIDDEN]


def prior_with(*turns: float) -> ShapePrior:
    prior = ShapePrior(curled_strip(0.0))
    for turn in turns:
        prior.add_shape(curled_strip(turn), ALL)
    return prior


def test_hidden_markers_are_predicted_from_earlier_shapes() -> None:
    error_without, sigma_without = hidden_errors(ShapePrior(curled_strip(0.0)), curled_strip(0.33))
    assert error_without.max() > 5.0
    assert (sigma_without > 0.3 * error_without).all()
    error, sigma = hidden_errors(prior_with(*np.linspace(-0.5, 0.5, 21)), curled_strip(0.33))
    assert error.max() < 0.2 * error_without.max()
    assert (error < 3.0 * sigma).all()
    assert sigma.max() < sigma_without.max()


@pytest.mark.parametrize("turn", [0.05, -0.2])
def test_rigid_motion_needs_no_earlier_shapes(turn: float) -> None:
    cos, sin = np.cos(turn), np.sin(turn)
    truth = curled_strip(0.0) @ np.array([[cos, sin], [-sin, cos]]) + [300.0, -120.0]
    error, sigma = hidden_errors(ShapePrior(curled_strip(0.0)), truth)
    assert error.max() < 1.0
    assert (error < 3.0 * sigma).all()


def test_sigma_grows_with_distance_from_visible_markers() -> None:
    _, sigma = hidden_errors(prior_with(0.0, 0.1, 0.2), curled_strip(0.15))
    assert (np.diff(sigma.reshape(3, 2).mean(axis=1)) > 0.0).all()


def test_sigma_of_never_seen_markers_does_not_fall() -> None:
    """Shapes that show only the other markers do not reduce it, however many there are."""
    prior = ShapePrior(curled_strip(0.0))
    for turn in np.linspace(0.02, 0.4, 40):
        prior.add_shape(curled_strip(turn), ~HIDDEN)
    before = hidden_errors(ShapePrior(curled_strip(0.0)), curled_strip(0.2))[1]
    assert hidden_errors(prior, curled_strip(0.2))[1].min() > 0.5 * before.min()


def test_a_guess_is_weighted_by_its_sigma() -> None:
    prior, truth = prior_with(0.0, 0.1), curled_strip(0.33)

    def largest_error(sigma: float) -> float:
        predicted = prior.predict(truth, np.where(HIDDEN, sigma, 0.0))
        return float(np.linalg.norm(predicted.position - truth, axis=1).max())

    assert largest_error(0.3) < 1.0
    assert largest_error(0.3) < largest_error(3.0) < largest_error(np.inf)
    assert largest_error(np.inf) == hidden_errors(prior, truth)[0].max()


def test_kept_shapes_cover_a_long_recording() -> None:
    """An oscillation grows over 3000 frames. Each of its shapes resembles one of those kept."""
    prior = ShapePrior(curled_strip(0.0))
    frames = 3000
    for t in range(frames):
        prior.add_shape(curled_strip(0.5 * t / frames * np.sin(0.37 * t)), ALL)
    assert 0.5 * MAX_SHAPES <= len(prior) <= MAX_SHAPES
    sigma_without = hidden_errors(ShapePrior(curled_strip(0.0)), curled_strip(0.3))[1].max()
    for turn in (-0.4, -0.2, 0.1, 0.3, 0.45):
        error, sigma = hidden_errors(prior, curled_strip(turn))
        assert error.max() < 1.5
        assert (error < 3.0 * sigma).all()
        assert sigma.max() < 0.2 * sigma_without


def test_a_body_at_rest_gives_one_shape() -> None:
    assert len(prior_with(*([0.1] * 50))) == 1


def test_one_wrong_shape_does_little_harm() -> None:
    prior = prior_with(*np.linspace(-0.4, 0.4, 17))
    wrong = curled_strip(0.33)
    wrong[8:12] = wrong[10:14]  # matched to the next pair, 30 px away
    prior.add_shape(wrong, ALL)
    assert hidden_errors(prior, curled_strip(0.33))[0].max() < 10.0


def test_neighbours_errors_are_correlated() -> None:
    """The last two pairs are hidden. Where one marker is tells more about its neighbour than about the one before."""
    belief = prior_with(0.0, 0.1, 0.2).predict(curled_strip(0.15), np.where(np.arange(14) >= 10, np.inf, 0.0))
    deviation = np.sqrt(np.diag(belief.covariance)[20:])
    correlation = belief.covariance[20:, 20:] / np.outer(deviation, deviation)
    assert np.abs(correlation[4:6, 6:]).max() > 0.8
    np.testing.assert_allclose(belief.sigma[10:], np.hypot(deviation[::2], deviation[1::2]) / np.sqrt(2.0))


def test_an_added_marker_is_predicted_from_the_others() -> None:
    rest = curled_strip(0.0)
    prior = ShapePrior(rest[:-1])
    for turn in np.linspace(0.0, 0.4, 9):
        prior.add_shape(curled_strip(turn)[:-1], ALL[:-1])
    prior = prior.with_marker(rest[-1])
    known = np.where(np.arange(14) < 13, 0.0, np.inf)
    truth = curled_strip(0.3)
    belief = prior.predict(truth, known)
    assert np.linalg.norm(belief.position[-1] - truth[-1]) < 3.0 * belief.sigma[-1] < 30.0
    for turn in np.linspace(0.2, 0.4, 8):
        prior.add_shape(curled_strip(turn), ALL)
    belief = prior.predict(truth, known)
    assert np.linalg.norm(belief.position[-1] - truth[-1]) < min(3.0 * belief.sigma[-1], 0.5)
