"""Where the markers will be in the next picture, by how they moved in the last ones."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

REMEMBERED = 4  # frames
ORDERS = 4  # of prediction: at rest, at the last velocity, at the last acceleration, swinging on
FADING = 0.85  # of what was learned of the oscillation, each frame


class Motion:
    """The markers' last places, and how well each order of prediction did.

    Attributes:
        places: newest last [px], (4, M, 2).
        count: how many of these are known, the last ones.
        surprise: of predictions of each order [spacings], (4); infinite where unknown.
    """

    def __init__(self, place: NDArray[np.float64]) -> None:
        self.places = np.tile(place, (REMEMBERED, 1, 1))
        self.count = 1
        self.surprise = np.full(ORDERS, np.inf)
        self._swing = np.zeros(2)  # sums from which the oscillation's stiffness follows

    @property
    def last(self) -> NDArray[np.float64]:
        """Where the markers were last [px], (M, 2)."""
        return self.places[-1]

    def expected(self) -> NDArray[np.float64]:
        """Where the order that did best puts the markers next [px], (M, 2)."""
        return _extrapolated(self.places, self.count, int(np.argmin(self.surprise)), self._swing)

    def judge(self, found: NDArray[np.float64], known: NDArray[np.bool_], spacing: NDArray[np.float64]) -> None:
        """Learns from what the predictions missed.

        Args:
            found: places in the new picture [px], (M, 2).
            known: markers seen there and in the picture before, (M).
            spacing: of the markers [px], (M).
        """
        if known.any():
            _judge(self.places, self.count, self._swing, found, known, spacing, self.surprise)

    def forget(self) -> None:
        """Nothing is known of the motion up to now."""
        self.count = 0
        self.surprise[:] = np.inf

    def remember(self, place: NDArray[np.float64], back: NDArray[np.bool_]) -> None:
        """The markers' places (M, 2) in the new picture, seen or believed; those that are back (M) go on as guessed."""
        if back.any():
            self.places[:, back] += (place - self.expected())[back]
        self.count = min(self.count + 1, REMEMBERED)
        self.places = _remembered(self.places, self.count, self._swing, place)

    def join(self, places: NDArray[np.float64]) -> None:
        """Takes in one more marker, by its places in the last pictures [px], (4, 2)."""
        self.places = np.concatenate([self.places, places[:, None]], axis=1)


@njit(cache=True)
def _extrapolated(places, count, order, swing):
    """The markers' next places, (M, 2), by a prediction of some order, or the highest that so few pictures allow.

    A free oscillation's acceleration falls by stiffness times velocity; one number serves all markers.
    """
    order = min(order, count - 1)
    stiffness = min(max(swing[0] / max(swing[1], 1e-12), 0.0), 2.0) if order == 3 else 0.0
    result = places[-1].copy()
    for marker in range(places.shape[1]):
        for axis in range(2):
            velocity = places[-1, marker, axis] - places[-2, marker, axis]
            before = places[-2, marker, axis] - places[-3, marker, axis]
            if order > 0:
                result[marker, axis] += velocity
            if order > 1:
                result[marker, axis] += velocity - before - stiffness * velocity
    return result


@njit(cache=True)
def _judge(places, count, swing, found, known, spacing, surprise):
    """Puts into surprise (4) the root mean square miss of each order, or a fading memory of a larger one."""
    for order in range(min(count, ORDERS)):
        expected = _extrapolated(places, count, order, swing)
        total = 0.0
        for marker in range(len(known)):
            if known[marker]:
                x, y = found[marker, 0] - expected[marker, 0], found[marker, 1] - expected[marker, 1]
                total += (x * x + y * y) / spacing[marker] ** 2
        now = np.sqrt(total / known.sum())
        surprise[order] = max(now, 0.7 * surprise[order]) if surprise[order] < np.inf else now


@njit(cache=True)
def _remembered(places, count, swing, place):
    """The last places with the new ones (M, 2) among them; what they say of the oscillation goes into swing (2)."""
    result = np.empty_like(places)
    result[:-1] = places[1:]
    result[-1] = place
    if count == REMEMBERED:
        swing *= FADING
        for marker in range(len(place)):
            for axis in range(2):
                a, b, c, d = result[:, marker, axis]
                swing[0] -= (d - 3.0 * c + 3.0 * b - a) * (c - b)
                swing[1] += (c - b) ** 2
    return result
