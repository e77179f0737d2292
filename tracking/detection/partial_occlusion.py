"""Detect dots that are partly occluded or that touch something.

Neither the fit nor its residual shows this: the visible part of a dot looks like a smaller dot, and its centre is off
by as much as the outline has lost. But when the skin turns or the camera moves, the outlines of all dots change alike.
A change that only some dots show is therefore an occlusion.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rafl.tracking.detection.detect import Dots

Array = NDArray[Any]

# A dot's own change of a half width counts as an occlusion above the largest of these four limits.
MIN_CHANGE = 0.025  # fraction of the half width
RADIUS_SIGMAS = 4.0  # sigmas of the radius
CENTRE_SIGMAS = 4.0  # sigmas of the centre
SCATTER_SIGMAS = 5.0  # sigmas of the dot's own changes so far
MAX_CHANGE = 0.1  # fraction of the half width: a dot that changed more counts as missing
INITIAL_SCATTER = 0.01  # fraction of the half width: sigma of a dot's own changes, at first
MAX_SCATTER_STEP = 2.5  # sigmas: a larger change updates the scatter as this one does
MIN_OBSERVATIONS = 5  # of a marker before it is judged
LEARNING_RATE = 0.1  # fraction of a change that the usual outline takes over in each frame
OCCLUDED_LEARNING_RATE = 0.03  # the same of a dot that seems occluded
CENTRE_SHIFT_FACTOR = 1.5  # possible shift of the centre along an axis over the half width lost or gained along it
GRADIENT_SIGMA = 0.03  # fraction of the half width: sigma of the change's gradient along the body
OUTLIER_SCALE = 0.02  # fraction of the half width: a change this far from the common one gets half the weight
ROUNDS = 6  # of reweighting


class PartialOcclusion:
    """Detects partly occluded markers by their usual outlines, kept as half widths along x and y."""

    def __init__(self, first: Dots) -> None:
        """Start with the markers (M) as first seen."""
        self._usual = _half_widths(first.parameters)
        self._scatter = np.full((len(first), 2), INITIAL_SCATTER)
        self._observations = np.ones(len(first))

    def adjust_sigma(self, dots: Dots, rest: Array) -> Dots:
        """Return the next frame's dots; partly occluded ones get a larger sigma, mostly occluded ones NaN.

        Args:
            dots: of the markers, (M).
            rest: the markers' rest positions [px], (M, 2).
        """
        widths, change, limit = np.empty((3, len(dots), 2))
        unchanged = _compare(
            dots.parameters,
            dots.sigma,
            dots.relative_radius_sigma,
            self._usual,
            self._scatter,
            widths,
            change,
            limit,
        )
        own, occluded = change, np.zeros(len(dots), bool)
        if not unchanged:
            known = np.isfinite(change[:, 0])
            own = change - np.stack([_common_change(rest, change[:, k], known) for k in range(2)], axis=1)
            occluded = (np.abs(own) > limit).any(axis=1) & (self._observations >= MIN_OBSERVATIONS)
        _learn(widths, change, own, occluded, self._usual, self._scatter, self._observations)
        if not occluded.any():
            return dots
        shift = np.where(occluded[:, None], CENTRE_SHIFT_FACTOR * np.exp(widths) * np.expm1(np.abs(own)), 0.0)
        good = ~occluded | (np.abs(own) < MAX_CHANGE).all(axis=1)
        return replace(dots, sigma=np.where(good[:, None], np.hypot(dots.sigma, shift), np.nan))

    def add_marker(self) -> None:
        """Add a marker that has not been seen yet."""
        self._usual = np.concatenate([self._usual, np.full((1, 2), np.nan)])
        self._scatter = np.concatenate([self._scatter, np.full((1, 2), INITIAL_SCATTER)])
        self._observations = np.append(self._observations, 0.0)


@njit(cache=True, error_model="numpy")
def _half_widths(parameters: Array) -> Array:
    """Logarithms of the half widths [px] along x and y of discs (D, 12), (D, 2)."""
    widths = np.empty((len(parameters), 2))
    for k in range(len(parameters)):
        a, b, c = parameters[k, 2], parameters[k, 3], parameters[k, 4]
        determinant = abs(a * c - b * b)
        widths[k, 0], widths[k, 1] = np.log(np.hypot(b, c) / determinant), np.log(np.hypot(a, b) / determinant)
    return widths


@njit(cache=True)
def _compare(
    parameters: Array,
    sigma: Array,
    relative_radius_sigma: Array,
    usual: Array,
    scatter: Array,
    widths: Array,
    change: Array,
    limit: Array,
) -> bool:
    """Fill widths, change and limit (M, 2): log half widths, their changes, and the limits of these; NaN where unseen.

    Returns whether no change exceeds its limit.
    """
    widths[:], change[:], limit[:] = np.nan, np.nan, np.nan
    unchanged = True
    for k in range(len(sigma)):
        if sigma[k, 0] == sigma[k, 0]:
            widths[k] = _half_widths(parameters[k : k + 1])[0]
            for axis in range(2):
                uncertainty = max(
                    RADIUS_SIGMAS * relative_radius_sigma[k], CENTRE_SIGMAS * sigma[k, axis] / np.exp(widths[k, axis])
                )
                limit[k, axis] = max(MIN_CHANGE, SCATTER_SIGMAS * scatter[k, axis], uncertainty)
                change[k, axis] = widths[k, axis] - usual[k, axis]
                unchanged = unchanged and not abs(change[k, axis]) > limit[k, axis]
    return unchanged


@njit(cache=True)
def _learn(
    widths: Array, change: Array, own: Array, occluded: Array, usual: Array, scatter: Array, observations: Array
) -> None:
    """Update the usual half widths and their scatter by a frame's changes (M, 2).

    own: the changes without the part common to all dots, (M, 2).
    """
    known = change[:, 0] == change[:, 0]
    both = known & ~occluded
    common = np.zeros(2)
    if both.any():  # a dot that is not completely visible is assumed to change as the others do
        common[0], common[1] = np.median(change[both, 0]), np.median(change[both, 1])
    for k in range(len(usual)):
        observations[k] += widths[k, 0] == widths[k, 0] and not occluded[k]
        for axis in range(2):
            if both[k]:
                usual[k, axis] += max(LEARNING_RATE, 1.0 / observations[k]) * change[k, axis]
                variance = scatter[k, axis] ** 2
                square = min(own[k, axis] ** 2, MAX_SCATTER_STEP**2 * variance)
                scatter[k, axis] = np.sqrt(variance + LEARNING_RATE * (square - variance))
            elif known[k]:
                usual[k, axis] += LEARNING_RATE * common[axis] + OCCLUDED_LEARNING_RATE * change[k, axis]
            elif widths[k, axis] == widths[k, axis]:
                usual[k, axis] = widths[k, axis]
            else:
                usual[k, axis] += LEARNING_RATE * common[axis]


def _common_change(rest: Array, change: Array, known: NDArray[np.bool_]) -> Array:
    """The part of the known changes (M) that is common to all dots or linear in the rest positions (M, 2), (M).

    It is a robust fit by iteratively reweighted least squares, with a prior on the gradient.
    """
    arm = rest - rest.mean(axis=0)
    basis = np.concatenate([np.ones((len(rest), 1)), arm / np.abs(arm).max()], axis=1)
    smooth = np.full(len(change), np.median(change[known]))
    prior = np.diag([0.0, 1.0, 1.0]) * (OUTLIER_SCALE / GRADIENT_SIGMA) ** 2
    for _ in range(ROUNDS):
        weight = 1.0 / (1.0 + ((change - smooth)[known] / OUTLIER_SCALE) ** 2)
        weighted = basis[known] * weight[:, None]
        smooth = basis @ np.linalg.solve(weighted.T @ basis[known] + prior, weighted.T @ change[known])
    return smooth
