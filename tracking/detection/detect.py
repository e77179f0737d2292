"""Finding dots in a picture."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from rafl.tracking.detection.disc_fit import fit_disc
from rafl.tracking.detection.disc_model import LEAST_BLUR, PARAMETERS, SCRATCH
from rafl.tracking.detection.levenberg_marquardt import QUALITY
from scipy.spatial import cKDTree

Array = NDArray[Any]

RADII = (3.0, 32.0)  # of the dots looked for [px]
SCALES = 4.0, 8.0, 16.0, 27.0  # px: radii about which they are looked for
FLATTEST = 0.4  # least ratio of the axes
ROUNDEST = 0.75  # least share of the outline's ellipse that is filled
VAGUEST = 0.2  # share of a radius: as much as a fit's own uncertainty of it may excuse
LEAST_CONTRAST = 12.0  # grey levels
LEAST_SIGMA = 1e-3  # px: below it the model's own error counts
SHARED_NOISE = 1.25  # variance by blocks over that by independent errors, beyond which errors are shared
ENOUGH_FOR_TWO = 64  # dots, to fit half of them in another thread; with fewer, decoding takes longer than fitting
FIGURES = 11  # of a dot, that follow from its fit
SMALL = 1.9  # px: radius of dots that are still found in a picture made small in a hurry
SAME_PLACE = 0.6  # radii: two dots closer than this are one
SHADES = 0.2  # of a shade's logarithm: dots that differ by less may be alike, however much light falls on them


_POOL = ThreadPoolExecutor(2, thread_name_prefix="dots")


@dataclass(frozen=True)
class Dots:
    """Dots of one picture.

    Attributes:
        centre: [px], (D, 2).
        sigma: standard deviation of the centre along x and y, from the fit's residual and how far pixels that are not
            quite trusted pull [px], (D, 2); NaN where the fit failed.
        parameters: of the fitted discs, see `rafl.tracking.detection.disc_model`, (D, 12).
        radius: geometric mean of the semi-axes [px], (D).
        vague: standard deviation of the radius, as a share of it; large for small dots out of focus, (D).
        flattening: ratio of the axes, 1 for a circle, (D).
        contrast: of the dot against its surroundings, negative for dark dots [grey levels], (D).
        leverage: what a grey level of independent noise in every pixel moves the centre by [px], (D, 2).
        residual: root mean square, as a share of the contrast, (D).
        misfit: likewise without the pixels' own noise, where that matters, (D).
        grain: likewise of what neighbouring pixels' residuals do not share, (D).
        used: share of the pixels that the fit trusted, (D).
    """

    centre: Array
    sigma: Array
    parameters: Array
    radius: Array
    vague: Array
    flattening: Array
    contrast: Array
    leverage: Array
    residual: Array
    misfit: Array
    grain: Array
    used: Array

    def __len__(self) -> int:
        return len(self.centre)

    def __getitem__(self, rows: NDArray | slice) -> "Dots":
        return Dots(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def shade(self) -> Array:
        """The contrast as a share of the brighter of a dot and its surroundings: the same in any light, (D)."""
        return shade_of(self.contrast, self.parameters[:, 9])

    @property
    def blur(self) -> Array:
        """Standard deviation of the edge where it is sharpest, so without smear [px], (D)."""
        xx, xy, yy = self.parameters[:, 5:8].T
        return np.sqrt(np.maximum(0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy), LEAST_BLUR))

    def within(self, image: NDArray) -> NDArray[np.bool_]:
        """Which have their centre in the picture, (D)."""
        x, y = self.centre.T
        return (x > 0) & (y > 0) & (x < image.shape[1] - 1) & (y < image.shape[0] - 1)

    def beside(self, more: "Dots") -> "Dots":
        """These and more."""
        return Dots(*(np.concatenate([getattr(self, name), getattr(more, name)]) for name in self.__dataclass_fields__))

    @classmethod
    def none(cls, count: int) -> "Dots":
        """As many dots that are not there."""
        nan = np.full(count, np.nan)
        pair = np.full((count, 2), np.nan)
        parameters = np.full((count, PARAMETERS), np.nan)
        return cls(pair, pair.copy(), parameters, nan, nan, nan, nan, pair.copy(), nan, nan, nan, nan)


@njit(cache=True)
def shade_of(contrast, level):
    """See `Dots.shade`; of one dot or of several."""
    return np.abs(contrast) / np.maximum(np.maximum(level, level + contrast), 1.0)


@njit(cache=True, nogil=True)
def _fit_some(image, start, first, last, wary, fitted, figures):
    """Fit starts first to last of start (D, 12); fills fitted (D, 12) and figures (D, FIGURES)."""
    count = start.shape[0]
    room = np.empty(SCRATCH, np.float32)
    radius = 1.0 / np.sqrt(np.abs(start[:, 2] * start[:, 4] - start[:, 3] ** 2))
    near = np.empty((16, 3))
    quality = np.empty(QUALITY)
    for k in range(first, last):
        found = 0
        fitted[k] = start[k]
        for other in range(count):
            away = np.hypot(start[other, 0] - start[k, 0], start[other, 1] - start[k, 1])
            if other != k and found < 16 and away < 1.6 * radius[k] + radius[other] + 10.0:
                near[found, 0] = start[other, 0]
                near[found, 1] = start[other, 1]
                near[found, 2] = radius[other]
                found += 1
        fit_disc(image, fitted[k], near[:found], wary, room, quality)
        _describe(fitted[k], quality, figures[k])


@njit(cache=True, nogil=True)
def _describe(p, quality, figures):
    """Fills what `Dots` says of one fit.

    In order: sigma (2), leverage (2), radius, flattening, residual, used, vague, misfit, grain.
    """
    figures[0:2] = np.nan
    figures[2], figures[3] = np.sqrt(quality[1]), np.sqrt(quality[2])
    figures[4], figures[5], figures[8] = np.nan, 0.0, np.nan
    figures[6], figures[7] = np.sqrt(quality[5]) / max(abs(p[8]), 1e-12), quality[6]
    figures[9] = np.sqrt(quality[5] - quality[10]) / max(abs(p[8]), 1e-12)
    figures[10] = np.sqrt(quality[11]) / max(abs(p[8]), 1e-12)
    determinant = p[2] * p[4] - p[3] * p[3]
    mean = 0.5 * (p[2] + p[4])
    if not (quality[0] > 0.0 and determinant > 0.0 and mean > 0.0):
        return
    white_x, white_y = quality[1] * quality[5], quality[2] * quality[5]
    shared = quality[3] + quality[4] > SHARED_NOISE * (white_x + white_y)
    figures[0] = np.sqrt((quality[3] if shared else white_x) + quality[7] ** 2 + LEAST_SIGMA**2)
    figures[1] = np.sqrt((quality[4] if shared else white_y) + quality[8] ** 2 + LEAST_SIGMA**2)
    spread = np.sqrt(max(mean * mean - determinant, 0.0))
    figures[4] = 1.0 / np.sqrt(determinant)
    figures[8] = np.sqrt(quality[9] * quality[5]) / mean
    figures[5] = (mean - spread) / (mean + spread)


def fit_dots(image: NDArray, start: Array, wanted: int | None = None, wary: bool = True) -> Dots:
    """Fit a disc to every start (D, 12), see `rafl.tracking.detection.disc_model`, or to the first ones wanted, beside the others.

    A wary fit knows highlights by what the start does not explain, so it needs a good one.
    """
    start = np.ascontiguousarray(start)
    count = len(start) if wanted is None else wanted
    fitted, figures = np.empty((count, PARAMETERS)), np.empty((count, FIGURES))
    half = count // 2 if count >= ENOUGH_FOR_TWO else 0
    other = _POOL.submit(_fit_some, image, start, 0, half, wary, fitted, figures) if half else None
    _fit_some(image, start, half, count, wary, fitted, figures)
    if other is not None:
        other.result()
    return Dots(
        centre=fitted[:, :2],
        sigma=figures[:, :2],
        parameters=fitted,
        radius=figures[:, 4],
        vague=figures[:, 8],
        flattening=figures[:, 5],
        contrast=fitted[:, 8],
        leverage=figures[:, 2:4],
        residual=figures[:, 6],
        misfit=figures[:, 9],
        grain=figures[:, 10],
        used=figures[:, 7],
    )


def start_of(x: float, y: float, shape: Array, contrast: float, level: float) -> Array:
    """Start parameters (12) of a fit: shape (3) is A's xx, xy and yy."""
    return np.array([x, y, *shape, 1.2, 0.0, 1.2, contrast, level, 0.0, 0.0])


def starts_at(places: Array, shape: Array, contrast: float, level: float) -> Array:
    """Those of fits (D, 12) at places (D, 2), all alike but for these."""
    return np.array([start_of(x, y, shape, contrast, level) for x, y in places]).reshape(-1, PARAMETERS)


def eight_bits(image: NDArray) -> NDArray[np.uint8]:
    """A picture as OpenCV's filters want it."""
    return image if image.dtype == np.uint8 else np.clip(image, 0, 255).astype(np.uint8)


def candidates(image: NDArray, dark: bool) -> Array:
    """Start parameters (D, 12) of every blob whose size and shape could be a dot's.

    Blobs are what stands out from the local mean at several scales; of blobs that overlap the one
    of the greater contrast stays.
    """
    found: list[Array] = []
    image = eight_bits(image)
    signed = cv2.bitwise_not(image) if dark else image
    mean, labels = np.empty_like(image), np.empty(image.shape, np.int32)  # fresh memory takes longer than the sums
    for radius in SCALES:
        side = int(6 * radius) | 1
        cv2.boxFilter(signed, -1, (side, side), dst=mean, borderType=cv2.BORDER_REFLECT)
        mask = cv2.subtract(signed, mean, dst=mean)
        cv2.threshold(mask, LEAST_CONTRAST, 1, cv2.THRESH_BINARY, dst=mask)
        found += _blobs(image, cv2.connectedComponents(mask, labels, connectivity=4)[0], labels, radius)
    found.sort(key=lambda start: -abs(start[8]))
    starts = np.array(found).reshape(-1, PARAMETERS)
    size = 1.0 / np.sqrt(starts[:, 2] * starts[:, 4] - starts[:, 3] ** 2)
    kept: list[int] = []
    for row, place in enumerate(starts[:, :2]):
        if np.hypot(*(place - starts[kept, :2]).T).min(initial=np.inf) > 0.8 * size[row]:
            kept.append(row)
    return starts[kept]


def _blobs(image: NDArray[np.uint8], count: int, labels: NDArray[np.int32], scale: float) -> list[Array]:
    """Start parameters (12) of those of so many labelled blobs that could be dots of about that radius [px]."""
    box, area, centroids, spreads = _extents(labels, count)
    low, high = max(RADII[0], 0.6 * scale) - 1.0, min(RADII[1], 1.7 * scale) + 1.0
    width, height = (box[:, 2:] - box[:, :2]).T
    chosen = (area > np.pi * low**2 * FLATTEST) & (area < np.pi * high**2)
    chosen &= (np.maximum(width, height) < 2.3 * high) & (np.minimum(width, height) > 2 * low * FLATTEST)
    chosen &= area > 0.55 * width * height
    likely = np.flatnonzero(chosen)
    values, vectors = np.linalg.eigh(spreads[likely] + np.eye(2) / 12)
    filled = area[likely] / (4.0 * np.pi * np.sqrt(values.prod(axis=1)))  # 1 for an ellipse
    round_ = (filled >= ROUNDEST) & (values[:, 0] >= FLATTEST**2 * values[:, 1])
    outlines = vectors / (2.0 * np.sqrt(values))[:, None] @ vectors.swapaxes(1, 2)
    starts = []
    for label, outline in zip(likely[round_], outlines[round_], strict=True):
        x, y, right, bottom = box[label]
        pad = 3
        around = image[max(y - pad, 0) : bottom + pad, max(x - pad, 0) : right + pad]
        inside = float(np.median(image[y:bottom, x:right][labels[y:bottom, x:right] == label]))
        edge = np.concatenate([around[0], around[-1], around[:, 0], around[:, -1]])
        level = float(np.median(edge))
        middle_x, middle_y = centroids[label]
        starts.append(start_of(middle_x, middle_y, outline[[0, 0, 1], [0, 1, 1]], inside - level, level))
    return starts


@njit(cache=True, nogil=True)
def _extents(labels, count):
    """What labelled blobs cover.

    Left, top and first pixel beyond right and bottom (L, 4), area (L), centroid (L, 2) and covariance of its pixels'
    places (L, 2, 2). OpenCV's own take seven times as long. Label 0, the ground, is left out.
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
    spread = np.empty((count, 2, 2))
    spread[:, 0, 0] = mean[:, 2] - mean[:, 0] ** 2
    spread[:, 0, 1] = spread[:, 1, 0] = mean[:, 3] - mean[:, 0] * mean[:, 1]
    spread[:, 1, 1] = mean[:, 4] - mean[:, 1] ** 2
    return box, area, mean[:, :2].copy(), spread


def dots_at(image: NDArray, start: Array, dark: bool) -> Dots:
    """Those of these candidates (D, 12) that a disc fits, with all their pixels or without what is strange."""
    plain = fit_dots(image, start, wary=False)
    good = _are_sound(image, plain, dark)
    others = np.concatenate([start[~good], start[good]])
    wary = fit_dots(image, others, int((~good).sum()))
    return plain[good].beside(wary[_are_sound(image, wary, dark)])


def _are_sound(image: NDArray, dots: Dots, dark: bool) -> NDArray[np.bool_]:
    good = np.isfinite(dots.sigma[:, 0]) & (dots.flattening > FLATTEST) & (dots.misfit < 0.25)
    largest = dots.radius * (1.0 + 2.0 * np.minimum(dots.vague, VAGUEST))
    good &= (largest > RADII[0] - 1) & (dots.radius < RADII[1] + 1) & (dots.used > 0.5)
    good &= (np.abs(dots.contrast) > LEAST_CONTRAST) & ((dots.contrast < 0) == dark)
    return good & dots.within(image)


def apart(dots: Dots, nearest: float) -> Dots:
    """Of dots fitted twice, the better located."""
    order = np.argsort(dots.sigma.max(axis=1))
    kept: list[int] = []
    for row in order:
        if all(np.hypot(*(dots.centre[row] - dots.centre[other])) > nearest for other in kept):
            kept.append(int(row))
    return dots[np.array(kept, dtype=int)]


def _shrunk(image: NDArray[np.uint8], shrink: int) -> NDArray[np.uint8]:
    """A picture so many times smaller."""
    height, width = (side // shrink for side in image.shape)
    part = image[: height * shrink, : width * shrink]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA) if shrink > 1 else part


def _halved(image: NDArray[np.uint8], shrink: int) -> NDArray[np.uint8]:
    """A picture 1, 2 or 4 times smaller.

    It is halved again and again, which takes a fraction of the time of another ratio; of a picture that is halved more
    than once every other line is enough.
    """
    height, width = (side // shrink * shrink for side in image.shape)
    small = image[:height:2, :width] if shrink > 2 else image[:height, :width]
    while small.shape[1] > width // shrink:
        size = (small.shape[1] // 2, max(small.shape[0] // 2, height // shrink))
        small = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)  # at half the size the mean of what it covers
    return small


def find_spots(
    image: NDArray, radius: float, least: float, region: tuple[int, int, int, int], hurried: bool = False
) -> Array:
    """Where dots of a known radius may be, quickly, to half a radius or so, (D, 2).

    Args:
        image: grey levels.
        radius: of the dots [px].
        least: what they must stand out by, negative for dark dots [grey levels].
        region: left, top, right, bottom of where to look [px].
        hurried: in half the time; of blurred dots side by side one may be overlooked.
    """
    left, top = max(region[0], 0), max(region[1], 0)
    part = eight_bits(image[top : max(region[3], 0), left : max(region[2], 0)])
    shrink = next((factor for factor in (4, 2) if radius >= SMALL * factor), 1) if hurried else max(int(radius / 3), 1)
    if min(part.shape) < 3 * shrink:
        return np.zeros((0, 2))
    small = _halved(part, shrink) if hurried else _shrunk(part, shrink)
    signed = small if least > 0 else 255 - small
    inner, outer = (int(factor * radius / shrink) | 1 for factor in (1.3, 4.5))
    level = cv2.boxFilter(signed, cv2.CV_32F, (outer, outer), borderType=cv2.BORDER_REFLECT)
    response = cv2.boxFilter(signed, cv2.CV_32F, (inner, inner), borderType=cv2.BORDER_REFLECT)
    response = cv2.subtract(response, level, dst=response)  # in place: fresh memory takes longer than the sums
    highest = cv2.dilate(response, np.ones((inner, inner)), dst=level)
    peaks = (highest == response) & (response > abs(least))
    rows, columns = np.divmod(np.flatnonzero(peaks), peaks.shape[1])  # np.nonzero takes ten times as long
    centre = (shrink - 1) / 2.0
    spots = np.stack([columns * shrink + centre + left, rows * shrink + centre + top], axis=1)
    # A flat top has several peaks; taken for two dots, each would be fitted without the pixels of the other.
    one, other = cKDTree(spots).query_pairs(radius, output_type="ndarray").reshape(-1, 2).T
    strength = response[rows, columns]
    return np.delete(spots, np.where(strength[one] < strength[other], one, other), axis=0)
