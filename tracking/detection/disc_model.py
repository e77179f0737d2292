"""Model of a soft-edged elliptical disc: which pixels belong to it, and their derivatives by its parameters.

The outline is |A (x - c)| = 1 with A symmetric. Across it the level changes as the integral of a bell curve whose
variance along the outline's normal n is n . W n. Lens blur, the pixel's own width and motion blur all add to W. The
light falls off linearly across the disc and around it, by the factor 1 + slopes . (x - c).

A fit's parameters p (12) are the centre (2) [px], A (3: xx, xy, yy) [1/px], W (3: xx, xy, yy) [px^2], contrast and
level [grey levels], and the slopes of the light (2) [1/px].

A fit works in one scratch array w of float32, so that the compiler sees that its rows do not overlap.
"""

from math import comb
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

PARAMETER_COUNT = 12
MAX_PIXELS = 8192  # pixels of a fit
CACHE_LINE_PIXELS = 64  # 8-bit pixels in a cache line
CHUNK = 256  # pixels whose derivatives are kept at a time, so that they stay in the first-level cache
SIMD_LANES = 32  # pixels that SIMD instructions process at a time; a fit's pixels are padded to a multiple of it

# Offsets in the scratch array. For each pixel: position relative to the rounded centre [px], grey level, weight,
# residual, working space, weight by its level (see `disc_fit`), and whether the model is flat there.
X, Y, VALUE, WEIGHT, RESIDUAL, WORK, LEVEL_WEIGHT, FLAT = (MAX_PIXELS * row for row in range(8))
BLOCK_INDEX = WORK  # the same space at another time
J = 8 * MAX_PIXELS  # a chunk's derivatives by the parameters, 12 rows, and its residual
WEIGHTED = J + 13 * CHUNK  # two rows
SCRATCH_SIZE = WEIGHTED + 2 * CHUNK
MIN_EDGE_VARIANCE, MAX_EDGE_VARIANCE = 0.08, 40.0  # px^2: of W along any direction
# A fit uses the pixels within a margin of the outline: MARGIN_EDGE_SIGMAS sigmas of the blurred edge, plus
# MARGIN_RADII radii. The first part is at most MAX_MARGIN (fraction of the radius, plus px), or MOTION_END_SIGMAS
# sigmas past the end of the motion, if that is more. Farther out, the edge of a sticker that the dot is on
# would pass for the dot's blur.
MARGIN_EDGE_SIGMAS, MARGIN_RADII, MAX_MARGIN, MOTION_END_SIGMAS = 3.0, 0.3, (0.5, 5.0), 1.5
PROFILE_SUPPORT = 4.0  # sigmas: half the bell curve's support

# The bell (1 - z^2 / 16)^8 on |z| < 4 is close to exp(-z^2 / 2) and integrates to an odd polynomial.
_SERIES = np.array([comb(8, k) * (-1.0 / 16.0) ** k / (2 * k + 1) for k in range(9)])
_HEIGHT = 0.5 / (PROFILE_SUPPORT * float(np.polyval(_SERIES[::-1], PROFILE_SUPPORT**2)))
_S = [float(c * _HEIGHT) for c in _SERIES]
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8 = _S

FAST: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
}


@njit(**FAST)
def select_pixels(image, p, near, w):
    """Fill the positions and levels of the pixels that a fit uses; returns how many.

    Every other pixel is enough where the disc's level or that of its surroundings is flat.

    near (K, 3): centre and radius of other dots, whose pixels are left out.
    """
    height, width = image.shape
    x0, y0 = int(np.rint(p[0])), int(np.rint(p[1]))
    half = 0.5 * (p[2] + p[4])
    spread = np.sqrt(0.25 * (p[2] - p[4]) ** 2 + p[3] ** 2)
    if not half - spread > 0.01:
        return 0
    smallest, largest = 1.0 / (half + spread), 1.0 / (half - spread)
    mean, motion_variance = 0.5 * (p[5] + p[7]), np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    motion_end = 0.5 * np.sqrt(24.0 * motion_variance) + MOTION_END_SIGMAS * np.sqrt(max(mean - motion_variance, 0.0))
    max_edge = max(MAX_MARGIN[0] * smallest + MAX_MARGIN[1], motion_end - MARGIN_RADII * smallest)
    edge = min(MARGIN_EDGE_SIGMAS * np.sqrt(max(mean, 0.5)) + 1.0, max_edge)
    margin = (1.0 + edge) / smallest + MARGIN_RADII
    inside, outside, end = max(1.0 - edge / smallest, 0.0) ** 2, (1.0 + edge / smallest) ** 2, (1.0 + margin) ** 2
    window = int(largest * (1.0 + margin)) + 1
    # |A d|^2 = along (dx + lean dy)^2 + across dy^2
    along = p[2] * p[2] + p[3] * p[3]
    lean = p[3] * (p[2] + p[4]) / along
    across = p[3] * p[3] + p[4] * p[4] - along * lean * lean
    top, bottom = max(y0 - window, 0), min(y0 + window + 1, height)
    left, right = max(x0 - window, 0), min(x0 + window, width - 1)
    touched = 0
    for row in range(top, bottom):  # prefetch all rows at once: no cache holds the frame yet
        for column in range(left, right, CACHE_LINE_PIXELS):
            touched += image[row, column]
        touched += image[row, max(right, 0)]
    w[WORK] = touched
    count = 0
    for row in range(top, bottom):
        least = across * (row - p[1]) ** 2
        if least > end:
            continue
        middle, reach = p[0] - lean * (row - p[1]), np.sqrt((end - least) / along)
        first, last = max(int(np.ceil(middle - reach)), 0), min(int(np.floor(middle + reach)), width - 1)
        if count + last - first >= MAX_PIXELS - CHUNK:
            return 0
        line = image[row]
        for column in range(first, last + 1):
            r2 = least + along * (column - middle) ** 2
            skipped = ((r2 < inside) | (r2 > outside)) & ((row + column) & 1)
            w[X + count] = column - x0
            w[Y + count] = row - y0
            w[VALUE + count] = line[np.uintp(column)]
            count += 1 - skipped  # no branch: a processor could not predict it
    count = _exclude_neighbours(near, x0, y0, count, w)
    for k in range(count, pad_to_lanes(count)):
        w[X + k] = w[Y + k] = w[VALUE + k] = w[WEIGHT + k] = np.float32(0.0)
    return count


@njit(**FAST)
def _exclude_neighbours(near, x0, y0, count, w):
    """Remove the pixels of other dots; returns how many remain."""
    for other in range(near.shape[0]):
        x, y, square = near[other, 0] - x0, near[other, 1] - y0, (near[other, 2] + 3.0) ** 2
        kept = 0
        for k in range(count):
            w[X + kept], w[Y + kept], w[VALUE + kept] = w[X + k], w[Y + k], w[VALUE + k]
            kept += (w[X + k] - x) ** 2 + (w[Y + k] - y) ** 2 >= square
        count = kept
    return count


@njit(**FAST)
def pad_to_lanes(count):
    """Round a number of pixels up to a multiple of `SIMD_LANES`."""
    return (count + SIMD_LANES - 1) // SIMD_LANES * SIMD_LANES


@njit(**FAST)
def linearise(p, instants, x0, y0, first, count, w):
    """Fill the residuals of the chunk of pixels that starts at `first`, and their derivatives by the parameters.

    A disc that moves far during the exposure is a mean over several instants. Then p[5:8] are the edge's variance and
    the displacement (2) instead of W.
    """
    count = min(count, CHUNK)  # these two limits let the compiler vectorise the loops
    first = min(max(first, 0), MAX_PIXELS - CHUNK)
    fx = p[0] - x0
    fy = p[1] - y0
    one = np.float32(1.0)
    half = np.float32(0.5)
    tiny = np.float32(1e-9)
    a = np.float32(p[2])
    b = np.float32(p[3])
    c = np.float32(p[4])
    w0 = np.float32(p[5])
    moving = instants > 1
    w1 = np.float32(0.0 if moving else 2.0 * p[6])
    w2 = np.float32(p[5] if moving else p[7])
    contrast = np.float32(p[8] / instants)
    level = np.float32(p[9])
    sx = np.float32(p[10])
    sy = np.float32(p[11])
    cx = np.float32(fx)
    cy = np.float32(fy)
    for i in range(9):
        for k in range(count):
            w[J + i * CHUNK + k] = np.float32(0.0)
    share = one / np.float32(instants)
    # Factors select the meaning of p[5:8]: a branch in the loops over the pixels would prevent SIMD instructions.
    isotropic = np.float32(1.0 if moving else 0.0)
    only_w, twice_w = one - isotropic, np.float32(2.0) * (one - isotropic)
    for instant in range(instants):
        time = np.float32((instant + 0.5) / instants - 0.5)
        displacement_share = time * isotropic
        mx = np.float32(fx + time * p[6]) if moving else cx
        my = np.float32(fy + time * p[7]) if moving else cy
        # Several short loops, which pass values in rows that the derivatives by the light fill last. In one long loop,
        # every pixel would wait for the one before.
        for k in range(count):
            dx = w[X + first + k] - mx
            dy = w[Y + first + k] - my
            ax = a * dx + b * dy
            ay = b * dx + c * dy
            square = ax * ax + ay * ay + tiny
            inverse_r = one / np.sqrt(square)
            w[J + 9 * CHUNK + k] = ax * inverse_r
            w[J + 10 * CHUNK + k] = ay * inverse_r
            w[J + 11 * CHUNK + k] = one - square * inverse_r
        for k in range(count):
            ax = w[J + 9 * CHUNK + k]
            ay = w[J + 10 * CHUNK + k]
            gx = a * ax + b * ay  # gradient of r
            gy = b * ax + c * ay
            inverse_w = one / np.sqrt(w0 * gx * gx + w1 * gx * gy + w2 * gy * gy + tiny)
            z = w[J + 11 * CHUNK + k] * inverse_w
            w[J + 11 * CHUNK + k] = min(max(z, np.float32(-4.0)), np.float32(4.0))
            w[J + 12 * CHUNK + k] = inverse_w
        for k in range(count):
            z = w[J + 11 * CHUNK + k]
            inverse_w = w[J + 12 * CHUNK + k]
            t = z * z
            q = one - t * np.float32(1.0 / 16.0)
            q = q * q
            q = q * q
            step = np.float32(_S7) + t * np.float32(_S8)
            step = np.float32(_S6) + t * step
            step = np.float32(_S5) + t * step
            step = np.float32(_S4) + t * step
            step = np.float32(_S3) + t * step
            step = np.float32(_S2) + t * step
            step = np.float32(_S1) + t * step
            step = half + z * (np.float32(_S0) + t * step)
            by_r = -contrast * np.float32(_HEIGHT) * q * q * inverse_w
            w[J + 8 * CHUNK + k] += share * step
            w[J + 11 * CHUNK + k] = by_r
            w[J + 12 * CHUNK + k] = half * by_r * z * inverse_w
        for k in range(count):
            dx = w[X + first + k] - mx
            dy = w[Y + first + k] - my
            ax = w[J + 9 * CHUNK + k]
            ay = w[J + 10 * CHUNK + k]
            by_r = w[J + 11 * CHUNK + k]
            by_w = w[J + 12 * CHUNK + k]
            gx = a * ax + b * ay
            gy = b * ax + c * ay
            xx = by_w * gx * gx
            xy = by_w * gx * gy
            yy = by_w * gy * gy
            # A also changes how large the blur is relative to the radius.
            hx = by_r * dx + np.float32(2.0) * by_w * (w0 * gx + half * w1 * gy)
            hy = by_r * dy + np.float32(2.0) * by_w * (half * w1 * gx + w2 * gy)
            gx *= by_r
            gy *= by_r
            w[J + k] -= gx
            w[J + CHUNK + k] -= gy
            w[J + 2 * CHUNK + k] += ax * hx
            w[J + 3 * CHUNK + k] += ax * hy + ay * hx
            w[J + 4 * CHUNK + k] += ay * hy
            w[J + 5 * CHUNK + k] += xx + isotropic * yy
            w[J + 6 * CHUNK + k] += twice_w * xy - displacement_share * gx
            w[J + 7 * CHUNK + k] += only_w * yy - displacement_share * gy
    whole = np.float32(p[8])
    for k in range(count):
        dx = w[X + first + k] - cx
        dy = w[Y + first + k] - cy
        even = level + whole * w[J + 8 * CHUNK + k]
        w[J + k] -= even * sx
        w[J + CHUNK + k] -= even * sy
        w[J + 9 * CHUNK + k] = one
        w[J + 10 * CHUNK + k] = even * dx
        w[J + 11 * CHUNK + k] = even * dy
        residual = w[VALUE + first + k] - even * (one + sx * dx + sy * dy)
        w[J + 12 * CHUNK + k] = residual
        w[RESIDUAL + first + k] = residual


@njit(**FAST)
def count_instants(p):
    """Number of instants that resolves the displacement p[6:8] during the exposure, with a margin."""
    return min(4 + int(np.hypot(p[6], p[7]) / (1.2 * np.sqrt(p[5]))), 32)


@njit(**FAST)
def split_motion_blur(p):
    """Replace W by the edge's variance and the displacement m: a box of length m has variance m^2 / 12."""
    mean = 0.5 * (p[5] + p[7])
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    length = np.sqrt(24.0 * spread)
    angle = 0.5 * np.arctan2(2.0 * p[6], p[5] - p[7])
    p[5] = max(mean - spread, MIN_EDGE_VARIANCE)
    p[6] = length * np.cos(angle)
    p[7] = length * np.sin(angle)
