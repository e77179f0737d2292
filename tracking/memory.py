"""The shapes a body was seen in, by which its markers out of sight are placed.

A body swings through the same shapes again and again. A marker that hides is where it was when the others stood as
they do now; from the shape at rest it could only be guessed.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tracking.affine import carry

Array = NDArray[Any]

MOST = 128  # shapes kept; of longer recordings every second, fourth, ... frame's
VOTES = 3  # remembered shapes that place a marker
SHARE = 0.7  # of the markers in sight that a remembered shape must hold


class Memory:
    """Shapes from the recording so far, evenly spread over it, and the shape at rest."""

    def __init__(self, rest: Array) -> None:
        self._shapes = np.full((MOST + 1, *rest.shape), np.nan)
        self._shapes[0] = rest
        self._count = 1
        self._every, self._passed = 1, 0

    def add(self, place: Array, seen: NDArray[np.bool_]) -> None:
        """The places (M, 2) of the markers seen (M) in the next frame."""
        self._passed += 1
        if self._passed < self._every:
            return
        self._passed = 0
        if self._count == len(self._shapes):
            kept = self._shapes[2::2].copy()
            self._shapes[1 : len(kept) + 1] = kept
            self._count = len(kept) + 1
            self._every *= 2
        self._shapes[self._count] = np.where(seen[:, None], place, np.nan)
        self._count += 1

    def join(self, rest: Array) -> None:
        """One more marker, by its place at rest (2)."""
        column = np.full((len(self._shapes), 1, 2), np.nan)
        column[0] = rest
        self._shapes = np.concatenate([self._shapes, column], axis=1)

    def carried(self, position: Array, known: NDArray[np.bool_]) -> Array:
        """Where the markers are (M, 2): the known at their positions, the others where the likest shapes put them."""
        if not known.any() or known.all():
            return position.copy()
        return _carried(self._shapes[: self._count], position, known)


@njit(cache=True, nogil=True)
def _carried(shapes, position, known):  # type: ignore[no-untyped-def]
    """The positions (M, 2) with those not known put where the shapes (S, M, 2), NaN where not seen, lead them."""
    unlike = np.full(len(shapes), np.inf)
    for s in range(len(shapes)):
        number, x, y, square = 0, 0.0, 0.0, 0.0
        for k in range(len(known)):
            if known[k] and not np.isnan(shapes[s, k, 0]):
                dx, dy = shapes[s, k, 0] - position[k, 0], shapes[s, k, 1] - position[k, 1]
                number += 1
                x += dx
                y += dy
                square += dx * dx + dy * dy
        if number >= SHARE * known.sum():
            unlike[s] = (square - (x * x + y * y) / number) / number
    order = np.argsort(unlike)
    result = position.copy()
    for hidden in np.flatnonzero(~known):
        votes, count = np.empty((VOTES, 2)), 0
        for s in order:
            if count == VOTES or unlike[s] == np.inf:
                break
            if not np.isnan(shapes[s, hidden, 0]):
                common = known & ~np.isnan(shapes[s, :, 0])
                votes[count] = carry(shapes[s][common], position[common], shapes[s, hidden : hidden + 1])[0]
                count += 1
        for axis in range(2):
            result[hidden, axis] = np.median(votes[:count, axis])
    return result
