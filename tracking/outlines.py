"""Dots of which something hides a part, or that touch something.

Neither the fit nor its residual tells: what is left of a dot looks like a smaller one, and its centre lies off by as
much as its outline has lost. But from picture to picture a dot's outline changes as the others' do, when the skin
turns or the camera moves; what only some lose or gain is not theirs.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking.dots import Dots

Array = NDArray[Any]

LEAST = 0.025  # of an outline's half width: what is less is neither lost nor gained
VAGUE, UNSURE = 4.0, 4.0  # standard deviations of the radius, and of the centre: likewise
SCATTERED = 5.0  # standard deviations of what it lost or gained so far: likewise
MOST = 0.1  # of a half width: of what lost or gained more, not much can be said
SCATTER, UNUSUAL = 0.01, 2.5  # of a half width: what it is at first; standard deviations that are counted at most
LOOKS = 5  # at a marker before it is judged
USED_TO, STILL_HIDDEN = 0.1, 0.03  # of a change: how much of it is taken for usual, and while a part seems hidden
OBLIQUE = 1.5  # of what is lost or gained along an axis: how far the centre may be off along it
VARYING = 0.03  # of a half width: standard deviation of how differently the body's ends change
OUTLIER, ROUNDS = 0.02, 6  # of a half width: a change so much unlike the others' counts half


class Outlines:
    """The markers' usual outlines, as their half widths along x and y."""

    def __init__(self, first: Dots) -> None:
        """Of markers (M) as they look at first."""
        self._usual = _half_widths(first.parameters)
        self._scatter = np.full((len(first), 2), SCATTER)
        self._looks = np.ones(len(first))

    def judge(self, dots: Dots, rest: Array) -> Dots:
        """The dots of the next picture, with a sigma that holds for those in part hidden; NaN where it is too large.

        Args:
            dots: of the markers, (M).
            rest: where these are at rest [px], (M, 2).
        """
        seen = np.isfinite(dots.sigma[:, 0])
        widths = np.full((len(dots), 2), np.nan)
        widths[seen] = _half_widths(dots.parameters[seen])
        change = widths - self._usual
        least = np.maximum(VAGUE * dots.vague[:, None], UNSURE * dots.sigma / np.exp(widths))
        least = np.fmax(np.maximum(LEAST, SCATTERED * self._scatter), least)
        own = change
        if (np.abs(change) > least).any():
            known = np.isfinite(change[:, 0])
            own = change - np.stack([_shared(rest, change[:, k], known) for k in range(2)], axis=1)
        hidden = (np.abs(own) > least).any(axis=1) & (self._looks >= LOOKS)
        lost = np.where(hidden[:, None], OBLIQUE * np.exp(widths) * np.expm1(np.abs(own)), 0.0)
        self._learn(widths, change, own, seen & ~hidden)
        if not hidden.any():
            return dots
        good = ~hidden | (np.abs(own) < MOST).all(axis=1)
        return replace(dots, sigma=np.where(good[:, None], np.hypot(dots.sigma, lost), np.nan))

    def join(self) -> None:
        """One more marker, not seen yet."""
        self._usual = np.concatenate([self._usual, np.full((1, 2), np.nan)])
        self._scatter = np.concatenate([self._scatter, np.full((1, 2), SCATTER)])
        self._looks = np.append(self._looks, 0.0)

    def _learn(self, widths: Array, change: Array, own: Array, whole: NDArray[np.bool_]) -> None:
        known, new = np.isfinite(change[:, 0]), whole & np.isnan(self._usual[:, 0])
        both, hidden = known & whole, known & ~whole
        self._looks += whole
        if both.any():  # who is not seen whole changes as the others do
            self._usual[~both] += USED_TO * np.median(change[both], axis=0)
        self._usual[both] += np.maximum(USED_TO, 1.0 / self._looks[both, None]) * change[both]
        self._usual[hidden] += STILL_HIDDEN * change[hidden]
        self._usual[new] = widths[new]
        variance = self._scatter[both] ** 2
        usual = np.minimum(own[both] ** 2, UNUSUAL**2 * variance)
        self._scatter[both] = np.sqrt(variance + USED_TO * (usual - variance))


def _half_widths(parameters: Array) -> Array:
    """Logarithms of half widths along x and y of discs (D, 12), (D, 2)."""
    a, b, c = parameters[:, 2:5].T
    return np.log(np.stack([np.hypot(b, c), np.hypot(a, b)], axis=1) / np.abs(a * c - b * b)[:, None])


def _shared(rest: Array, change: Array, known: NDArray[np.bool_]) -> Array:
    """What of the known changes (M) is common to all or grows along the body, (M)."""
    arm = rest - rest.mean(axis=0)
    ways = np.concatenate([np.ones((len(rest), 1)), arm / np.abs(arm).max()], axis=1)
    smooth = np.full(len(change), np.median(change[known]))
    stiff = np.diag([0.0, 1.0, 1.0]) * (OUTLIER / VARYING) ** 2
    for _ in range(ROUNDS):
        weight = 1.0 / (1.0 + ((change - smooth)[known] / OUTLIER) ** 2)
        heavy = ways[known] * weight[:, None]
        smooth = ways @ np.linalg.solve(heavy.T @ ways[known] + stiff, heavy.T @ change[known])
    return smooth
