"""Which trial steps Newton's method takes over."""

import numpy as np

from rafl.simulation.line_search import begin, judge, moved

SPRING = 4.0  # [N/m], of every unknown, besides the inertia of 1 kg/s^2
FREE = np.arange(3)


def _elastic(q):
    return 0.5 * SPRING * (q**2).sum(axis=1), (SPRING * q).reshape(-1, 1, 3)


def _tried(starts, steps, old):
    """Springs at `starts` (B, 3) that `steps` move: where they end, their residuals, who is ready, who tries again."""
    batch = len(starts)
    none, inertia = np.zeros((batch, 3)), np.ones((batch, 3))
    limits = (np.full(batch, SPRING), np.full(batch, 1e-15), np.full(batch, 1e-10), 5.0)
    q, residual, rows = starts.copy(), np.empty((batch, 3)), np.arange(batch)
    energy, largest, ready = np.empty(batch), np.empty(batch), np.ones(batch, dtype=bool)
    begin(q, *_elastic(q), FREE, inertia, none, none, energy, residual, largest)
    np.testing.assert_allclose(residual, 5.0 * starts, rtol=1e-15)
    np.testing.assert_allclose(energy, 2.5 * (starts**2).sum(axis=1), rtol=1e-14)
    slope = (steps * residual).sum(axis=1)
    trial = moved(q, rows, FREE, steps, np.ones(batch))
    again = judge(
        trial,
        *_elastic(trial),
        rows,
        old,
        np.ones(batch),
        slope,
        FREE,
        inertia,
        none,
        none,
        *limits,
        q,
        energy,
        residual,
        largest,
        ready,
    )
    np.testing.assert_allclose(largest, np.abs(residual).max(axis=1))
    return q, residual, ready, again


def test_step_that_lands_is_taken_over():
    starts = np.array([[0.1, -0.2, 0.3], [0.4, 0.1, 0.0]])
    q, residual, ready, again = _tried(starts, -starts, np.array([True, False]))
    assert (q == 0.0).all()
    assert (residual == 0.0).all()
    assert ready.all()
    assert not again.any()


def test_old_factor_that_hardly_helps_is_given_up_and_the_body_stays():
    starts = np.array([[0.1, -0.2, 0.3]])
    q, _, ready, again = _tried(starts, -0.1 * starts, np.array([True]))
    assert (q == starts).all()
    assert not ready.any()
    assert not again.any()


def test_new_factor_that_hardly_helps_moves_the_body_and_is_not_kept():
    starts = np.array([[0.1, -0.2, 0.3]])
    q, _, ready, again = _tried(starts, -0.1 * starts, np.array([False]))
    np.testing.assert_allclose(q, 0.9 * starts, rtol=1e-15)
    assert not ready.any()
    assert not again.any()


def test_step_too_far_is_tried_again_by_a_new_factor_only():
    starts = np.array([[0.1, -0.2, 0.3], [0.1, -0.2, 0.3]])
    q, residual, ready, again = _tried(starts, -3.0 * starts, np.array([True, False]))
    assert (q == starts).all()
    np.testing.assert_allclose(residual, 5.0 * starts)
    assert again.tolist() == [False, True]
    assert ready.tolist() == [False, True]


def test_trial_without_a_number_is_refused():
    starts = np.array([[0.1, -0.2, 0.3], [0.1, -0.2, 0.3]])
    q, _, _, again = _tried(starts, np.full((2, 3), np.nan), np.array([True, False]))
    assert (q == starts).all()
    assert again.tolist() == [False, True]
