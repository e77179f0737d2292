"""Frequency and damping of a marker whose oscillation decays."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeWarning, curve_fit

Array = NDArray[Any]

REST_SHARE = 0.1  # share of a recording, at its end, in which the markers count as at rest
MIN_EXPLAINED_VARIANCE = 0.9  # share of the variance; below it a motion is not a damped oscillation
MIN_FRAMES = 12  # known frames that the fit needs


@dataclass(frozen=True)
class Oscillation:
    """A damped oscillation.

    Attributes:
        frequency: [Hz]; NaN if the motion is not a damped oscillation.
        damping: ratio to critical damping; NaN if the motion is not a damped oscillation.
    """

    frequency: float
    damping: float


def fit_oscillation(time: Array, x: Array) -> Oscillation:
    """Fit a damped oscillation about a constant to one coordinate x (T) at times (T) [s]. NaN values are left out.

    The start of the fit are the poles of the second-order linear recursion that predicts x best.
    """
    none = Oscillation(np.nan, np.nan)
    known = np.isfinite(x)
    if known.sum() < MIN_FRAMES or np.ptp(x[known]) == 0:
        return none
    interpolated = np.interp(time, time[known], x[known])
    step = float(np.median(np.diff(time)))
    design = np.column_stack([interpolated[1:-1], interpolated[:-2], np.ones(len(interpolated) - 2)])
    a, b, _ = np.linalg.lstsq(design, interpolated[2:], rcond=None)[0]
    pole = np.log(complex(np.roots([1.0, -a, -b])[0])) / step
    rate = max(-pole.real, 0.1)
    omega = abs(pole.imag) or np.pi / float(np.ptp(time))

    def model(t: Array, c: float, p: float, q: float, rate: float, omega: float) -> Array:
        decay = np.exp(-rate * (t - time[0]))
        value: Array = c + decay * (p * np.cos(omega * (t - time[0])) + q * np.sin(omega * (t - time[0])))
        return value

    nyquist = np.pi / step  # [rad/s]
    start = (
        interpolated[-1],
        interpolated[0] - interpolated[-1],
        0.0,
        min(rate, 0.9 * nyquist),
        min(omega, 0.9 * nyquist),
    )
    bounds = ([-np.inf, -np.inf, -np.inf, 0.0, 0.0], [np.inf, np.inf, np.inf, nyquist, nyquist])
    try:
        values = curve_fit(model, time[known], x[known], start, bounds=bounds, x_scale="jac", max_nfev=300)[0]
    except (RuntimeError, OptimizeWarning):
        return none
    residual = x[known] - model(time[known], *values)
    if residual.var() > (1.0 - MIN_EXPLAINED_VARIANCE) * x[known].var():
        return none
    rate, omega = float(values[3]), abs(float(values[4]))
    return Oscillation(omega / (2 * np.pi), rate / float(np.hypot(rate, omega)))


def most_active_coordinate(markers: Array) -> tuple[int, int]:
    """The marker and the axis with the largest range of motion, of markers (T, M, 3)."""
    motion_range = np.fmax.reduce(markers, axis=0) - np.fmin.reduce(markers, axis=0)  # NaN of a marker never seen
    marker, axis = np.unravel_index(np.nanargmax(motion_range), motion_range.shape)
    return int(marker), int(axis)
