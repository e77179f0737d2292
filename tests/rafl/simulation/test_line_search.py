"""Acceptance of trial steps in the line search of Newton's method."""

import numpy as np

from rafl.simulation.line_search import accept_trials, evaluate_start, trial_positions

SPRING = 4.0  # stiffness of every unknown [N/m], in addition to the inertia of 1 kg/s^2
FREE = np.arange(3)


def _elastic(q):
    return 0.5 * SPRING * (q**2).sum(axis=1), (SPRING * q).reshape(-1, 1, 3)


def _try_step(starts, steps, reused):
    """Positions, residuals, readiness of factors and rejection of trial `steps` for springs at `starts` (B, 3)."""
    batch = len(starts)
    zeros, inertia = np.zeros((batch, 3)), np.ones((batch, 3))
    limits = (np.full(batch, SPRING), np.full(batch, 1e-15), np.full(batch, 1e-10), 5.0)
    q, residual, rows = starts.copy(), np.empty((batch, 3)), np.arange(batch)
    energy, largest, ready = np.empty(batch), np.empty(batch), np.ones(batch, dtype=bool)
    evaluate_start(q, *_elastic(q), FREE, inertia, zeros, zeros, energy, residual, largest)
    np.testing.assert_allclose(residual, 5.0 * starts, rtol=1e-15)
    np.testing.assert_allclose(energy, 2.5 * (starts**2).sum(axis=1), rtol=1e-14)
    slope = (steps * residual).sum(axis=1)
    trial = trial_positions(q, rows, FREE, steps, np.ones(batch))
    again = accept_trials(
        trial,
        *_elastic(trial),
        rows,
        reused,
        np.ones(batch),
        slope,
        FREE,
        inertia,
        zeros,
        zeros,
        *limits,
        q,
        energy,
        residual,
        largest,
        ready,
    )
    np.testing.assert_allclose(largest, np.abs(residual).max(axis=1))
    return q, residual, ready, again


def test_step_to_the_minimum_is_accepted():
    starts = np.array([[0.1, -0.2, 0.3], [0.4, 0.1, 0.0]])
    q, residual, ready, again = _try_step(starts, -starts, np.array([True, False]))
    assert (q == 0.0).all()
    assert (residual == 0.0).all()
    assert ready.all()
    assert not again.any()


def test_slow_step_with_a_reused_factor_is_rejected_and_discards_the_factor():
    starts = np.array([[0.1, -0.2, 0.3]])
    q, _, ready, again = _try_step(starts, -0.1 * starts, np.array([True]))
    assert (q == starts).all()
    assert not ready.any()
    assert not again.any()


def test_slow_step_with_a_new_factor_is_accepted_but_the_factor_is_not_kept():
    starts = np.array([[0.1, -0.2, 0.3]])
    q, _, ready, again = _try_step(starts, -0.1 * starts, np.array([False]))
    np.testing.assert_allclose(q, 0.9 * starts, rtol=1e-15)
    assert not ready.any()
    assert not again.any()


def test_overshooting_step_is_repeated_only_with_a_new_factor():
    starts = np.array([[0.1, -0.2, 0.3], [0.1, -0.2, 0.3]])
    q, residual, ready, again = _try_step(starts, -3.0 * starts, np.array([True, False]))
    assert (q == starts).all()
    np.testing.assert_allclose(residual, 5.0 * starts)
    assert again.tolist() == [False, True]
    assert ready.tolist() == [False, True]


def test_nan_trial_is_rejected():
    starts = np.array([[0.1, -0.2, 0.3], [0.1, -0.2, 0.3]])
    q, _, _, again = _try_step(starts, np.full((2, 3), np.nan), np.array([True, False]))
    assert (q == starts).all()
    assert again.tolist() == [False, True]
