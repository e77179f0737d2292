import numpy as np
import pytest

from rafl.evaluation.oscillation import fit_oscillation, most_active_coordinate

TIME = 0.01 * np.arange(150)


@pytest.mark.parametrize(("frequency", "damping"), [(7.7, 0.03), (2.5, 0.2), (12.0, 0.1)])
def test_noisy_damped_oscillation(frequency: float, damping: float, random: np.random.Generator) -> None:
    omega = 2 * np.pi * frequency
    rate = damping * omega / np.sqrt(1 - damping**2)
    x = 0.02 - 0.01 * np.exp(-rate * TIME) * np.cos(omega * TIME + 0.4) + random.normal(0, 5e-5, TIME.shape)
    x[40:43] = np.nan
    found = fit_oscillation(TIME, x)
    assert found.frequency == pytest.approx(frequency, rel=0.01)
    assert found.damping == pytest.approx(damping, rel=0.05)


def test_other_motions_have_no_frequency_and_damping(random: np.random.Generator) -> None:
    assert np.isnan(fit_oscillation(TIME, random.normal(0, 1.0, TIME.shape)).frequency)
    assert np.isnan(fit_oscillation(TIME, np.zeros_like(TIME)).frequency)
    assert np.isnan(fit_oscillation(TIME[:5], TIME[:5]).damping)


def test_most_active_coordinate() -> None:
    recorded = np.zeros((100, 2, 3))
    recorded[:50, 1, 2] = 0.01
    recorded[90:, 0] = np.nan
    assert most_active_coordinate(recorded) == (1, 2)
