"""Frequency, damping and resting place of a marker that swings to rest."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeWarning, curve_fit

Array = NDArray[Any]

SETTLED = 0.1  # of the recording, at its end: what counts as the final equilibrium
EXPLAINED = 0.9  # of the variance: below, a motion is not a damped oscillation
FEWEST = 12  # frames


@dataclass(frozen=True)
class Oscillation:
    """A damped oscillation.

    Attributes:
        frequency: [Hz]; NaN where the motion is none.
        damping: ratio to critical; NaN where the motion is none.
    """

    frequency: float
    damping: float


def oscillation(time: Array, x: Array) -> Oscillation:
    """Of one coordinate over time (T) [s]; NaN values are left out.

    Starts from the poles of the best second-order recursion and fits a decaying cosine about a constant.
    """
    none = Oscillation(np.nan, np.nan)
    known = np.isfinite(x)
    if known.sum() < FEWEST or np.ptp(x[known]) == 0:
        return none
    even = np.interp(time, time[known], x[known])
    step = float(np.median(np.diff(time)))
    design = np.column_stack([even[1:-1], even[:-2], np.ones(len(even) - 2)])
    a, b, _ = np.linalg.lstsq(design, even[2:], rcond=None)[0]
    pole = np.log(complex(np.roots([1.0, -a, -b])[0])) / step
    rate = max(-pole.real, 0.1)
    omega = abs(pole.imag) or np.pi / float(np.ptp(time))

    def model(t: Array, c: float, p: float, q: float, rate: float, omega: float) -> Array:
        decay = np.exp(-rate * (t - time[0]))
        return c + decay * (p * np.cos(omega * (t - time[0])) + q * np.sin(omega * (t - time[0])))

    fastest = np.pi / step
    start = (even[-1], even[0] - even[-1], 0.0, min(rate, 0.9 * fastest), min(omega, 0.9 * fastest))
    bounds = ([-np.inf, -np.inf, -np.inf, 0.0, 0.0], [np.inf, np.inf, np.inf, fastest, fastest])
    try:
        values = curve_fit(model, time[known], x[known], start, bounds=bounds, x_scale="jac", max_nfev=300)[0]
    except (RuntimeError, OptimizeWarning):
        return none
    left = x[known] - model(time[known], *values)
    if left.var() > (1.0 - EXPLAINED) * x[known].var():
        return none
    rate, omega = float(values[3]), abs(float(values[4]))
    return Oscillation(omega / (2 * np.pi), rate / float(np.hypot(rate, omega)))


def liveliest(markers: Array) -> tuple[int, int]:
    """The marker that moves most, and the axis it moves along most, of markers (T, M, 3)."""
    reach = np.nanmax(markers, axis=0) - np.nanmin(markers, axis=0)
    marker, axis = np.unravel_index(np.nanargmax(reach), reach.shape)
    return int(marker), int(axis)


def resting_error(recorded: Array, simulated: Array) -> float:
    """Mean distance [m] between markers' mean places in the last tenth of a recording, both (T, M, 3)."""
    last = max(int(SETTLED * len(recorded)), 1)
    seen = np.isfinite(recorded[-last:, :, 0])
    count = np.maximum(seen.sum(0), 1)[:, None]
    gap = np.where(seen[..., None], simulated[-last:] - recorded[-last:], 0.0).sum(0) / count
    distance = np.linalg.norm(gap, axis=1)[seen.any(0)]
    return float(distance.mean()) if len(distance) else np.nan
