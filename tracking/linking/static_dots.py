"""Dots that stay still while the body beside them moves, such as marks on the frame, screws or holes in letters.

They look like markers but carry no information about the body.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rafl.tracking.linking.matching import MarkerPattern
from rafl.tracking.linking.shape_prior import ShapePrior

Array = NDArray[Any]

MAX_STATIC_DISPLACEMENT = 0.05  # a static dot was never farther than this from its first position [spacings]
# A still dot is static if the moving markers predict it this far from its first position:
MIN_DEVIATION_SPACINGS = 0.5
MIN_DEVIATION_SIGMAS = 4.0  # sigmas of the prediction
RECHECK_RATIO = 1.3  # growth of the largest displacement of any marker after which the dots are checked again
MIN_MOVING_MARKERS = 4  # needed to predict the still ones


class StaticDots:
    """The static dots among a recording's markers.

    Attributes:
        mask: the markers found to be static so far, (M).
    """

    def __init__(self, count: int) -> None:
        """Start with `count` markers, none of them static."""
        self.mask = np.zeros(count, bool)
        self._max_displacement = np.zeros(count)  # of each marker from its first position [spacings]
        self._checked_displacement = MIN_DEVIATION_SPACINGS / RECHECK_RATIO  # largest one at the last check [spacings]

    def update(self, positions: Array, seen: NDArray[np.bool_], pattern: MarkerPattern) -> None:
        """Take the next frame into account.

        Args:
            positions: of the markers [px], (M, 2).
            seen: which of them were measured, (M).
            pattern: the markers at rest.
        """
        farthest = _update_displacement(positions, seen, pattern.rest, pattern.spacing, self._max_displacement)
        if farthest < RECHECK_RATIO * self._checked_displacement and not self.mask.any():
            return
        still = self._max_displacement < MAX_STATIC_DISPLACEMENT
        self.mask &= still
        if farthest < RECHECK_RATIO * self._checked_displacement:
            return
        self._checked_displacement = farthest
        still, moving = seen & still, seen & ~still
        if still.any() and moving.sum() >= MIN_MOVING_MARKERS:
            predicted = ShapePrior(pattern.rest).predict(positions, np.where(moving, 0.0, np.inf))
            deviation = np.hypot(*(predicted.position - pattern.rest).T)
            far = deviation > MIN_DEVIATION_SPACINGS * pattern.spacing
            self.mask |= still & far & (deviation > MIN_DEVIATION_SIGMAS * predicted.sigma)

    def add_marker(self) -> None:
        """Add a marker that is not static."""
        self.mask, self._max_displacement = np.append(self.mask, False), np.append(self._max_displacement, 1.0)


@njit(cache=True)
def _update_displacement(
    positions: Array, seen: NDArray[np.bool_], rest: Array, spacing: Array, max_displacement: Array
) -> float:
    """The largest displacement of a visible marker from rest [spacings]. Updates each marker's largest one (M)."""
    farthest = 0.0
    for k in range(len(seen)):
        if seen[k]:
            displacement = np.hypot(positions[k, 0] - rest[k, 0], positions[k, 1] - rest[k, 1]) / spacing[k]
            max_displacement[k] = max(max_displacement[k], displacement)
            farthest = max(farthest, displacement)
    return farthest
