"""A dot that may be a late-detected marker: its observations, and the test whether it moves with the body."""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# "Spread" below: root mean square distance from the mean position.
MIN_OBSERVATIONS = 5  # of a clearly moving dot, before it is accepted
MAX_REST_SPREAD_RATIO = 0.5  # its spread on the body, relative to that in the image
LONG_HISTORY, MIN_SPREAD = 15, 0.05  # observations needed of a dot that hardly moves, and its least spread [px]
BODY_MODES = 2  # modes of the body's motion, which must explain the motion of a dot that hardly moves
MAX_UNEXPLAINED_VARIANCE = 0.1  # share of its variance that they may leave
# A dot that hardly moves may have a spread on the body of this much, relative to the spread of the marker that moves
# most. Between the two limits, the permitted unexplained variance falls linearly to zero.
REST_SPREAD_LIMITS = 0.4, 0.6
MAX_STATIC_SPREAD = 1.0  # of a static dot, seen by a camera that may shake [px]
MAX_OBSERVATIONS = 40
REST_GAP_WEIGHT = 0.3  # of the distance on the body, added to the distance in the image


class Observation(NamedTuple):
    """A dot in one frame.

    Attributes:
        frame: its number.
        rest: the dot's position on the body at rest, predicted from the known markers [px], (2).
        position: in the image [px], (2).
        body: the known markers' positions in the image [px], (M, 2).
    """

    frame: int
    rest: Array
    position: Array
    body: Array


@dataclass(eq=False)
class Candidate:
    """The last observations of one dot."""

    observations: deque[Observation] = field(default_factory=lambda: deque(maxlen=MAX_OBSERVATIONS))

    @property
    def rest(self) -> Array:
        """Its positions on the body at rest [px], (L, 2)."""
        return np.array([observation.rest for observation in self.observations])

    @property
    def positions(self) -> Array:
        """Its positions in the image [px], (L, 2)."""
        return np.array([observation.position for observation in self.observations])

    def distance_to(self, rest: Array, position: Array) -> float:
        """Distance of a dot at `rest` on the body and at `position` in the image [px], the smaller of two.

        The first is that on the body. The second is that in the image plus a part of the first.
        """
        rest_distance = float(np.linalg.norm(self.rest - rest, axis=1).min())
        image_distance = float(np.linalg.norm(self.observations[-1].position - position))
        return min(rest_distance, image_distance + REST_GAP_WEIGHT * rest_distance)

    def moves_with_body(self) -> bool:
        """Whether the observations show that it is attached to the body."""
        spread, rest_spread = _spread(self.positions), _spread(self.rest)
        clear = spread > MAX_STATIC_SPREAD and rest_spread < MAX_REST_SPREAD_RATIO * spread
        if len(self.observations) >= MIN_OBSERVATIONS and clear:
            return True
        return len(self.observations) >= LONG_HISTORY and spread > MIN_SPREAD and self._follows_body_modes()

    def moves_less_on_body(self) -> bool:
        """Whether it moves less relative to the body than in the image."""
        return _spread(self.rest) < _spread(self.positions)

    def is_long_static(self) -> bool:
        """Whether it stayed still in the image for so long that further observations will hardly change that."""
        return len(self.observations) > 2 * LONG_HISTORY and _spread(self.positions) < MAX_STATIC_SPREAD

    def _follows_body_modes(self) -> bool:
        """Whether the main modes of the body's motion explain its motion.

        This finds markers near the clamp, which move less than the error of the position predicted from the others.
        """
        common = min(len(observation.body) for observation in self.observations)
        body = np.stack([observation.body[:common].ravel() for observation in self.observations])
        largest_spread = np.linalg.norm(body.std(axis=0).reshape(-1, 2), axis=1).max()
        modes = np.linalg.svd(body - body.mean(axis=0), full_matrices=False)[0][:, :BODY_MODES]
        deviation = self.positions - self.positions.mean(axis=0)
        residual = deviation - modes @ (modes.T @ deviation)
        freedom = len(self.observations) - 1
        unexplained = (residual**2).sum() / (freedom - BODY_MODES) / ((deviation**2).sum() / freedom)
        low, high = REST_SPREAD_LIMITS
        interval = (high - low) * largest_spread
        margin = min(interval, high * largest_spread - _spread(self.rest))
        explained = unexplained * interval < MAX_UNEXPLAINED_VARIANCE * margin
        return bool(largest_spread > MAX_STATIC_SPREAD and explained)


def _spread(positions: Array) -> float:
    """Root mean square distance of positions (L, 2) from their mean."""
    return float(np.linalg.norm(np.std(positions, axis=0)))
