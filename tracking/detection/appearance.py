"""The appearance of a recording's markers, found from one frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rafl.tracking.detection.detect import (
    MAX_RADIUS_TOLERANCE,
    MIN_CONTRAST,
    MIN_SEPARATION_RADII,
    RELATIVE_CONTRAST_TOLERANCE,
    Dots,
    find_candidates,
    fit_candidates,
    fit_dots,
    relative_contrast,
    remove_duplicates,
)

Array = NDArray[Any]

REFERENCE_SIGMA = 0.08  # px: a printed dot is located better than this
MAX_DISSIMILARITY = 3.0  # see `_dissimilarity`: a dot above it is no marker
MAX_ROW_DISSIMILARITY = 4.5  # the same where the markers' rows continue: specular highlights change the appearance
LINE_NEIGHBOURS = 8  # nearest markers with which a dot may form a line
LINE_TOLERANCE = 0.12  # fraction of the neighbour's distance: how far a marker may be beside its position on the line
MIN_LINES = 3  # lines that a dot must lie on to count as in the markers' rows
MIN_ROW_SINE = 0.5  # sine of the angle to the nearest neighbour's direction: above it, a marker lies in another row
MAX_EXTENSION_ROW_SPACINGS = 1.3  # row spacings: no row continues farther than this from all markers
MIN_CONTRAST_RATIO = 0.3  # of the median contrast; below it, the relative contrast must be that of the markers too
MIN_SHADED_CONTRAST_RATIO = 0.15  # of the median contrast: no marker has less
MAX_RELATIVE_CONTRAST = 1.25  # 1 is a black dot
BLOB_CONTRAST_OF_MEDIAN = 0.3  # a blob's smallest contrast as a fraction of the markers' median contrast
BLOB_CONTRAST_OF_WEAKEST = 0.5  # the same as a fraction of the weakest marker's contrast
MAX_CENTRE_SIGMA = 0.4  # px: a dot located worse than this is no marker


@dataclass(frozen=True)
class MarkerAppearance:
    """What the markers of a recording have in common.

    Attributes:
        dark: whether they are darker than their surroundings.
        radius: median [px].
        contrast: median [grey levels].
        relative_contrast: median, see `Dots.relative_contrast`.
    """

    dark: bool
    radius: float
    contrast: float
    relative_contrast: float

    @classmethod
    def from_dots(cls, dark: bool, dots: Dots) -> "MarkerAppearance":
        """The appearance of these dots."""
        return cls(dark, *(float(np.median(value)) for value in (dots.radius, dots.contrast, dots.relative_contrast)))

    def min_blob_contrast(self, weakest: float) -> float:
        """The smallest contrast of a blob that may be a marker, signed, given the weakest marker's [grey levels]."""
        return float(
            np.copysign(
                min(BLOB_CONTRAST_OF_MEDIAN * abs(self.contrast), BLOB_CONTRAST_OF_WEAKEST * abs(weakest)),
                self.contrast,
            )
        )

    def matches(self, dots: Dots) -> NDArray[np.bool_]:
        """Which dots could be markers of this appearance, (D)."""
        values = (
            dots.radius,
            dots.relative_radius_sigma,
            dots.axis_ratio,
            dots.parameters,
            dots.misfit,
            dots.mean_weight,
            dots.sigma,
        )
        return np.asarray(_matches(self.radius, self.contrast, self.relative_contrast, *values))


@njit(cache=True)
def _matches(
    median_radius: float,
    median_contrast: float,
    median_relative_contrast: float,
    radius: Array,
    relative_radius_sigma: Array,
    axis_ratio: Array,
    parameters: Array,
    misfit: Array,
    mean_weight: Array,
    sigma: Array,
) -> Array:
    good = np.empty(len(radius), np.bool_)
    for k in range(len(radius)):
        contrast, level = parameters[k, 8], parameters[k, 9]
        ratio = contrast / median_contrast
        good[k] = (
            abs(np.log(radius[k] / median_radius))
            < np.log(1.35) + 2.0 * min(relative_radius_sigma[k], MAX_RADIUS_TOLERANCE)
            and axis_ratio[k] > 0.45
            and MIN_SHADED_CONTRAST_RATIO < ratio < 3.0
            and (
                ratio > MIN_CONTRAST_RATIO
                or abs(np.log(relative_contrast(contrast, level) / median_relative_contrast))
                < RELATIVE_CONTRAST_TOLERANCE
            )
            and abs(contrast) > MIN_CONTRAST
            and misfit[k] < 0.2
            and mean_weight[k] > 0.55
            and sigma[k, 0] < MAX_CENTRE_SIGMA
            and sigma[k, 1] < MAX_CENTRE_SIGMA
        )
    return good


def _quality(dots: Dots) -> Array:
    """Weight of each dot, (D): a printed dot has a sigma several times smaller than that of a round background blob."""
    return np.asarray(1.0 / (1.0 + (dots.sigma.max(axis=1) / REFERENCE_SIGMA) ** 2) ** 3)


def _weighted_median(values: Array, quality: Array) -> float:
    """The median by quality: round background blobs may outnumber the markers, but weigh less."""
    order = np.argsort(values)
    cumulative = np.cumsum(quality[order])
    return float(values[order[np.searchsorted(cumulative, 0.5 * cumulative[-1])]])


def _dissimilarity(dots: Dots, markers: Dots) -> Array:
    """Root sum of squares of the dots' normalised differences from the markers, (D).

    The differences are those in radius, contrast, misfit, sigma and blur, each over its usual size. A background blob
    differs a little in all of them. Dots of an impossible relative contrast get infinity.
    """
    quality, radius_sigma = _quality(markers), np.minimum(dots.relative_radius_sigma, MAX_RADIUS_TOLERANCE)
    total = np.log(dots.radius / _weighted_median(markers.radius, quality)) ** 2 / (0.12**2 + radius_sigma**2)
    contrast = np.log(dots.contrast / _weighted_median(markers.contrast, quality))
    relative = np.log(dots.relative_contrast / _weighted_median(markers.relative_contrast, quality))
    # Less light on a dot changes its contrast but not its relative contrast.
    total += np.minimum((contrast / 0.35) ** 2, (contrast / 0.7) ** 2 + (relative / 0.1) ** 2)
    # Dim light increases the noise. The pixel noise is not estimated where it is small, so the residual counts too.
    misfit, residual = _weighted_median(markers.misfit, quality), _weighted_median(markers.residual, quality)
    excess = np.maximum(np.minimum(dots.misfit - misfit, dots.residual - residual), 0.0)
    total += (excess / np.maximum(max(0.5 * misfit, 0.02), 0.25 * dots.residual)) ** 2
    # A background blob has no sharp edge. But a marker may have a highlight or be more out of focus than the others.
    sigma, blur = _weighted_median(markers.sigma.max(axis=1), quality), _weighted_median(markers.blur, quality)
    total += np.maximum(np.log(dots.sigma.max(axis=1) / max(sigma, 0.01)) / 0.55, 0.0) ** 2
    total += np.maximum(np.log(dots.blur / max(blur, 0.5)) / 0.45, 0.0) ** 2
    return np.where(dots.relative_contrast < MAX_RELATIVE_CONTRAST + 2.0 * radius_sigma, np.sqrt(total), np.inf)


def count_lines_through(position: Array, markers: Array) -> int:
    """Count the lines that a position (2) forms with two of the markers (M, 2), at equal distances.

    The position is the middle of the line or, next to the two markers, its end. The third point may be beside the line
    by `LINE_TOLERANCE` of the distance.
    """
    offset = markers - position
    distance = np.linalg.norm(offset, axis=1)
    near = np.argsort(distance)[:LINE_NEIGHBOURS]
    tolerance = LINE_TOLERANCE * distance[near]
    tree = cKDTree(markers)
    in_line = [tree.query(end)[0] < tolerance for end in (position + 2.0 * offset[near], position - offset[near])]
    return int(in_line[0].sum() + in_line[1].sum() // 2)


@njit(cache=True)
def row_spacing(markers: Array) -> float:
    """Distance between the rows of markers (M, 2) [px].

    It is the median distance to the nearest marker that does not lie in the direction of the nearest one.
    """
    count = len(markers)
    spacings = np.empty(count)
    for k in range(count):
        offsets = markers - markers[k]
        distance = np.hypot(offsets[:, 0], offsets[:, 1])
        distance[k] = np.inf
        nearest = np.argmin(distance)
        along = offsets[nearest] / max(distance[nearest], 1e-9)
        spacings[k] = np.inf
        for other in range(count):
            sine = abs(along[0] * offsets[other, 1] - along[1] * offsets[other, 0]) / max(distance[other], 1e-9)
            if other != k and sine > MIN_ROW_SINE:
                spacings[k] = min(spacings[k], distance[other])
        if spacings[k] == np.inf:
            spacings[k] = distance[nearest]
    return float(np.median(spacings))


def find_markers(image: Array) -> tuple[MarkerAppearance, Dots] | None:
    """Find the markers in a frame (H, W): the largest set of well-located dots alike in size and contrast.

    Returns their appearance and the dots; None if there are no dots.
    """
    best: tuple[float, MarkerAppearance, Dots, Array] | None = None
    for dark in (True, False):
        candidates = find_candidates(image, dark)
        dots = fit_candidates(image, candidates, dark)
        dots = dots[(dots.misfit < 0.15) & (dots.axis_ratio > 0.5)]
        quality = _quality(dots)
        for seed in range(len(dots)):
            tolerance = np.minimum(dots.relative_radius_sigma + dots.relative_radius_sigma[seed], MAX_RADIUS_TOLERANCE)
            alike = np.abs(np.log(dots.radius / dots.radius[seed])) < np.log(1.2) + 2.0 * tolerance
            alike &= np.abs(np.log(dots.contrast / dots.contrast[seed])) < np.log(2.2)
            score = float(quality[alike].sum())
            if best is None or score > best[0]:
                markers = dots[alike]
                markers = markers[_dissimilarity(markers, markers) < MAX_DISSIMILARITY]
                best = (score, MarkerAppearance.from_dots(dark, markers), markers, candidates)
    return None if best is None else (best[1], _add_similar_dots(image, *best[1:]))


def _add_similar_dots(image: Array, appearance: MarkerAppearance, markers: Dots, candidates: Array) -> Dots:
    """The markers and those candidates (D, 12) that prove to be markers when fitted from the median appearance."""
    gaps = np.linalg.norm(candidates[:, None, :2] - markers.centre, axis=2)
    left = candidates[gaps.min(axis=1) > MIN_SEPARATION_RADII * appearance.radius]
    left[:, 2:9] = np.median(markers.parameters[:, 2:9], axis=0)
    refitted = fit_dots(image, np.concatenate([markers.parameters, left]))
    first, more = refitted[: len(markers)], refitted[len(markers) :]
    good, more = appearance.matches(first), more[appearance.matches(more) & more.within(image)]
    dissimilarity = _dissimilarity(more, markers)
    similar = dissimilarity < MAX_ROW_DISSIMILARITY  # under a highlight
    reach = MAX_EXTENSION_ROW_SPACINGS * row_spacing(markers.centre)
    accepted, before = dissimilarity < MAX_DISSIMILARITY, -1
    while accepted.sum() > before:  # each accepted dot extends rows
        before = int(accepted.sum())
        known = np.concatenate([markers.centre, more.centre[accepted]])
        lines = np.array([count_lines_through(position, known) for position in more.centre], int)
        accepted |= (lines >= MIN_LINES) & (cKDTree(known).query(more.centre)[0] < reach) & similar
    all_dots = first[good].extended_by(markers[~good]).extended_by(more[accepted])
    return remove_duplicates(all_dots, MIN_SEPARATION_RADII * appearance.radius)
