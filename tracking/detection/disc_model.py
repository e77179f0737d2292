"""A soft-edged elliptical disc in a picture: which pixels tell of it, and how they follow its parameters.

The outline is |A (x - c)| = 1 with A symmetric. Across it the level changes as the running integral of a
bell curve whose variance along the outline's normal n is n . W n: lens blur, the pixel's own width and the
smear of motion during the exposure all add to W. The light falls off evenly across the disc and around it,
by the factor 1 + slopes . (x - c).
"""

from math import comb
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

PARAMETERS = 12  # centre (2), A (3: xx, xy, yy), W (3: xx, xy, yy) [px^2], contrast, level, slopes of the light (2)
LARGEST = 8192  # pixels a fit looks at
LINE = 64  # pixels that memory gives at a time
CHUNK = 256  # pixels whose derivatives are held at a time, so that they stay in the nearest cache
LANES = 32  # pixels that vector instructions take at a time; a fit's last ones are filled up by some of no weight

# Rows of a fit's scratch, one array: so the compiler sees that no two of them overlap.
X, Y, VALUE, WEIGHT, RESIDUAL, SIZE, SHOWN, FLAT = (LARGEST * row for row in range(8))
BLOCK_OF = SIZE  # at another time
J = 8 * LARGEST  # a chunk's derivatives by the parameters, 12 rows, and its residual
WEIGHTED = J + 13 * CHUNK  # two rows
SCRATCH = WEIGHTED + 2 * CHUNK
LEAST_BLUR, MOST_BLUR = 0.08, 40.0  # of W along any direction [px^2]
# How far from the outline a fit looks: so many standard deviations of a blurred edge and a share of the radius, but no
# farther than so many radii and px, or so many standard deviations past the end of a smear's way: the edge of a sticker
# that the dot is on would pass for its blur.
REACHED, MARGIN, FARTHEST, PAST_END = 3.0, 0.3, (0.5, 5.0), 1.5
REACH = 4.0  # half the bell curve's support, in standard deviations

# The bell (1 - z^2 / 16)^8 on |z| < 4 is close to exp(-z^2 / 2) and integrates to an odd polynomial.
_SERIES = np.array([comb(8, k) * (-1.0 / 16.0) ** k / (2 * k + 1) for k in range(9)])
_HEIGHT = 0.5 / (REACH * float(np.polyval(_SERIES[::-1], REACH**2)))
_S = [float(c * _HEIGHT) for c in _SERIES]
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8 = _S

FAST: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
}


@njit(**FAST)
def choose_pixels(image, p, near, w):
    """The pixels a fit looks at, relative to the rounded centre; returns how many.

    Where the disc's level or its surroundings' is flat every other pixel is enough.

    near (K, 3): centre and radius of other dots, whose pixels are left out.
    """
    height, width = image.shape
    x0, y0 = int(np.rint(p[0])), int(np.rint(p[1]))
    half = 0.5 * (p[2] + p[4])
    spread = np.sqrt(0.25 * (p[2] - p[4]) ** 2 + p[3] ** 2)
    if not half - spread > 0.01:
        return 0
    smallest, largest = 1.0 / (half + spread), 1.0 / (half - spread)
    mean, smeared = 0.5 * (p[5] + p[7]), np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    way_end = 0.5 * np.sqrt(24.0 * smeared) + PAST_END * np.sqrt(max(mean - smeared, 0.0))
    farthest = max(FARTHEST[0] * smallest + FARTHEST[1], way_end - MARGIN * smallest)
    edge = min(REACHED * np.sqrt(max(mean, 0.5)) + 1.0, farthest)
    margin = (1.0 + edge) / smallest + MARGIN
    inside, outside, end = max(1.0 - edge / smallest, 0.0) ** 2, (1.0 + edge / smallest) ** 2, (1.0 + margin) ** 2
    window = int(largest * (1.0 + margin)) + 1
    # |A d|^2 = along (dx + lean dy)^2 + across dy^2
    along = p[2] * p[2] + p[3] * p[3]
    lean = p[3] * (p[2] + p[4]) / along
    across = p[3] * p[3] + p[4] * p[4] - along * lean * lean
    top, bottom = max(y0 - window, 0), min(y0 + window + 1, height)
    left, right = max(x0 - window, 0), min(x0 + window, width - 1)
    touched = 0
    for row in range(top, bottom):  # asks for all rows at once, of a picture that no cache holds yet
        for column in range(left, right, LINE):
            touched += image[row, column]
        touched += image[row, max(right, 0)]
    w[SIZE] = touched
    count = 0
    for row in range(top, bottom):
        least = across * (row - p[1]) ** 2
        if least > end:
            continue
        middle, reach = p[0] - lean * (row - p[1]), np.sqrt((end - least) / along)
        first, last = max(int(np.ceil(middle - reach)), 0), min(int(np.floor(middle + reach)), width - 1)
        if count + last - first >= LARGEST - CHUNK:
            return 0
        line = image[row]
        for column in range(first, last + 1):
            r2 = least + along * (column - middle) ** 2
            skipped = ((r2 < inside) | (r2 > outside)) & ((row + column) & 1)
            w[X + count] = column - x0
            w[Y + count] = row - y0
            w[VALUE + count] = line[np.uintp(column)]
            count += 1 - skipped  # no branch: where the pattern ends is nothing that a processor can foresee
    count = _without(near, x0, y0, count, w)
    for k in range(count, filled_up(count)):
        w[X + k] = w[Y + k] = w[VALUE + k] = w[WEIGHT + k] = np.float32(0.0)
    return count


@njit(**FAST)
def _without(near, x0, y0, count, w):
    """Leaves out other dots' pixels; returns how many stay."""
    for other in range(near.shape[0]):
        x, y, square = near[other, 0] - x0, near[other, 1] - y0, (near[other, 2] + 3.0) ** 2
        kept = 0
        for k in range(count):
            w[X + kept], w[Y + kept], w[VALUE + kept] = w[X + k], w[Y + k], w[VALUE + k]
            kept += (w[X + k] - x) ** 2 + (w[Y + k] - y) ** 2 >= square
        count = kept
    return count


@njit(**FAST)
def filled_up(count):
    """So many pixels and those that fill them up to a multiple of `LANES`."""
    return (count + LANES - 1) // LANES * LANES


@njit(**FAST)
def linearise(p, instants, x0, y0, first, count, w):
    """Derivatives of a chunk's pixels, from the `first`, by the parameters, and the residual.

    A disc that moves far while the shutter is open is a mean over several instants; p[5:8] are then the
    edge's variance and the way moved instead of W.
    """
    count = min(count, CHUNK)  # said aloud, with the next, so that the loops become vector instructions
    first = min(max(first, 0), LARGEST - CHUNK)
    fx = p[0] - x0
    fy = p[1] - y0
    one = np.float32(1.0)
    half = np.float32(0.5)
    tiny = np.float32(1e-9)
    a = np.float32(p[2])
    b = np.float32(p[3])
    c = np.float32(p[4])
    w0 = np.float32(p[5])
    smeared = instants > 1
    w1 = np.float32(0.0 if smeared else 2.0 * p[6])
    w2 = np.float32(p[5] if smeared else p[7])
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
    # What p[5:8] mean is told by factors: a branch among the pixels would keep them from vector instructions.
    round_ = np.float32(1.0 if smeared else 0.0)
    once, twice = one - round_, np.float32(2.0) * (one - round_)
    for instant in range(instants):
        u = np.float32((instant + 0.5) / instants - 0.5)
        way = u * round_
        mx = np.float32(fx + u * p[6]) if smeared else cx
        my = np.float32(fy + u * p[7]) if smeared else cy
        # One short loop after another, by way of rows that the light's derivatives fill last: in one long loop every
        # pixel would wait for the one before.
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
            gx = a * ax + b * ay  # of r
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
            # The same blur is a larger share of a smaller dot.
            hx = by_r * dx + np.float32(2.0) * by_w * (w0 * gx + half * w1 * gy)
            hy = by_r * dy + np.float32(2.0) * by_w * (half * w1 * gx + w2 * gy)
            gx *= by_r
            gy *= by_r
            w[J + k] -= gx
            w[J + CHUNK + k] -= gy
            w[J + 2 * CHUNK + k] += ax * hx
            w[J + 3 * CHUNK + k] += ax * hy + ay * hx
            w[J + 4 * CHUNK + k] += ay * hy
            w[J + 5 * CHUNK + k] += xx + round_ * yy
            w[J + 6 * CHUNK + k] += twice * xy - way * gx
            w[J + 7 * CHUNK + k] += once * yy - way * gy
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
def instants_of(p):
    """How many instants resolve the way p[6:8] moved during the exposure, and a little more."""
    return min(4 + int(np.hypot(p[6], p[7]) / (1.2 * np.sqrt(p[5]))), 32)


@njit(**FAST)
def smear(p):
    """Exchanges W, of a long smear, for an edge and a way moved: a box of length m has variance m^2 / 12."""
    mean = 0.5 * (p[5] + p[7])
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    length = np.sqrt(24.0 * spread)
    angle = 0.5 * np.arctan2(2.0 * p[6], p[5] - p[7])
    p[5] = max(mean - spread, LEAST_BLUR)
    p[6] = length * np.cos(angle)
    p[7] = length * np.sin(angle)
