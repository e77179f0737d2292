import numpy as np
import pytest

from rafl.evaluation.oscillation import liveliest, oscillation, resting_error

TIME = 0.01 * np.arange(150)


@pytest.mark.parametrize(("frequency", "damping"), [(7.7, 0.03), (2.5, 0.2), (12.0, 0.1)])
def test_a_damped_oscillation(frequency: float, damping: float, random: np.random.Generator) -> None:
    omega = 2 * np.pi * frequency
    rate = damping * omega / np.sqrt(1 - damping**2)
    x = 0.02 - 0.01 * np.exp(-rate * TIME) * np.cos(omega * TIME + 0.4) + random.normal(0, 5e-5, TIME.shape)
    x[40:43] = np.nan
    found = oscillation(TIME, x)
    assert found.frequency == pytest.approx(frequency, rel=0.01)
    assert found.damping == pytest.approx(damping, rel=0.05)


def test_what_is_no_oscillation_has_no_frequency(random: np.random.Generator) -> None:
    assert np.isnan(oscillation(TIME, random.normal(0, 1.0, TIME.shape)).frequency)
    assert np.isnan(oscillation(TIME, np.zeros_like(TIME)).frequency)
    assert np.isnan(oscillation(TIME[:5], TIME[:5]).damping)


def test_resting_error_and_liveliest() -> None:
    """The second marker rests 3 mm off; the first is not seen at the end and does not count."""
    recorded = np.zeros((100, 2, 3))
    recorded[:50, 1, 2] = 0.01
    recorded[90:, 0] = np.nan
    simulated = np.nan_to_num(recorded) + np.array([0.0, 0.003, 0.0])
    assert resting_error(recorded, simulated) == pytest.approx(0.003)
    assert liveliest(recorded) == (1, 2)
