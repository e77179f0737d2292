"""Fitting a soft-edged elliptical disc to a picture's pixels.

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
QUALITY = 7  # converged; centre's variances by independent errors (2), by blocks (2); mean squared residual; share used
LARGEST = 8192  # pixels a fit looks at
CHUNK = 256  # pixels whose derivatives are held at a time, so that they stay in the nearest cache

# Rows of a fit's scratch, one array: so the compiler sees that no two of them overlap.
X, Y, VALUE, WEIGHT, RESIDUAL, SIZE = (LARGEST * row for row in range(6))
BLOCK_OF = SIZE  # at another time
J = 6 * LARGEST  # a chunk's derivatives by the parameters, 12 rows, its residual, and 3 rows never looked at
WEIGHTED = J + 16 * CHUNK
SCRATCH = WEIGHTED + CHUNK
LEAST_BLUR, MOST_BLUR = 0.08, 40.0  # of W along any direction [px^2]
REACH = 4.0  # half the bell curve's support, in standard deviations
OUTLYING = 0.12  # of the contrast: a pixel farther off than this shows something else than the dot
STRANGE = 0.25  # of the contrast: a level this far from what the start expects
NEAR = 0.03  # px: the next step would be a hundred times smaller
WORTHLESS = 1.0  # of a pixel's mean squared residual: a gain that says nothing more about the disc
LONG_SMEAR = 0.4  # of the radius: motion during the exposure that a blurred edge does not describe any more
BLOCK = 4  # px: errors closer than this are not taken to be independent

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
def _choose_pixels(image, p, near, w):  # type: ignore[no-untyped-def]
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
    edge = 3.0 * np.sqrt(max(0.5 * (p[5] + p[7]), 0.5)) + 1.0
    margin = (1.0 + edge) / smallest + 0.3
    inside, outside, end = max(1.0 - edge / smallest, 0.0) ** 2, (1.0 + edge / smallest) ** 2, (1.0 + margin) ** 2
    window = int(largest * (1.0 + margin)) + 1
    count = 0
    fx, fy = p[0] - x0, p[1] - y0
    for row in range(max(y0 - window, 0), min(y0 + window + 1, height)):
        for column in range(max(x0 - window, 0), min(x0 + window + 1, width)):
            dx, dy = column - x0 - fx, row - y0 - fy
            ax, ay = p[2] * dx + p[3] * dy, p[3] * dx + p[4] * dy
            r2 = ax * ax + ay * ay
            if r2 > end or ((r2 < inside or r2 > outside) and (row + column) & 1):
                continue
            taken = False
            for k in range(near.shape[0]):
                ex, ey = column - near[k, 0], row - near[k, 1]
                if ex * ex + ey * ey < (near[k, 2] + 3.0) ** 2:
                    taken = True
            if taken:
                continue
            if count == LARGEST - CHUNK:
                return 0
            w[X + count] = column - x0
            w[Y + count] = row - y0
            w[VALUE + count] = image[row, column]
            count += 1
    return count


@njit(**FAST)
def _linearise(p, smeared, x0, y0, first, count, w):  # type: ignore[no-untyped-def]
    """Derivatives of a chunk's pixels, from the `first`, by the parameters, and the residual.

    A disc that moves far while the shutter is open is a mean over `_instants`; p[5:8] are then the
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
    w1 = np.float32(0.0 if smeared else 2.0 * p[6])
    w2 = np.float32(p[5] if smeared else p[7])
    instants = _instants(p) if smeared else 1
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
    for instant in range(instants):
        u = np.float32((instant + 0.5) / instants - 0.5)
        mx = np.float32(fx + u * p[6]) if smeared else cx
        my = np.float32(fy + u * p[7]) if smeared else cy
        for k in range(count):
            dx = w[X + first + k] - mx
            dy = w[Y + first + k] - my
            ax = a * dx + b * dy
            ay = b * dx + c * dy
            square = ax * ax + ay * ay + tiny
            inverse_r = one / np.sqrt(square)
            ax *= inverse_r
            ay *= inverse_r
            gx = a * ax + b * ay  # of r
            gy = b * ax + c * ay
            xx = gx * gx
            xy = gx * gy
            yy = gy * gy
            inverse_w = one / np.sqrt(w0 * xx + w1 * xy + w2 * yy + tiny)
            z = (one - square * inverse_r) * inverse_w
            z = min(max(z, np.float32(-4.0)), np.float32(4.0))
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
            by_w = half * by_r * z * inverse_w
            ax *= by_r
            ay *= by_r
            gx *= by_r
            gy *= by_r
            w[J + k] -= gx
            w[J + CHUNK + k] -= gy
            w[J + 2 * CHUNK + k] += ax * dx
            w[J + 3 * CHUNK + k] += ax * dy + ay * dx
            w[J + 4 * CHUNK + k] += ay * dy
            if smeared:
                w[J + 5 * CHUNK + k] += by_w * (xx + yy)
                w[J + 6 * CHUNK + k] -= u * gx
                w[J + 7 * CHUNK + k] -= u * gy
            else:
                w[J + 5 * CHUNK + k] += by_w * xx
                w[J + 6 * CHUNK + k] += np.float32(2.0) * by_w * xy
                w[J + 7 * CHUNK + k] += by_w * yy
            w[J + 8 * CHUNK + k] += share * step
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
def _instants(p):  # type: ignore[no-untyped-def]
    """How many instants resolve the way p[6:8] moved during the exposure."""
    return min(3 + int(np.hypot(p[6], p[7]) / (1.2 * np.sqrt(p[5]))), 32)


@njit(**FAST)
def _smear(p):  # type: ignore[no-untyped-def]
    """Exchanges W, of a long smear, for an edge and a way moved: a box of length m has variance m^2 / 12."""
    mean = 0.5 * (p[5] + p[7])
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    length = np.sqrt(24.0 * spread)
    angle = 0.5 * np.arctan2(2.0 * p[6], p[5] - p[7])
    p[5] = max(mean - spread, LEAST_BLUR)
    p[6] = length * np.cos(angle)
    p[7] = length * np.sin(angle)


@njit(**FAST)
def _normal_equations(p, smeared, x0, y0, count, w, H):  # type: ignore[no-untyped-def]
    """Fills H (13, 16), lower triangle: J W J^T; its last row ends in the weighted squared residual."""
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = min(CHUNK, count - first)
        _linearise(p, smeared, x0, y0, first, some, w)
        _add_products(first, some, w, H)


@njit(**FAST)
def _add_products(first, count, w, H):  # type: ignore[no-untyped-def]
    count = min(count, CHUNK)
    first = min(max(first, 0), LARGEST - CHUNK)
    for i in range(PARAMETERS + 1):
        row = J + i * CHUNK
        for k in range(count):
            w[WEIGHTED + k] = w[WEIGHT + first + k] * w[row + k]
        for j in range(0, i + 1, 4):  # past the diagonal too: four sums at once are as fast as one
            column = J + j * CHUNK
            sum0 = np.float32(0.0)
            sum1 = np.float32(0.0)
            sum2 = np.float32(0.0)
            sum3 = np.float32(0.0)
            for k in range(count):
                factor = w[WEIGHTED + k]
                sum0 += factor * w[column + k]
                sum1 += factor * w[column + CHUNK + k]
                sum2 += factor * w[column + 2 * CHUNK + k]
                sum3 += factor * w[column + 3 * CHUNK + k]
            H[i, j] += sum0
            H[i, j + 1] += sum1
            H[i, j + 2] += sum2
            H[i, j + 3] += sum3


@njit(**FAST)
def _factor(H, damping, L):  # type: ignore[no-untyped-def]
    """L L^T = H + damping diag H; False where that is not positive definite."""
    for i in range(PARAMETERS):
        for j in range(i + 1):
            total = H[i, j]
            if i == j:
                total += (damping + 1e-9) * H[i, i] + 1e-12
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@njit(**FAST)
def _substitute(L, x):  # type: ignore[no-untyped-def]
    """x becomes (L L^T)^-1 x."""
    for i in range(PARAMETERS):
        total = x[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(PARAMETERS - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, PARAMETERS):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@njit(**FAST)
def _keep_possible(p, smeared):  # type: ignore[no-untyped-def]
    """Keeps W's variances within bounds and its off-diagonal below what makes it indefinite."""
    p[5] = min(max(p[5], LEAST_BLUR), MOST_BLUR)
    if smeared:
        return
    p[7] = min(max(p[7], LEAST_BLUR), MOST_BLUR)
    most = 0.95 * np.sqrt(p[5] * p[7])
    p[6] = min(max(p[6], -most), most)


@njit(**FAST)
def _reweight(count, w):  # type: ignore[no-untyped-def]
    """Less weight to pixels far off, by the median of the residuals' size; returns the largest change."""
    count = min(count, LARGEST)
    for k in range(count):
        w[SIZE + k] = abs(w[RESIDUAL + k])
    scale = np.float32(1.4826) * np.median(w[SIZE : SIZE + count]) + np.float32(0.3)
    change = np.float32(0.0)
    for k in range(count):
        z = w[RESIDUAL + k] / (np.float32(4.0) * scale)
        new = np.float32(1.0) / (np.float32(1.0) + z * z * z * z)
        change = max(change, abs(new - w[WEIGHT + k]))
        w[WEIGHT + k] = new
    return change


@njit(**FAST)
def _finish(p, smeared, x0, y0, count, w, L, quality):  # type: ignore[no-untyped-def]
    """The last small step, by the factor at hand, and the centre's variances; fills quality.

    Variances as independent errors of the residual's size give them, and as the scores summed over blocks
    of pixels say: compression leaves errors that neighbours share. Returns the size of the step.
    """
    n = PARAMETERS
    pull = np.zeros((2, n))  # rows of H^-1: how the centre follows each score
    for axis in range(2):
        pull[axis, axis] = 1.0
        _substitute(L, pull[axis])
    reach = 0
    for k in range(count):
        reach = max(reach, abs(int(w[X + k])), abs(int(w[Y + k])))
    side = 2 * reach // BLOCK + 2
    for k in range(count):
        row, column = (int(w[Y + k]) + reach) // BLOCK, (int(w[X + k]) + reach) // BLOCK
        w[BLOCK_OF + k] = row * side + column
    blocks = np.zeros((2, side * side))
    white = np.zeros(2)
    score = np.zeros(n)
    squares = 0.0
    used = 0.0
    for first in range(0, count, CHUNK):
        some = min(CHUNK, count - first)
        _linearise(p, smeared, x0, y0, first, some, w)
        _add_influence(first, some, w, pull, white, blocks)
        squares_here, used_here = _add_scores(first, some, w, score)
        squares += squares_here
        used += used_here
    mean_square = squares / max(used - n, 1.0)
    for axis in range(2):
        shared = 0.0
        for cell in range(side * side):
            shared += blocks[axis, cell] ** 2
        quality[1 + axis] = white[axis] * mean_square
        quality[3 + axis] = shared
    quality[5] = squares / max(used, 1.0)
    quality[6] = used / count
    _substitute(L, score)
    for i in range(n):
        p[i] += score[i]
    _keep_possible(p, smeared)
    return max(abs(score[0]), abs(score[1]))


@njit(**FAST)
def _add_scores(first, count, w, score):  # type: ignore[no-untyped-def]
    count = min(count, CHUNK)
    first = min(max(first, 0), LARGEST - CHUNK)
    squares = np.float32(0.0)
    used = np.float32(0.0)
    for k in range(count):
        w[WEIGHTED + k] = w[WEIGHT + first + k] * w[J + 12 * CHUNK + k]
        squares += w[WEIGHTED + k] * w[J + 12 * CHUNK + k]
        used += w[WEIGHT + first + k]
    for i in range(PARAMETERS):
        row = J + i * CHUNK
        total = np.float32(0.0)
        for k in range(count):
            total += w[WEIGHTED + k] * w[row + k]
        score[i] += total
    return squares, used


@njit(**FAST)
def _add_influence(first, count, w, pull, white, blocks):  # type: ignore[no-untyped-def]
    """Each pixel's weight in the centre, squared and summed, and times its residual summed by block."""
    count = min(count, CHUNK)
    first = min(max(first, 0), LARGEST - CHUNK)
    for axis in range(2):
        for k in range(count):
            w[WEIGHTED + k] = np.float32(0.0)
        for i in range(PARAMETERS):
            factor = np.float32(pull[axis, i])
            row = J + i * CHUNK
            for k in range(count):
                w[WEIGHTED + k] += factor * w[row + k]
        total = np.float32(0.0)
        for k in range(count):
            w[WEIGHTED + k] *= w[WEIGHT + first + k]
            total += w[WEIGHTED + k] * w[WEIGHTED + k]
            w[WEIGHTED + k] *= w[J + 12 * CHUNK + k]
        white[axis] += total
        for k in range(count):
            blocks[axis, int(w[BLOCK_OF + first + k])] += w[WEIGHTED + k]


@njit(**FAST)
def _minimise(p, smeared, x0, y0, count, w, H, L):  # type: ignore[no-untyped-def]
    """Levenberg and Marquardt's steps from p, which is filled with the result; False where they fail.

    Ends within `NEAR` of the minimum; L then factors H there, or nearly.
    """
    n = PARAMETERS
    trial = p.copy()
    step = np.zeros(n)
    damping = 1e-3
    best = np.inf
    for _ in range(40):
        _normal_equations(trial, smeared, x0, y0, count, w, H)
        cost = H[n, n]
        if not cost < np.inf:
            return False
        if cost <= best * (1.0 + 1e-6):
            best = cost
            p[:] = trial
            for i in range(n):
                step[i] = H[n, i]
            damping = max(0.1 * damping, 1e-7)
            if not _factor(H, damping, L):
                return False
            _substitute(L, step)
            gain = 0.0
            for i in range(n):
                gain += step[i] * H[n, i]
        else:  # back, and less far
            damping = max(30.0 * damping, 1e-3)
            if damping > 1e4:
                return False
            step *= 0.2
            gain = np.inf
        trial[:] = p + step
        _keep_possible(trial, smeared)
        if max(abs(step[0]), abs(step[1])) < NEAR and gain * count < WORTHLESS * best:
            p[:] = trial
            if damping < 1e-4:
                return True
            _normal_equations(p, smeared, x0, y0, count, w, H)
            return _factor(H, 0.0, L)
    return False


@njit(**FAST)
def fit_disc(image, p, near, w, quality):  # type: ignore[no-untyped-def]
    """Fit a disc from the start p (12), which is filled with the result, as is quality (QUALITY).

    near (K, 3): centre and radius of other dots. w (SCRATCH), float32, is room to work in.
    """
    n = PARAMETERS
    quality[:] = 0.0
    H = np.empty((n + 1, n + 4))
    L = np.empty((n, n))
    smeared = False
    away = 1.0 + 2.0 / np.sqrt(max(p[2] * p[4] - p[3] * p[3], 1e-12))
    left, right, top, bottom = p[0] - away, p[0] + away, p[1] - away, p[1] + away
    count = 0
    x0 = 0
    y0 = 0
    for _ in range(4):  # the pixels are chosen anew where the disc has left those it began with
        x0, y0 = int(np.rint(p[0])), int(np.rint(p[1]))
        count = _choose_pixels(image, p, near, w)
        if count < 3 * n:
            return
        strange = _distrust(p, smeared, x0, y0, count, w)
        if not _minimise(p, smeared, x0, y0, count, w, H, L):
            return
        if not (left < p[0] < right and top < p[1] < bottom):
            return
        if abs(p[0] - x0) < 1.5 and abs(p[1] - y0) < 1.5:
            break
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    if np.sqrt(24.0 * spread) > LONG_SMEAR / np.sqrt(p[2] * p[4] - p[3] * p[3]):
        smeared = True
        _smear(p)
        if not _minimise(p, smeared, x0, y0, count, w, H, L):
            return
        _normal_equations(p, smeared, x0, y0, count, w, H)
        if not _factor(H, 0.0, L):
            return
    if strange or _outlying(count, w) > OUTLYING * abs(p[8]):
        for _ in range(6):
            change = _reweight(count, w)
            if not _minimise(p, smeared, x0, y0, count, w, H, L):
                return
            if change < 0.1:
                break
    for _ in range(3):
        if _finish(p, smeared, x0, y0, count, w, L, quality) < 0.1 * NEAR:
            break
    if smeared:  # back to W, from which another fit may start
        p[5], p[6], p[7] = p[5] + p[6] ** 2 / 12.0, p[6] * p[7] / 12.0, p[5] + p[7] ** 2 / 12.0
    quality[0] = 1.0


@njit(**FAST)
def _distrust(p, smeared, x0, y0, count, w):  # type: ignore[no-untyped-def]
    """First weights: little where, away from the outline, a level is far from the start's; True if any is.

    Otherwise a highlight beside the dot could pass for its blurred edge.
    """
    scale = np.float32(STRANGE * abs(p[8]))
    strange = 0
    for first in range(0, count, CHUNK):
        some = min(CHUNK, count - first)
        _linearise(p, smeared, x0, y0, first, some, w)
        for k in range(some):
            weight = np.float32(1.0)
            if abs(w[J + 8 * CHUNK + k] - np.float32(0.5)) > np.float32(0.4999):
                z = w[J + 12 * CHUNK + k] / scale
                weight = np.float32(1.0) / (np.float32(1.0) + z * z * z * z)
            if weight < 0.3:
                strange += 1
            w[WEIGHT + first + k] = weight
    if strange < 4:
        for k in range(count):
            w[WEIGHT + k] = np.float32(1.0)
    return strange >= 4


@njit(**FAST)
def _outlying(count, w):  # type: ignore[no-untyped-def]
    count = min(count, LARGEST)
    largest = np.float32(0.0)
    for k in range(count):
        largest = max(largest, abs(w[RESIDUAL + k]))
    return largest
