"""Finding dots in a picture and fitting a soft-edged disc to each."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

RADII = (3.0, 32.0)  # of the dots looked for [px]
FLATTEST = 0.4  # least ratio of the axes
ROUNDEST = 0.75  # least share of the outline's ellipse that is filled
LEAST_CONTRAST = 12.0  # grey levels
PARAMETERS = 10  # x, y, the shape's three, edge width, contrast, level, its two slopes


@dataclass(frozen=True)
class Dots:
    """Dots of one picture.

    Attributes:
        centre: [px], (D, 2).
        sigma: standard deviation of the centre, from the fit's residual [px], (D).
        radius: geometric mean of the semi-axes [px], (D).
        flattening: ratio of the axes, 1 for a circle, (D).
        contrast: of the dot against its surroundings, negative for dark dots [grey levels], (D).
        residual: root mean square misfit of the disc, as a share of the contrast, (D).
    """

    centre: Array
    sigma: Array
    radius: Array
    flattening: Array
    contrast: Array
    residual: Array

    def __len__(self) -> int:
        return len(self.centre)

    def __getitem__(self, rows: NDArray) -> "Dots":
        return Dots(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@njit(cache=True, nogil=True)
def _model(x, y, p, derivative):  # type: ignore[no-untyped-def]
    """A disc's grey level at (x, y) and its derivative by the ten parameters.

    The outline is |A (x - c)| = 1 with A = [[p2, p3], [p3, p4]]; across it the level changes by a
    logistic step of width p5 [px], measured along the normal.
    """
    dx = x - p[0]
    dy = y - p[1]
    ax = p[2] * dx + p[3] * dy
    ay = p[3] * dx + p[4] * dy
    r = np.sqrt(ax * ax + ay * ay) + 1e-12
    gx = (p[2] * ax + p[3] * ay) / r  # gradient of r
    gy = (p[3] * ax + p[4] * ay) / r
    g = np.sqrt(gx * gx + gy * gy) + 1e-12
    d = (1.0 - r) / g  # signed distance to the outline, positive inside
    z = d / p[5]
    if z > 30.0:
        s = 1.0
    elif z < -30.0:
        s = 0.0
    else:
        s = 1.0 / (1.0 + np.exp(-z))
    slope = p[6] * s * (1.0 - s) / p[5]
    # The normal's turning along the edge is of second order: g is held.
    by_r = -slope / g
    derivative[0] = -by_r * gx
    derivative[1] = -by_r * gy
    derivative[2] = by_r * ax * dx / r
    derivative[3] = by_r * (ax * dy + ay * dx) / r
    derivative[4] = by_r * ay * dy / r
    derivative[5] = -slope * z
    derivative[6] = s
    derivative[7] = 1.0
    derivative[8] = dx
    derivative[9] = dy
    return p[6] * s + p[7] + p[8] * dx + p[9] * dy


@njit(cache=True, nogil=True)
def _fit_disc(image, p, reach, dots_near, out):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt fit of a disc to the pixels within `reach` outlines of its centre.

    p (10) is the start and is filled with the result; dots_near (K, 3): centre and radius of other
    dots, whose pixels are left out. out (2): variance of the centre [px^2], mean squared residual.
    Returns whether it converged.
    """
    n = PARAMETERS
    height, width = image.shape
    derivative = np.empty(n)
    H = np.empty((n, n))
    b = np.empty(n)
    trial = p.copy()
    damping = 1e-3
    best = np.inf
    x0, y0 = p[0], p[1]
    radius = 1.0 / np.sqrt(abs(p[2] * p[4] - p[3] * p[3]))
    window = reach * radius + 3.0
    left, right = max(int(x0 - window), 0), min(int(x0 + window) + 2, width)
    top, bottom = max(int(y0 - window), 0), min(int(y0 + window) + 2, height)
    a0, b0, c0 = p[2], p[3], p[4]
    count = 0
    step = p * 0.0
    for iteration in range(40):
        cost = 0.0
        count = 0
        H[:] = 0.0
        b[:] = 0.0
        for row in range(top, bottom):
            for column in range(left, right):
                ex, ey = column - x0, row - y0
                ox, oy = a0 * ex + b0 * ey, b0 * ex + c0 * ey
                if np.sqrt(ox * ox + oy * oy) > reach + 2.0 / radius:
                    continue
                taken = False
                for k in range(dots_near.shape[0]):
                    ex, ey = column - dots_near[k, 0], row - dots_near[k, 1]
                    if ex * ex + ey * ey < (dots_near[k, 2] + 3.0) ** 2:
                        taken = True
                if taken:
                    continue
                gap = image[row, column] - _model(float(column), float(row), trial, derivative)
                cost += gap * gap
                count += 1
                for i in range(n):
                    b[i] += derivative[i] * gap
                    for j in range(i + 1):
                        H[i, j] += derivative[i] * derivative[j]
        if count < 2 * n:
            return False
        if cost <= best:
            small = best - cost < 1e-7 * cost or np.abs(step[:2]).max() < 1e-4
            best = cost
            p[:] = trial
            damping = max(0.3 * damping, 1e-9)
            for i in range(n):
                for j in range(i):
                    H[j, i] = H[i, j]
            kept = H.copy()
            kept_b = b.copy()
            if iteration > 1 and small:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
        A = kept.copy()
        for i in range(n):
            A[i, i] += (damping + 1e-10) * kept[i, i] + 1e-12
        if not np.isfinite(A).all():
            return False
        step = np.linalg.solve(A, kept_b)
        for i in range(n):
            trial[i] = p[i] + step[i]
        trial[5] = min(max(trial[5], 0.15), 4.0)
    for i in range(n):
        kept[i, i] += 1e-10 * kept[i, i] + 1e-12
    inverse = np.linalg.inv(kept)
    noise = best / (count - n)
    out[0] = 0.5 * noise * (inverse[0, 0] + inverse[1, 1])
    out[1] = best / count
    return abs(p[0] - x0) < 0.7 * radius and abs(p[1] - y0) < 0.7 * radius and out[0] > 0.0


@njit(cache=True, nogil=True)
def _refine_all(image, start, reach, fitted, quality):  # type: ignore[no-untyped-def]
    """Fit every start (D, 10); fills fitted (D, 10) and quality (D, 3): converged, variance, residual."""
    count = start.shape[0]
    radius = 1.0 / np.sqrt(np.abs(start[:, 2] * start[:, 4] - start[:, 3] ** 2))
    out = np.empty(2)
    for k in range(count):
        near = np.empty((8, 3))
        found = 0
        for other in range(count):
            distance = np.hypot(start[other, 0] - start[k, 0], start[other, 1] - start[k, 1])
            if other != k and found < 8 and distance < reach * radius[k] + radius[other] + 6.0:
                near[found, 0], near[found, 1], near[found, 2] = (
                    start[other, 0],
                    start[other, 1],
                    radius[other],
                )
                found += 1
        fitted[k] = start[k]
        good = _fit_disc(image, fitted[k], reach, near[:found], out)
        quality[k, 0] = 1.0 if good else 0.0
        quality[k, 1] = out[0]
        quality[k, 2] = out[1]


def candidates(image: NDArray[np.uint8], dark: bool) -> Array:
    """Start parameters (D, 10) of every blob whose size and shape could be a dot's.

    Blobs are what stands out from the local mean at several scales; of blobs that overlap the one
    of the greater contrast stays.
    """
    found: list[Array] = []
    signed = 255 - image if dark else image
    for radius in (4.0, 8.0, 16.0, 27.0):
        side = int(6 * radius) | 1
        mean = cv2.boxFilter(signed, -1, (side, side), borderType=cv2.BORDER_REFLECT)
        mask = (signed > cv2.add(mean, LEAST_CONTRAST)).astype(np.uint8)
        found += _blobs(image, mask, radius)
    found.sort(key=lambda start: -abs(start[6]))
    kept: list[Array] = []
    for start in found:
        size = 1.0 / np.sqrt(start[2] * start[4] - start[3] ** 2)
        if all(np.hypot(*(start[:2] - other[:2])) > 0.8 * size for other in kept):
            kept.append(start)
    return np.array(kept).reshape(-1, PARAMETERS)


def _blobs(image: NDArray[np.uint8], mask: NDArray[np.uint8], scale: float) -> list[Array]:
    _, labels, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=4)
    low, high = max(RADII[0], 0.6 * scale) - 1.0, min(RADII[1], 1.7 * scale) + 1.0
    area = stats[:, cv2.CC_STAT_AREA]
    width, height = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    chosen = (area > np.pi * low**2 * FLATTEST) & (area < np.pi * high**2)
    chosen &= (np.maximum(width, height) < 2.3 * high) & (np.minimum(width, height) > 2 * low * FLATTEST)
    chosen &= area > 0.55 * width * height
    chosen[0] = False
    starts = []
    for label in np.flatnonzero(chosen):
        x, y, w, h = stats[label, :4]
        own = labels[y : y + h, x : x + w] == label
        rows, columns = np.nonzero(own)
        cx, cy = centroids[label]
        dx, dy = columns + x - cx, rows + y - cy
        covariance = np.array([[dx @ dx, dx @ dy], [dx @ dy, dy @ dy]]) / len(rows) + np.eye(2) / 12
        values, vectors = np.linalg.eigh(covariance)
        filled = len(rows) / (4.0 * np.pi * np.sqrt(values.prod()))  # 1 for an ellipse
        if filled < ROUNDEST or values[0] < FLATTEST**2 * values[1]:
            continue
        outline = vectors @ np.diag(0.5 / np.sqrt(values)) @ vectors.T
        pad = 3
        around = image[max(y - pad, 0) : y + h + pad, max(x - pad, 0) : x + w + pad]
        inside = float(np.median(image[y : y + h, x : x + w][own]))
        edge = np.concatenate([around[0], around[-1], around[:, 0], around[:, -1]])
        level = float(np.median(edge))
        starts.append(
            np.array([cx, cy, outline[0, 0], outline[0, 1], outline[1, 1], 0.7, inside - level, level, 0.0, 0.0])
        )
    return starts


def refine(image: NDArray[np.uint8], start: Array, reach: float = 1.5) -> Dots:
    """Fit a disc to every start (D, 10), out to `reach` times its outline.

    Where a fit fails `sigma` is NaN.
    """
    fitted = np.empty_like(start)
    quality = np.empty((len(start), 3))
    _refine_all(image, start, reach, fitted, quality)
    determinant = fitted[:, 2] * fitted[:, 4] - fitted[:, 3] ** 2
    mean = 0.5 * (fitted[:, 2] + fitted[:, 4])
    spread = np.sqrt(np.maximum(mean**2 - determinant, 0.0))
    flattening = np.where(determinant > 0, (mean - spread) / (mean + spread), 0.0)
    good = (quality[:, 0] > 0) & (determinant > 0)
    radius = 1.0 / np.sqrt(np.where(good, determinant, np.nan))
    sigma = np.sqrt(np.where(good, quality[:, 1], np.nan))
    contrast = fitted[:, 6]
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.sqrt(quality[:, 2]) / np.abs(contrast)
    return Dots(fitted[:, :2], sigma, radius, flattening, contrast, residual)


def find_dots(image: NDArray[np.uint8], dark: bool) -> Dots:
    """All dots of a picture that a disc fits."""
    start = candidates(image, dark)
    if not len(start):
        none = np.zeros(0)
        return Dots(np.zeros((0, 2)), none, none, none, none, none)
    dots = refine(image, start)
    good = np.isfinite(dots.sigma) & (dots.flattening > FLATTEST) & (dots.residual < 0.25)
    good &= (dots.radius > RADII[0] - 1) & (dots.radius < RADII[1] + 1)
    good &= (np.abs(dots.contrast) > LEAST_CONTRAST) & ((dots.contrast < 0) == dark)
    return dots[good]
