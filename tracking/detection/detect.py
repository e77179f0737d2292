"""Find the dots in a frame and locate them to a fraction of a pixel."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rafl.tracking.detection.disc_fit import fit_disc
from rafl.tracking.detection.disc_model import MIN_EDGE_VARIANCE, PARAMETER_COUNT, SCRATCH_SIZE
from rafl.tracking.detection.levenberg_marquardt import QUALITY_COUNT

Array = NDArray[Any]

RADIUS_RANGE = (3.0, 32.0)  # px: radii of the dots that are searched for
SEARCH_RADII = 4.0, 8.0, 16.0, 27.0  # px: each scale of the search finds dots of about this radius
MIN_AXIS_RATIO = 0.4  # smallest ratio of a dot's semi-axes
MIN_FILLED_FRACTION = 0.75  # a blob's area over that of the ellipse with the same second moments, at least
MAX_RADIUS_TOLERANCE = 0.2  # fraction of the radius: how much the fit's own uncertainty of it may excuse, at most
MIN_CONTRAST = 12.0  # grey levels
MODEL_ERROR = 1e-3  # px: error of the centre that the disc model itself causes
CORRELATED_VARIANCE_RATIO = 1.25  # block variance over that of independent errors, above which errors are correlated
MIN_DOTS_FOR_TWO_THREADS = 64  # with fewer dots, decoding takes longer than fitting
STATISTIC_COUNT = 8  # statistics of one fit, see `_describe`
MIN_DOWNSAMPLED_RADIUS = 1.9  # px: radius of the smallest dots that the fast search finds in a downsampled frame
MIN_SEPARATION_RADII = 0.6  # radii: two detections closer than this are the same dot
RELATIVE_CONTRAST_TOLERANCE = 0.2  # logarithm: dots of less different relative contrast may be alike in any light


_POOL = ThreadPoolExecutor(2, thread_name_prefix="dots")


@dataclass(frozen=True)
class Dots:
    """Dots of one frame.

    Attributes:
        centre: [px], (D, 2).
        sigma: of the centre along x and y, from the fit's residual and the shift that pixels of
            reduced weight cause [px], (D, 2); NaN where the fit failed.
        parameters: of the fitted discs, see `rafl.tracking.detection.disc_model`, (D, 12).
        radius: geometric mean of the semi-axes [px], (D).
        relative_radius_sigma: of the radius over the radius; large for small defocused dots, (D).
        axis_ratio: minor over major semi-axis, 1 for a circle, (D).
        contrast: level of the dot minus that of its surroundings, negative for dark dots [grey levels], (D).
        residual: root mean square residual over |contrast|, (D).
        misfit: the same without the pixel noise, which is estimated only where the residual is large, (D).
        mean_weight: of the pixels in the fit, 0 to 1, (D).
    """

    centre: Array
    sigma: Array
    parameters: Array
    radius: Array
    relative_radius_sigma: Array
    axis_ratio: Array
    contrast: Array
    residual: Array
    misfit: Array
    mean_weight: Array

    def __len__(self) -> int:
        return len(self.centre)

    def __getitem__(self, rows: Array | slice) -> "Dots":
        return Dots(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def relative_contrast(self) -> Array:
        """|contrast| over the brighter level of dot and surroundings: independent of the illumination, (D)."""
        return np.asarray(relative_contrast(self.contrast, self.parameters[:, 9]))

    @property
    def half_width(self) -> Array:
        """Half the width of the outline along x and y [px], (D, 2)."""
        a, b, c = self.parameters[:, 2:5].T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.stack([np.hypot(b, c), np.hypot(a, b)], axis=1) / np.abs(a * c - b * b)[:, None])

    @property
    def blur(self) -> Array:
        """Sigma of the edge where it is sharpest, thus without motion blur [px], (D)."""
        xx, xy, yy = self.parameters[:, 5:8].T
        return np.asarray(np.sqrt(np.maximum(0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy), MIN_EDGE_VARIANCE)))

    def within(self, image: Array) -> NDArray[np.bool_]:
        """Which dots have their centre in the frame, (D)."""
        x, y = self.centre.T
        return np.asarray((x > 0) & (y > 0) & (x < image.shape[1] - 1) & (y < image.shape[0] - 1))

    def extended_by(self, more: "Dots") -> "Dots":
        """These dots, followed by more."""
        return Dots(*(np.concatenate([getattr(self, name), getattr(more, name)]) for name in self.__dataclass_fields__))

    @classmethod
    def missing(cls, count: int) -> "Dots":
        """This many dots that were not found: all values are NaN."""
        nan = np.full(count, np.nan)
        pair = np.full((count, 2), np.nan)
        parameters = np.full((count, PARAMETER_COUNT), np.nan)
        return cls(pair, pair.copy(), parameters, nan, nan, nan, nan, nan, nan, nan)


@njit(cache=True)
def relative_contrast(contrast: Any, level: Any) -> Any:
    """See `Dots.relative_contrast`; for one dot or for several."""
    return np.abs(contrast) / np.maximum(np.maximum(level, level + contrast), 1.0)


@njit(cache=True, nogil=True)
def _fit_range(
    image: Array,
    deep_image: Array,
    starts: Array,
    first: int,
    last: int,
    robust: bool,
    fitted: Array,
    statistics: Array,
) -> None:
    """Fit starts[first:last] of starts (D, 12); fills fitted (D, 12) and statistics (D, STATISTIC_COUNT).

    image, deep_image: see `fit_disc`.
    """
    count = starts.shape[0]
    scratch = np.empty(SCRATCH_SIZE, np.float32)
    radius = 1.0 / np.sqrt(np.abs(starts[:, 2] * starts[:, 4] - starts[:, 3] ** 2))
    near = np.empty((16, 3))
    quality = np.empty(QUALITY_COUNT)
    for k in range(first, last):
        found = 0
        for i in range(PARAMETER_COUNT):  # see `disc_fit` on copies
            fitted[k, i] = starts[k, i]
        for other in range(count):
            distance = np.hypot(starts[other, 0] - starts[k, 0], starts[other, 1] - starts[k, 1])
            if other != k and found < 16 and distance < 1.6 * radius[k] + radius[other] + 10.0:
                near[found, 0] = starts[other, 0]
                near[found, 1] = starts[other, 1]
                near[found, 2] = radius[other]
                found += 1
        fit_disc(image, deep_image, fitted[k], near[:found], robust, scratch, quality)
        _describe(fitted[k], quality, statistics[k])


@njit(cache=True, nogil=True)
def _describe(p: Array, quality: Array, statistics: Array) -> None:
    """Fill the statistics of one fit, defined in `Dots`, from its parameters and its quality.

    In order: sigma (2), radius, axis ratio, residual, mean weight, relative radius sigma, misfit.
    """
    statistics[0:2] = np.nan
    statistics[2], statistics[3], statistics[6] = np.nan, 0.0, np.nan
    statistics[4], statistics[5] = np.sqrt(quality[5]) / max(abs(p[8]), 1e-12), quality[6]
    statistics[7] = np.sqrt(quality[5] - quality[10]) / max(abs(p[8]), 1e-12)
    determinant = p[2] * p[4] - p[3] * p[3]
    mean = 0.5 * (p[2] + p[4])
    if not (quality[0] > 0.0 and determinant > 0.0 and mean > 0.0):
        return
    independent_x, independent_y = quality[1] * quality[5], quality[2] * quality[5]
    correlated = quality[3] + quality[4] > CORRELATED_VARIANCE_RATIO * (independent_x + independent_y)
    statistics[0] = np.sqrt((quality[3] if correlated else independent_x) + quality[7] ** 2 + MODEL_ERROR**2)
    statistics[1] = np.sqrt((quality[4] if correlated else independent_y) + quality[8] ** 2 + MODEL_ERROR**2)
    spread = np.sqrt(max(mean * mean - determinant, 0.0))
    statistics[2] = 1.0 / np.sqrt(determinant)
    statistics[6] = np.sqrt(quality[9] * quality[5]) / mean
    statistics[3] = (mean - spread) / (mean + spread)


def fit_dots(image: Array, starts: Array, fit_count: int | None = None, robust: bool = True) -> Dots:
    """Fit a disc to each dot.

    A robust fit detects specular highlights by what the initial parameters do not explain, so these must be good.

    Args:
        image: grey levels, (H, W).
        starts: initial parameters, see `rafl.tracking.detection.disc_model`, (D, 12).
        fit_count: how many of them to fit, from the first on; all if None. The pixels of the others are left out.
        robust: give less weight to pixels that the initial parameters do not explain.
    """
    starts = np.ascontiguousarray(starts)
    if image.dtype == np.uint8:
        images = np.ascontiguousarray(image), np.zeros((0, 0), np.float32)
    else:
        images = np.zeros((0, 0), np.uint8), np.ascontiguousarray(image, np.float32)
    count = len(starts) if fit_count is None else fit_count
    fitted, statistics = np.empty((count, PARAMETER_COUNT)), np.empty((count, STATISTIC_COUNT))
    half = count // 2 if count >= MIN_DOTS_FOR_TWO_THREADS else 0
    other = _POOL.submit(_fit_range, *images, starts, 0, half, robust, fitted, statistics) if half else None
    _fit_range(*images, starts, half, count, robust, fitted, statistics)
    if other is not None:
        other.result()
    columns = statistics.T.copy()  # contiguous, as chosen dots are: kernels are compiled for one layout only
    return Dots(
        centre=fitted[:, :2].copy(),
        sigma=statistics[:, :2].copy(),
        parameters=fitted,
        radius=columns[2],
        relative_radius_sigma=columns[6],
        axis_ratio=columns[3],
        contrast=fitted[:, 8].copy(),
        residual=columns[4],
        misfit=columns[7],
        mean_weight=columns[5],
    )


def initial_parameters(x: float, y: float, shape: Array, contrast: float, level: float) -> Array:
    """Initial parameters (12) of a fit at x, y [px]; shape (3) is A's xx, xy and yy."""
    return np.array([x, y, *shape, 1.2, 0.0, 1.2, contrast, level, 0.0, 0.0])


def initial_parameters_at(positions: Array, shape: Array, contrast: float, level: float) -> Array:
    """Initial parameters (D, 12) of fits at positions (D, 2) [px], otherwise all alike."""
    return np.array([initial_parameters(x, y, shape, contrast, level) for x, y in positions]).reshape(
        -1, PARAMETER_COUNT
    )


def to_eight_bits(image: Array) -> NDArray[np.uint8]:
    """Convert an image to 8-bit grey levels, as OpenCV's filters need it."""
    return image if image.dtype == np.uint8 else np.clip(image, 0, 255).astype(np.uint8)


def find_candidates(image: Array, dark: bool) -> Array:
    """Initial parameters (D, 12) of every blob whose size and shape could be a dot's.

    Blobs are regions that differ from the local mean at one of several scales. Of overlapping blobs, the one of the
    greatest contrast is kept.
    """
    found: list[Array] = []
    image = to_eight_bits(image)
    signed = cv2.bitwise_not(image) if dark else image
    mean, labels = np.empty_like(image), np.empty(image.shape, np.int32)  # new memory would take longer than the sums
    for radius in SEARCH_RADII:
        side = int(6 * radius) | 1
        cv2.boxFilter(signed, -1, (side, side), dst=mean, borderType=cv2.BORDER_REFLECT)
        mask = cv2.subtract(signed, mean, dst=mean)
        cv2.threshold(mask, MIN_CONTRAST, 1, cv2.THRESH_BINARY, dst=mask)
        found += _blob_parameters(image, cv2.connectedComponents(mask, labels, connectivity=4)[0], labels, radius)
    found.sort(key=lambda start: -abs(start[8]))
    starts = np.array(found).reshape(-1, PARAMETER_COUNT)
    size = 1.0 / np.sqrt(starts[:, 2] * starts[:, 4] - starts[:, 3] ** 2)
    kept: list[int] = []
    for row, position in enumerate(starts[:, :2]):
        if np.hypot(*(position - starts[kept, :2]).T).min(initial=np.inf) > 0.8 * size[row]:
            kept.append(row)
    return starts[kept]


def _blob_parameters(image: NDArray[np.uint8], count: int, labels: NDArray[np.int32], radius: float) -> list[Array]:
    """Initial parameters (12) of the labelled blobs that could be dots of about this radius [px].

    count: labels in use, with label 0 of the background.
    """
    box, area, centroids, covariances = _blob_moments(labels, count)
    low, high = max(RADIUS_RANGE[0], 0.6 * radius) - 1.0, min(RADIUS_RANGE[1], 1.7 * radius) + 1.0
    width, height = (box[:, 2:] - box[:, :2]).T
    chosen = (area > np.pi * low**2 * MIN_AXIS_RATIO) & (area < np.pi * high**2)
    chosen &= (np.maximum(width, height) < 2.3 * high) & (np.minimum(width, height) > 2 * low * MIN_AXIS_RATIO)
    chosen &= area > 0.55 * width * height
    likely = np.flatnonzero(chosen)
    values, vectors = np.linalg.eigh(covariances[likely] + np.eye(2) / 12)
    filled = area[likely] / (4.0 * np.pi * np.sqrt(values.prod(axis=1)))  # 1 for an ellipse
    elliptical = (filled >= MIN_FILLED_FRACTION) & (values[:, 0] >= MIN_AXIS_RATIO**2 * values[:, 1])
    outlines = vectors / (2.0 * np.sqrt(values))[:, None] @ vectors.swapaxes(1, 2)
    starts = []
    for label, outline in zip(likely[elliptical], outlines[elliptical], strict=True):
        x, y, right, bottom = box[label]
        pad = 3
        around = image[max(y - pad, 0) : bottom + pad, max(x - pad, 0) : right + pad]
        inside = float(np.median(image[y:bottom, x:right][labels[y:bottom, x:right] == label]))
        border = np.concatenate([around[0], around[-1], around[:, 0], around[:, -1]])
        level = float(np.median(border))
        centre_x, centre_y = centroids[label]
        starts.append(initial_parameters(centre_x, centre_y, outline[[0, 0, 1], [0, 1, 1]], inside - level, level))
    return starts


@njit(cache=True, nogil=True)
def _blob_moments(labels: Array, count: int) -> tuple[Array, Array, Array, Array]:
    """Bounding boxes and moments of labelled blobs; label 0, the background, is left out.

    Returns left, top and the first pixel beyond right and bottom (L, 4), area (L), centroid (L, 2) and covariance of
    the pixels' positions (L, 2, 2). OpenCV's function for this takes seven times as long.
    """
    height, width = labels.shape
    box, area = np.zeros((count, 4), np.int64), np.zeros(count, np.int64)
    box[:, 0], box[:, 1] = width, height
    sums = np.zeros((count, 5))
    for y in range(height):
        for x in range(width):
            label = labels[y, x]
            if label:
                area[label] += 1
                sums[label, 0] += x
                sums[label, 1] += y
                sums[label, 2] += x * x
                sums[label, 3] += x * y
                sums[label, 4] += y * y
                box[label, 0], box[label, 2] = min(box[label, 0], x), max(box[label, 2], x + 1)
                box[label, 1], box[label, 3] = min(box[label, 1], y), y + 1
    mean = sums / np.maximum(area, 1).reshape(-1, 1)
    covariance = np.empty((count, 2, 2))
    for label in range(count):
        x, y = mean[label, 0], mean[label, 1]
        covariance[label, 0, 0] = mean[label, 2] - x * x
        covariance[label, 0, 1] = covariance[label, 1, 0] = mean[label, 3] - x * y
        covariance[label, 1, 1] = mean[label, 4] - y * y
    return box, area, mean[:, :2].copy(), covariance


def fit_candidates(image: Array, starts: Array, dark: bool) -> Dots:
    """Fit candidates (D, 12), first to all their pixels, then robustly where that fails; keeps the plausible dots."""
    plain = fit_dots(image, starts, robust=False)
    good = _are_plausible(image, plain, dark)
    others = np.concatenate([starts[~good], starts[good]])
    robust = fit_dots(image, others, int((~good).sum()))
    return plain[good].extended_by(robust[_are_plausible(image, robust, dark)])


def _are_plausible(image: Array, dots: Dots, dark: bool) -> NDArray[np.bool_]:
    good = np.isfinite(dots.sigma[:, 0]) & (dots.axis_ratio > MIN_AXIS_RATIO) & (dots.misfit < 0.25)
    largest = dots.radius * (1.0 + 2.0 * np.minimum(dots.relative_radius_sigma, MAX_RADIUS_TOLERANCE))
    good &= (largest > RADIUS_RANGE[0] - 1) & (dots.radius < RADIUS_RANGE[1] + 1) & (dots.mean_weight > 0.5)
    good &= (np.abs(dots.contrast) > MIN_CONTRAST) & ((dots.contrast < 0) == dark)
    return good & dots.within(image)


def remove_duplicates(dots: Dots, min_distance: float) -> Dots:
    """Of dots closer than a distance [px], keep the one of the smallest sigma."""
    order = np.argsort(dots.sigma.max(axis=1))
    kept: list[int] = []
    for row in order:
        if all(np.hypot(*(dots.centre[row] - dots.centre[other])) > min_distance for other in kept):
            kept.append(int(row))
    return dots[np.array(kept, dtype=int)]


def _downsample_by_area(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Reduce an image by a factor; each pixel is the mean of the pixels it covers."""
    height, width = (side // factor for side in image.shape)
    part = image[: height * factor, : width * factor]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA) if factor > 1 else part


def _downsample_by_halving(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Reduce an image by a factor of 1, 2 or 4.

    Repeated halving takes a fraction of the time of another ratio. If the image is halved twice, every other line is
    enough.
    """
    height, width = (side // factor * factor for side in image.shape)
    small = image[:height:2, :width] if factor > 2 else image[:height, :width]
    while small.shape[1] > width // factor:
        size = (small.shape[1] // 2, max(small.shape[0] // 2, height // factor))
        small = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)  # at half size: the mean of the pixels covered
    return small


def find_blobs(
    image: Array, radius: float, min_contrast: float, region: tuple[int, int, int, int], fast: bool = False
) -> Array:
    """Find positions where dots of a known radius may be, (D, 2) [px], to about half a radius.

    Args:
        image: grey levels, (H, W).
        radius: of the dots [px].
        min_contrast: smallest contrast to the local mean, negative for dark dots [grey levels].
        region: left, top, right, bottom of the search [px].
        fast: take half the time; one of two blurred dots side by side may be missed.
    """
    left, top = max(region[0], 0), max(region[1], 0)
    part = to_eight_bits(image[top : max(region[3], 0), left : max(region[2], 0)])
    factor = (
        next((factor for factor in (4, 2) if radius >= MIN_DOWNSAMPLED_RADIUS * factor), 1)
        if fast
        else max(int(radius / 3), 1)
    )
    if min(part.shape) < 3 * factor:
        return np.zeros((0, 2))
    small = _downsample_by_halving(part, factor) if fast else _downsample_by_area(part, factor)
    signed = small if min_contrast > 0 else 255 - small
    inner, outer = (int(ratio * radius / factor) | 1 for ratio in (1.3, 4.5))
    level = cv2.boxFilter(signed, cv2.CV_32F, (outer, outer), borderType=cv2.BORDER_REFLECT)
    response = cv2.boxFilter(signed, cv2.CV_32F, (inner, inner), borderType=cv2.BORDER_REFLECT)
    response = cv2.subtract(response, level, dst=response)  # in place: new memory would take longer than the sums
    highest = cv2.dilate(response, np.ones((inner, inner)), dst=level)
    peaks = (highest == response) & (response > abs(min_contrast))
    rows, columns = np.divmod(np.flatnonzero(peaks), peaks.shape[1])  # np.nonzero takes ten times as long
    centre = (factor - 1) / 2.0
    blobs = np.stack([columns * factor + centre + left, rows * factor + centre + top], axis=1)
    # A plateau has several peaks. As separate dots, each would be fitted without the pixels of the other.
    one, other = cKDTree(blobs).query_pairs(radius, output_type="ndarray").reshape(-1, 2).T
    strength = response[rows, columns]
    return np.delete(blobs, np.where(strength[one] < strength[other], one, other), axis=0)
