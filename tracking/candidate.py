"""A dot that may be a marker that is not known yet, look by look, and whether the body carries it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

LOOKS, MOVING = 5, 0.5  # looks that show a moving dot before it is believed, and px: root mean square way of one
CARRIED = 0.5  # of that way: how far it may move on the body the while
LONG, LEAST = 15, 0.15  # looks and px: likewise, of a dot that hardly moves
MODES, ALONE = 2, 0.1  # ways of the body to move, and of the variance of such a dot's way: what these may not explain
ASTRAY = 0.4  # of the way of the marker that moves most: how far it may seem to move on the body
STEADY = 1.0  # px: root mean square way of what stands still, though the camera may not
SEEMING = 0.3  # of how far it seems to move on the body: so much farther is a dot that keeps its place in the picture


@dataclass(eq=False)
class Candidate:
    """A dot's places, look by look.

    Attributes:
        frame: of each look.
        rest: on the body at rest, as the known markers there put it [px], (2) each.
        place: in the picture [px], (2) each.
        body: the known markers' places in the picture then [px], (M, 2) each.
    """

    frame: list[int] = field(default_factory=list)
    rest: list[Array] = field(default_factory=list)
    place: list[Array] = field(default_factory=list)
    body: list[Array] = field(default_factory=list)

    def add(self, frame: int, rest: Array, place: Array, body: Array) -> None:
        """One more look."""
        self.frame.append(frame)
        self.rest.append(rest)
        self.place.append(place)
        self.body.append(body)

    def gap(self, rest: Array, place: Array) -> float:
        """How far from it a dot is that stands there on the body and in the picture [px]."""
        seeming = float(np.linalg.norm(self.rest - rest, axis=1).min())
        return min(seeming, float(np.linalg.norm(self.place[-1] - place)) + SEEMING * seeming)

    def carried(self) -> bool:
        """Whether the looks show that the body carries it."""
        looks, way, stray = len(self.place), _spread(self.place), _spread(self.rest)
        if looks >= LOOKS and way > MOVING and stray < CARRIED * way:
            return True
        return looks >= LONG and way > LEAST and self._sways()

    def still(self, most: float = np.inf) -> bool:
        """Whether it keeps its place in the picture; and on the body, to at most so many [px]."""
        return len(self.place) >= LONG and _spread(self.place) < STEADY and _spread(self.rest) < most

    def settled(self) -> bool:
        """Whether nothing new is to be expected of it."""
        return len(self.place) > 2 * LONG and self.still()

    def _sways(self) -> bool:
        """Whether it moves when the body moves: beside a clamp, where it moves less than the others can tell."""
        looks, common = len(self.place), min(len(places) for places in self.body)
        body = np.stack([places[:common].ravel() for places in self.body])
        if _spread(self.rest) > ASTRAY * np.linalg.norm(body.std(axis=0).reshape(-1, 2), axis=1).max():
            return False
        modes = np.linalg.svd(body - body.mean(axis=0), full_matrices=False)[0][:, :MODES]
        own = np.stack(self.place) - np.mean(self.place, axis=0)
        left = own - modes @ (modes.T @ own)
        return bool((left**2).sum() / (looks - 1 - MODES) < ALONE * (own**2).sum() / (looks - 1))


def _spread(places: list[Array]) -> float:
    """Root mean square distance from their mean."""
    return float(np.linalg.norm(np.std(places, axis=0)))
