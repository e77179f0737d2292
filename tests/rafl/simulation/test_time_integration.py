"""Time integration of one mass on a spring, compared with the exact motion."""

import numpy as np
import pytest
import torch

from rafl.simulation.time_integration import INTEGRATORS, State

MASS, FREQUENCY = 0.3, 7.7
STIFFNESS = MASS * (2 * np.pi * FREQUENCY) ** 2


def oscillate(name: str, h: float, duration: float, mass_damping: float = 0.0) -> np.ndarray:
    """Positions [m] at 0, h, 2 h, ... of a mass released from rest at 1 m."""
    integrator = INTEGRATORS[name]
    mass = torch.full((1, 1), MASS, dtype=torch.float64)
    alpha = torch.full((1, 1), mass_damping, dtype=torch.float64)
    q = torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64)
    state = State(
        q, torch.zeros_like(q), -STIFFNESS / MASS * q if integrator.uses_acceleration else torch.zeros_like(q)
    )
    found = [1.0]
    for _ in range(round(duration / h)):
        problem = integrator.problem(state, mass, alpha, h)
        x = problem.inertia[..., None] * problem.target / (problem.inertia[..., None] + STIFFNESS)
        state = integrator.advance(state, x, h)
        found.append(float(state.q[0, 0, 0]))
    return np.array(found)


def damping_ratio(q: np.ndarray) -> float:
    """Damping ratio from the decay between the first and the last maximum."""
    inner = q[1:-1]
    peaks = 1 + np.flatnonzero((inner > q[:-2]) & (inner >= q[2:]))
    a, b, c = q[peaks - 1], q[peaks], q[peaks + 1]
    heights = b + (a - c) ** 2 / (8 * (2 * b - a - c))
    return float(np.log(heights[0] / heights[-1]) / (2 * np.pi * (len(heights) - 1)))


@pytest.mark.parametrize(("name", "order"), [("implicit-euler", 1), ("generalised-alpha", 2)])
@pytest.mark.parametrize("mass_damping", [0.0, 4.0])
def test_order_in_time(name: str, order: int, mass_damping: float) -> None:
    """Exact solution q = e^(-a t / 2) (cos w t + a / (2 w) sin w t): halving h divides the error by 2^order."""
    end = 0.2
    decay = 0.5 * mass_damping
    w = np.sqrt(STIFFNESS / MASS - decay**2)
    exact = np.exp(-decay * end) * (np.cos(w * end) + decay / w * np.sin(w * end))
    errors = [abs(oscillate(name, h, end, mass_damping)[-1] - exact) for h in (2e-4, 1e-4, 5e-5)]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(rates, order, atol=0.1)


def test_numerical_damping_at_the_frequency_of_a_real_beam() -> None:
    """7.7 Hz at h = 0.01 s: damping ratio about w h / 2 = 0.24 for implicit Euler, nearly 0 for generalised-alpha."""
    assert 0.15 < damping_ratio(oscillate("implicit-euler", 0.01, 0.5)) < 0.26
    assert abs(damping_ratio(oscillate("generalised-alpha", 0.01, 2.0))) < 0.01


def test_generalised_alpha_halves_the_highest_frequencies_each_step() -> None:
    """With rho_infinity = 0.5 the oscillation of a very stiff spring halves in each step."""
    integrator = INTEGRATORS["generalised-alpha"]
    mass = torch.full((1, 1), MASS, dtype=torch.float64)
    q = torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64)
    state, stiff, size = State(q, 0 * q, -1e12 * q), 1e12 * MASS, []
    for _ in range(40):
        problem = integrator.problem(state, mass, 0 * mass, 0.01)
        x = problem.inertia[..., None] * problem.target / (problem.inertia[..., None] + stiff)
        state = integrator.advance(state, x, 0.01)
        size.append(abs(float(state.q[0, 0, 0])))
    assert (size[-1] / size[-21]) ** (1 / 20) == pytest.approx(0.5, abs=0.05)
