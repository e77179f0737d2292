import numpy as np
import pytest

from rafl.evaluation.oscillation import fit_oscillation, most_active_coordinate, rest_position_error

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


def test_rest_position_error_and_most_active_coordinate() -> None:
    """The rest position of the second marker is 3 mm off. The first is not seen at the end and does not count."""
    recorded = np.zeros((100, 2, 3))
    recorded[:50, 1, 2] = 0.01
    recorded[90:, 0] = np.nan
    simulated = np.nan_to_num(recorded) + np.array([0.0, 0.003, 0.0])
    assert rest_position_error(recorded, simulated) == pytest.approx(0.003)
    assert most_active_coordinate(recorded) == (1, 2)
