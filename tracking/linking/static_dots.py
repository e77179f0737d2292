"""Dots that keep still while the body beside them moves: marks on the frame, screws, letters' holes.

They look like markers, but where the body is they do not tell.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rafl.tracking.linking.matching import Pattern
from rafl.tracking.linking.shape_prior import Memory

Array = NDArray[Any]

STILL = 0.05  # spacings: who never was farther from its first place may be a mark
LEFT_BEHIND = 0.5  # spacings: who keeps still so far from where the others would carry it is one
BEYOND_DOUBT = 4.0  # standard deviations: likewise
FARTHER = 1.3  # times as far as at the last look the body must have gone, for another look
FEWEST = 4  # moving markers that carry others


class Marks:
    """Which of a recording's markers are marks, as far as the motion has shown.

    Attributes:
        known: (M).
    """

    def __init__(self, count: int) -> None:
        self.known = np.zeros(count, bool)
        self._way = np.zeros(count)  # the farthest that each was from its first place [spacings]
        self._looked = LEFT_BEHIND / FARTHER  # how far the body had gone then [spacings]

    def look(self, place: Array, seen: NDArray[np.bool_], pattern: Pattern) -> None:
        """At the places [px], (M, 2), of the markers seen (M) in the next picture."""
        farthest = _go(place, seen, pattern.rest, pattern.spacing, self._way)
        if farthest < FARTHER * self._looked and not self.known.any():
            return
        still = self._way < STILL
        self.known &= still
        if farthest < FARTHER * self._looked:
            return
        self._looked = farthest
        still, moving = seen & still, seen & ~still
        if still.any() and moving.sum() >= FEWEST:
            belief = Memory(pattern.rest).carried(place, moving)
            left = np.hypot(*(belief.place - pattern.rest).T)
            self.known |= still & (left > LEFT_BEHIND * pattern.spacing) & (left > BEYOND_DOUBT * belief.sigma)

    def join(self) -> None:
        """One more marker, which is none."""
        self.known, self._way = np.append(self.known, False), np.append(self._way, 1.0)


@njit(cache=True)
def _go(place, seen, rest, spacing, way):
    """The farthest that a marker is from its first place [spacings]; way (M) becomes at least what each one's is."""
    farthest = 0.0
    for k in range(len(seen)):
        if seen[k]:
            away = np.hypot(place[k, 0] - rest[k, 0], place[k, 1] - rest[k, 1]) / spacing[k]
            way[k] = max(way[k], away)
            farthest = max(farthest, away)
    return farthest
