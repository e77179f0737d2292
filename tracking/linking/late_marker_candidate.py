"""A dot that may be a marker that is not known yet, look by look, and whether the body carries it."""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

LOOKS = 5  # that show a moving dot before it is believed
CARRIED = 0.5  # of its way: how far it may move on the body the while
LONG, LEAST = 15, 0.05  # looks and px: likewise, of a dot that hardly moves
MODES, ALONE = 2, 0.1  # ways of the body to move, and of the variance of such a dot's way: what these may not explain
ASTRAY = 0.4, 0.6  # of the way of the marker that moves most: how far it may seem to move on the body; if explained
STEADY = 1.0  # px: root mean square way of what stands still, though the camera may not
KEPT = 40  # looks
SEEMING = 0.3  # of how far it seems to move on the body: so much farther is a dot that keeps its place in the picture


class Look(NamedTuple):
    """What one look shows of a dot.

    Attributes:
        frame: its number.
        rest: the dot's place on the body at rest, as the known markers put it [px], (2).
        place: in the picture [px], (2).
        body: the known markers' places in the picture [px], (M, 2).
    """

    frame: int
    rest: Array
    place: Array
    body: Array


@dataclass(eq=False)
class Candidate:
    """A dot's last looks, one after the other."""

    looks: deque[Look] = field(default_factory=lambda: deque(maxlen=KEPT))

    @property
    def rest(self) -> Array:
        """Its places on the body at rest [px], (L, 2)."""
        return np.array([look.rest for look in self.looks])

    @property
    def place(self) -> Array:
        """Its places in the picture [px], (L, 2)."""
        return np.array([look.place for look in self.looks])

    def gap(self, rest: Array, place: Array) -> float:
        """How far from it a dot is that stands there on the body and in the picture [px]."""
        seeming = float(np.linalg.norm(self.rest - rest, axis=1).min())
        return min(seeming, float(np.linalg.norm(self.looks[-1].place - place)) + SEEMING * seeming)

    def carried(self) -> bool:
        """Whether the looks show that the body carries it."""
        way, stray = _spread(self.place), _spread(self.rest)
        if len(self.looks) >= LOOKS and way > STEADY and stray < CARRIED * way:
            return True
        return len(self.looks) >= LONG and way > LEAST and self._sways()

    def rides(self) -> bool:
        """Whether it moves less on the body than in the picture."""
        return _spread(self.rest) < _spread(self.place)

    def still(self, most: float = np.inf) -> bool:
        """Whether it keeps its place in the picture; and on the body, to at most so many [px]."""
        return len(self.looks) >= LONG and _spread(self.place) < STEADY and _spread(self.rest) < most

    def settled(self) -> bool:
        """Whether nothing new is to be expected of it."""
        return len(self.looks) > 2 * LONG and self.still()

    def _sways(self) -> bool:
        """Whether it moves when the body moves: beside a clamp, where it moves less than the others can tell."""
        common = min(len(look.body) for look in self.looks)
        body = np.stack([look.body[:common].ravel() for look in self.looks])
        most = np.linalg.norm(body.std(axis=0).reshape(-1, 2), axis=1).max()
        modes = np.linalg.svd(body - body.mean(axis=0), full_matrices=False)[0][:, :MODES]
        own = self.place - self.place.mean(axis=0)
        left = own - modes @ (modes.T @ own)
        free = len(self.looks) - 1
        unexplained = (left**2).sum() / (free - MODES) / ((own**2).sum() / free)
        span = (ASTRAY[1] - ASTRAY[0]) * most
        explained = unexplained * span < ALONE * min(span, ASTRAY[1] * most - _spread(self.rest))
        return bool(most > STEADY and explained)


def _spread(places: Array) -> float:
    """Root mean square distance of places (L, 2) from their mean."""
    return float(np.linalg.norm(np.std(places, axis=0)))
