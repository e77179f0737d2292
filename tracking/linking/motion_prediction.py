"""Predicting the markers' positions in the next frame from those in the last frames."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

KEPT_FRAMES = 4
# Prediction orders: constant position, constant velocity, constant acceleration, and harmonic oscillation.
ORDER_COUNT = 4
STIFFNESS_DECAY = 0.85  # factor per frame on the sums that give the oscillation's stiffness


class MotionPredictor:
    """The markers' last positions, and the error of each prediction order.

    Attributes:
        positions: in the last frames, newest last [px], (4, M, 2).
        count: number of these frames that are known, the last ones.
        errors: root mean square error of each order [spacings], (4); infinite where unknown.
    """

    def __init__(self, positions: Array) -> None:
        """Start from the positions in the first frame [px], (M, 2)."""
        self.positions = np.tile(positions, (KEPT_FRAMES, 1, 1))
        self.count = 1
        self.errors = np.full(ORDER_COUNT, np.inf)
        self._stiffness_sums = np.zeros(2)  # numerator and denominator of the oscillation's stiffness

    @property
    def last(self) -> Array:
        """The markers' last positions [px], (M, 2)."""
        last: Array = self.positions[-1]
        return last

    def predict(self) -> Array:
        """The markers' next positions by the order with the smallest error [px], (M, 2)."""
        order = int(np.argmin(self.errors))
        predicted: Array = _extrapolate(self.positions, self.count, order, self._stiffness_sums)
        return predicted

    def update_errors(self, found: Array, known: NDArray[np.bool_], spacing: Array) -> None:
        """Update each order's error from the positions in the new frame.

        Args:
            found: positions in the new frame [px], (M, 2).
            known: markers that are visible in the new frame and the one before, (M).
            spacing: of the markers [px], (M).
        """
        if known.any():
            _update_errors(self.positions, self.count, self._stiffness_sums, found, known, spacing, self.errors)

    def reset(self) -> None:
        """Discard the motion so far. The positions stay."""
        self.count = 0
        self.errors[:] = np.inf

    def add_frame(self, positions: Array, reappeared: NDArray[np.bool_]) -> None:
        """Add the new frame's positions, measured or predicted [px], (M, 2).

        If a marker has just reappeared (M), its earlier positions are shifted, so that its predicted motion goes on.
        """
        if reappeared.any():
            self.positions[:, reappeared] += (positions - self.predict())[reappeared]
        self.count = min(self.count + 1, KEPT_FRAMES)
        self.positions = _append_frame(self.positions, self.count, self._stiffness_sums, positions)

    def add_marker(self, positions: Array) -> None:
        """Add a marker by its positions in the last frames [px], (4, 2)."""
        self.positions = np.concatenate([self.positions, positions[:, None]], axis=1)


@njit(cache=True)
def _extrapolate(positions: Array, count: int, order: int, stiffness_sums: Array) -> Array:
    """The markers' next positions, (M, 2), by the given order, or the highest one that `count` frames allow.

    In a free oscillation the acceleration decreases by stiffness times velocity. All markers share one stiffness.
    """
    order = min(order, count - 1)
    stiffness = min(max(stiffness_sums[0] / max(stiffness_sums[1], 1e-12), 0.0), 2.0) if order == 3 else 0.0
    result: Array = positions[-1].copy()
    for marker in range(positions.shape[1]):
        for axis in range(2):
            velocity = positions[-1, marker, axis] - positions[-2, marker, axis]
            previous_velocity = positions[-2, marker, axis] - positions[-3, marker, axis]
            if order > 0:
                result[marker, axis] += velocity
            if order > 1:
                result[marker, axis] += velocity - previous_velocity - stiffness * velocity
    return result


@njit(cache=True)
def _update_errors(
    positions: Array,
    count: int,
    stiffness_sums: Array,
    found: Array,
    known: NDArray[np.bool_],
    spacing: Array,
    errors: Array,
) -> None:
    """Set `errors` (4) to each order's root mean square error, or to its decaying former error where that is larger."""
    for order in range(min(count, ORDER_COUNT)):
        expected = _extrapolate(positions, count, order, stiffness_sums)
        total = 0.0
        for marker in range(len(known)):
            if known[marker]:
                x, y = found[marker, 0] - expected[marker, 0], found[marker, 1] - expected[marker, 1]
                total += (x * x + y * y) / spacing[marker] ** 2
        error = np.sqrt(total / known.sum())
        errors[order] = max(error, 0.7 * errors[order]) if errors[order] < np.inf else error


@njit(cache=True)
def _append_frame(positions: Array, count: int, stiffness_sums: Array, newest: Array) -> Array:
    """The last positions with the newest ones, (M, 2), appended. Updates `stiffness_sums` (2)."""
    result = np.empty_like(positions)
    for marker in range(len(newest)):  # numba takes seconds to compile assignments to slices
        for axis in range(2):
            for frame in range(1, len(positions)):
                result[frame - 1, marker, axis] = positions[frame, marker, axis]
            result[-1, marker, axis] = newest[marker, axis]
    if count == KEPT_FRAMES:
        stiffness_sums *= STIFFNESS_DECAY
        for marker in range(len(newest)):
            for axis in range(2):
                a, b, c, d = result[:, marker, axis]
                stiffness_sums[0] -= (d - 3.0 * c + 3.0 * b - a) * (c - b)
                stiffness_sums[1] += (c - b) ** 2
    return result
