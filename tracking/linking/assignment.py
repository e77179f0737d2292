"""Which dots of a frame are which markers.

All dots look alike, and between two frames they may move farther than their spacing: the nearest dot is often another
marker's. But the belief about the markers is a joint one: the place of one marker tells where its neighbours are. So a
hypothesis starts from one pair of marker and dot and grows. The marker with the smallest standard deviation, given the
pairs so far, comes next; it takes the likeliest dot, or none if a false detection is likelier.

The logarithm of the likelihood ratio of all pairs against false detections tells how good a hypothesis is. A marker's
dot is certain if every hypothesis that is nearly as good as the best one agrees on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from rafl.tracking.linking.shape_prior import Belief

Array = NDArray[Any]


@dataclass(frozen=True)
class AssignmentSettings:
    """What the assignment takes for granted.

    Attributes:
        clutter_side: side of the square that holds one false detection on average [spacings]. Twice as much accepts a
            dot that is 0.4 sigma farther away.
        log_margin: a hypothesis is as good as the best one if its logarithm of the likelihood ratio is at most this
            much smaller. Five are odds of 150 to 1. With eight, up to six times as many markers of a body that moves
            by a spacing a frame stay without a dot.
        gate: most distance of a pair that starts a hypothesis [standard deviations]. It limits time only.
        most_starts: pairs tried as starts, likeliest first. It limits time only.
        unmoved: a dot this near to a marker's last position may be a static one [spacings]: ten times the error of a
            fit.
    """

    clutter_side: float = 8.0
    log_margin: float = 5.0
    gate: float = 4.0
    most_starts: int = 400
    unmoved: float = 0.01


SETTINGS = AssignmentSettings()


def assign_dots(
    beliefs: Sequence[Belief], dots: Array, sigma: Array, confirmed: NDArray[np.int64], last: Array, spacing: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The dot of each marker, (M), -1 for none, and which of these are certain, (M).

    Args:
        beliefs: about the markers in this frame, one of which is right.
        dots: of the frame [px], (D, 2).
        sigma: of the dots [px], (D).
        confirmed: the dot of each marker that is known already, (M), -1 for the others.
        last: the markers' last positions [px], (M, 2).
        spacing: of the markers [px].
    """
    match, certain = confirmed.copy(), confirmed >= 0
    free, wanted = np.setdiff1d(np.arange(len(dots)), confirmed), np.flatnonzero(~certain)
    if not len(free) or not len(wanted):
        return match, certain
    log_area, unmoved = 2.0 * np.log(SETTINGS.clutter_side * spacing), SETTINGS.unmoved * spacing
    matches, scores, most = [], [], -np.inf
    for belief in beliefs:
        mean, covariance = _condition(belief, dots, sigma, confirmed)
        starts = _starts(mean, covariance, dots[free], sigma[free])
        least, variance = most - SETTINGS.log_margin, sigma[free] ** 2
        found, found_scores = _hypotheses(
            mean, covariance, dots[free], variance, last[wanted], unmoved, log_area, least, SETTINGS.log_margin, starts
        )
        matches.append(found)
        scores.append(found_scores)
        most = max(most, float(found_scores.max()))
    all_matches, all_scores = np.concatenate(matches), np.concatenate(scores)
    best = all_matches[all_scores.argmax()]
    agreed = (all_matches[all_scores > most - SETTINGS.log_margin] == best).all(axis=0)
    match[wanted[best >= 0]] = free[best[best >= 0]]
    certain[wanted] = agreed & (best >= 0)
    return match, certain


def _condition(belief: Belief, dots: Array, sigma: Array, confirmed: NDArray[np.int64]) -> tuple[Array, Array]:
    """Mean (2 W) and covariance (2 W, 2 W) of the markers without a confirmed dot, given the others' dots."""
    known, wanted = (np.flatnonzero(np.repeat(flag, 2)) for flag in (confirmed >= 0, confirmed < 0))
    mean, covariance = belief.position.ravel(), belief.covariance
    if not len(known):
        return mean.copy(), covariance.copy()
    measured = confirmed[confirmed >= 0]
    noise = np.diag(np.repeat(sigma[measured] ** 2, 2))
    cross = covariance[np.ix_(known, wanted)]
    gain = cho_solve(cho_factor(covariance[np.ix_(known, known)] + noise), cross).T
    deviation = dots[measured].ravel() - mean[known]
    return mean[wanted] + gain @ deviation, covariance[np.ix_(wanted, wanted)] - gain @ cross


def _starts(mean: Array, covariance: Array, dots: Array, sigma: Array) -> NDArray[np.int64]:
    """Pairs of marker and dot that may start a hypothesis, likeliest first, (S, 2)."""
    variance = np.diag(covariance).reshape(-1, 2).mean(axis=1)
    square = ((dots[None] - mean.reshape(-1, 1, 2)) ** 2).sum(axis=2) / (variance[:, None] + sigma**2)
    pairs = np.argwhere(square < SETTINGS.gate**2)
    order = np.argsort(square[pairs[:, 0], pairs[:, 1]], kind="stable")[: SETTINGS.most_starts]
    chosen: NDArray[np.int64] = pairs[order]
    return chosen


@njit(cache=True, nogil=True)
def _hypotheses(
    mean: Array,
    covariance: Array,
    dots: Array,
    variance: Array,
    last: Array,
    unmoved: float,
    log_area: float,
    least: float,
    log_margin: float,
    starts: NDArray[np.int64],
) -> tuple[NDArray[np.int64], Array]:
    """The dot of each marker, -1 for none, (S + 1, W), and the log likelihood ratio, (S + 1), of every hypothesis.

    The ratio is minus infinity where it is at most `least`, or `log_margin` less than another one.

    Args:
        mean, covariance: of the markers [px], [px^2], (2 W), (2 W, 2 W).
        dots: [px], (D, 2).
        variance: of the dots [px^2], (D).
        last: last positions of the markers [px], (W, 2).
        unmoved: gate about them [px].
        log_area: logarithm of the area that holds one false detection [px^2].
        least: ratio that a hypothesis must exceed.
        log_margin: difference of the ratio up to which hypotheses are similarly good.
        starts: pairs of marker and dot, (S, 2).
    """
    matches = np.full((len(starts) + 1, len(last)), -1)
    scores = np.full(len(starts) + 1, -np.inf)
    best = 0
    none = int(np.int64(-1))  # no literal, for which `_grow` would be compiled once more
    scores[0] = _grow(mean, covariance, dots, variance, last, unmoved, log_area, none, none, least, matches[0])
    for s in range(len(starts)):
        marker, dot = starts[s]
        if matches[best, marker] == dot and scores[best] > -np.inf:  # would give the same hypothesis
            continue
        least = max(least, scores[best] - log_margin)
        scores[s + 1] = _grow(
            mean, covariance, dots, variance, last, unmoved, log_area, marker, dot, least, matches[s + 1]
        )
        if scores[s + 1] > scores[best]:
            best = s + 1
    return matches, scores


@njit(cache=True, nogil=True)
def _grow(
    mean: Array,
    covariance: Array,
    dots: Array,
    variance: Array,
    last: Array,
    unmoved: float,
    log_area: float,
    first_marker: int,
    first_dot: int,
    least: float,
    match: NDArray[np.int64],
) -> float:
    """Fill `match` (W) from a first pair, or from none if it is -1. Returns the log likelihood ratio.

    Ends with minus infinity when the ratio can no longer exceed `least`. The other arguments are those of
    `_hypotheses`.
    """
    count = len(last)
    mean, covariance = mean.copy(), covariance.copy()
    taken = np.zeros(len(dots), np.bool_)
    if first_dot >= 0:
        taken[first_dot] = True
    waiting = np.arange(count)  # the markers not yet visited; the others need no update
    most_gain = log_area - np.log(2.0 * np.pi * variance.min())
    score = 0.0
    for remaining in range(count, 0, -1):
        if score + remaining * most_gain < least:
            return -np.inf
        chosen = -1
        if first_marker >= 0 and remaining == count:
            chosen = first_marker
        else:
            smallest = np.inf
            for w in range(remaining):
                m = 2 * waiting[w]
                size = covariance[m, m] + covariance[m + 1, m + 1]
                if size < smallest:
                    smallest, chosen = size, w
        marker = waiting[chosen]
        waiting[chosen] = waiting[remaining - 1]
        i, j = 2 * marker, 2 * marker + 1
        most, found = 0.0, -1
        for dot in range(len(dots)):
            forced = first_marker >= 0 and remaining == count
            if (taken[dot] and not forced) or (forced and dot != first_dot):
                continue
            a, b, c = covariance[i, i] + variance[dot], covariance[i, j], covariance[j, j] + variance[dot]
            x, y = dots[dot, 0] - mean[i], dots[dot, 1] - mean[j]
            determinant = a * c - b * b
            gain = log_area - np.log(2.0 * np.pi * np.sqrt(determinant))
            gain -= 0.5 * (c * x * x - 2.0 * b * x * y + a * y * y) / determinant
            if gain > most or forced:
                most, found = gain, dot
        if found < 0:  # it may be a static dot, which tells nothing about the body
            for dot in range(len(dots)):
                x, y = dots[dot, 0] - last[marker, 0], dots[dot, 1] - last[marker, 1]
                if not taken[dot] and x * x + y * y < unmoved * unmoved:
                    match[marker] = dot
                    taken[dot] = True
                    break
            continue
        match[marker] = found
        taken[found] = True
        score += most
        a, b, c = covariance[i, i] + variance[found], covariance[i, j], covariance[j, j] + variance[found]
        x, y = dots[found, 0] - mean[i], dots[found, 1] - mean[j]
        determinant = a * c - b * b
        x, y = (c * x - b * y) / determinant, (a * y - b * x) / determinant
        for w in range(remaining - 1):
            for row in range(2 * waiting[w], 2 * waiting[w] + 2):
                p, q = covariance[row, i], covariance[row, j]
                mean[row] += p * x + q * y
                p, q = (c * p - b * q) / determinant, (a * q - b * p) / determinant
                for v in range(remaining - 1):
                    for column in range(2 * waiting[v], 2 * waiting[v] + 2):
                        covariance[row, column] -= p * covariance[column, i] + q * covariance[column, j]
    return score
