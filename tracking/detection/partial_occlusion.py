"""Dots of which something hides a part, or that touch something.

Neither the fit nor its residual tells: what is left of a dot looks like a smaller one, and its centre lies off by as
much as its outline has lost. But from picture to picture a dot's outline changes as the others' do, when the skin
turns or the camera moves; what only some lose or gain is not theirs.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rafl.tracking.detection.detect import Dots

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
        widths, change, least = np.empty((3, len(dots), 2))
        alike = _compare(
            dots.parameters,
            dots.sigma,
            dots.vague,
            self._usual,
            self._scatter,
            widths,
            change,
            least,
        )
        own, hidden = change, np.zeros(len(dots), bool)
        if not alike:
            known = np.isfinite(change[:, 0])
            own = change - np.stack([_shared(rest, change[:, k], known) for k in range(2)], axis=1)
            hidden = (np.abs(own) > least).any(axis=1) & (self._looks >= LOOKS)
        _learn(widths, change, own, hidden, self._usual, self._scatter, self._looks)
        if not hidden.any():
            return dots
        lost = np.where(hidden[:, None], OBLIQUE * np.exp(widths) * np.expm1(np.abs(own)), 0.0)
        good = ~hidden | (np.abs(own) < MOST).all(axis=1)
        return replace(dots, sigma=np.where(good[:, None], np.hypot(dots.sigma, lost), np.nan))

    def join(self) -> None:
        """One more marker, not seen yet."""
        self._usual = np.concatenate([self._usual, np.full((1, 2), np.nan)])
        self._scatter = np.concatenate([self._scatter, np.full((1, 2), SCATTER)])
        self._looks = np.append(self._looks, 0.0)


@njit(cache=True, error_model="numpy")
def _half_widths(parameters):
    """Logarithms of half widths along x and y of discs (D, 12), (D, 2)."""
    widths = np.empty((len(parameters), 2))
    for k in range(len(parameters)):
        a, b, c = parameters[k, 2], parameters[k, 3], parameters[k, 4]
        determinant = abs(a * c - b * b)
        widths[k, 0], widths[k, 1] = np.log(np.hypot(b, c) / determinant), np.log(np.hypot(a, b) / determinant)
    return widths


@njit(cache=True)
def _compare(parameters, sigma, vague, usual, scatter, widths, change, least):
    """Fills the half widths, their changes and what change is least counted, (M, 2), NaN where a dot is not seen.

    Returns whether none changed by more.
    """
    widths[:], change[:], least[:] = np.nan, np.nan, np.nan
    alike = True
    for k in range(len(sigma)):
        if sigma[k, 0] == sigma[k, 0]:
            widths[k] = _half_widths(parameters[k : k + 1])[0]
            for axis in range(2):
                unsure = max(VAGUE * vague[k], UNSURE * sigma[k, axis] / np.exp(widths[k, axis]))
                least[k, axis] = max(LEAST, SCATTERED * scatter[k, axis], unsure)
                change[k, axis] = widths[k, axis] - usual[k, axis]
                alike = alike and not abs(change[k, axis]) > least[k, axis]
    return alike


@njit(cache=True)
def _learn(widths, change, own, hidden, usual, scatter, looks):
    """Takes a picture's changes (M, 2), as they are and but for what all share, into what is usual."""
    known = change[:, 0] == change[:, 0]
    both = known & ~hidden
    common = np.zeros(2)
    if both.any():  # who is not seen whole changes as the others do
        common[0], common[1] = np.median(change[both, 0]), np.median(change[both, 1])
    for k in range(len(usual)):
        looks[k] += widths[k, 0] == widths[k, 0] and not hidden[k]
        for axis in range(2):
            if both[k]:
                usual[k, axis] += max(USED_TO, 1.0 / looks[k]) * change[k, axis]
                variance = scatter[k, axis] ** 2
                counted = min(own[k, axis] ** 2, UNUSUAL**2 * variance)
                scatter[k, axis] = np.sqrt(variance + USED_TO * (counted - variance))
            elif known[k]:
                usual[k, axis] += USED_TO * common[axis] + STILL_HIDDEN * change[k, axis]
            elif widths[k, axis] == widths[k, axis]:
                usual[k, axis] = widths[k, axis]
            else:
                usual[k, axis] += USED_TO * common[axis]


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
