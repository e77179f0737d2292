"""Fitting discs to pixels: Levenberg and Marquardt's steps, robust weights, and how sure the centre is."""

import numpy as np
from numba import njit

from tracking.disc import (
    BLOCK_OF,
    CHUNK,
    FAST,
    LARGEST,
    LEAST_BLUR,
    MOST_BLUR,
    PARAMETERS,
    RESIDUAL,
    SIZE,
    WEIGHT,
    WEIGHTED,
    J,
    X,
    Y,
    choose_pixels,
    linearise,
    smear,
)

QUALITY = 7  # converged; centre's variances by independent errors (2), by blocks (2); mean squared residual; share used
OUTLYING = 0.12  # of the contrast: a pixel farther off than this shows something else than the dot
STRANGE = 0.25  # of the contrast: a level this far from what the start expects
NEAR = 0.03  # px: the next step would be a hundred times smaller
# Steps that leave the normal matrix nearly as it was: of the centre and of the radius [px], and the share by which the
# contrast and the edge's variance may change.
CLOSE, SWELLING, CHANGE = 1.0, 0.3, 0.05
SHRINKING = 0.4  # of one such step to the next, at most
LITTLE = 1e-3  # of the normal matrix' diagonal: damping that changes neither steps nor variances to speak of
WORTHLESS = 1.0  # of a pixel's mean squared residual: a gain that says nothing more about the disc
LONG_SMEAR = 0.4  # of the radius: motion during the exposure that a blurred edge does not describe any more
BLOCK = 4  # px: errors closer than this are not taken to be independent


@njit(**FAST)
def _normal_equations(p, smeared, x0, y0, count, w, H):  # type: ignore[no-untyped-def]
    """Fills H (13, 16), lower triangle: J W J^T; its last row ends in the weighted squared residual."""
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = min(CHUNK, count - first)
        linearise(p, smeared, x0, y0, first, some, w)
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
        linearise(p, smeared, x0, y0, first, some, w)
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

    H holds the normal equations at p. Ends within `NEAR` of the minimum; L then factors H there, or nearly.
    """
    n = PARAMETERS
    trial = p.copy()
    step = np.zeros(n)
    damping = 1e-3
    best = np.inf
    for attempt in range(40):
        if attempt > 0:
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
        length = max(abs(step[0]), abs(step[1]))
        if damping < LITTLE and length < NEAR and gain * count < WORTHLESS * best:
            p[:] = trial
            return True
        if damping < LITTLE and _is_close(p, step) and _approach(trial, smeared, x0, y0, count, w, L, length, best):
            p[:] = trial
            return True
    return False


@njit(**FAST)
def _is_close(p, step):  # type: ignore[no-untyped-def]
    """Whether a step from p leaves the normal matrix nearly as it was."""
    swelling = max(abs(step[2]), abs(step[4])) / (p[2] * p[4] - p[3] * p[3])
    change = max(abs(step[8] / p[8]), 0.5 * (abs(step[5]) + abs(step[7])) / (p[5] + p[7]))
    return max(abs(step[0]), abs(step[1])) < CLOSE and swelling < SWELLING and change < CHANGE


@njit(**FAST)
def _approach(p, smeared, x0, y0, count, w, L, length, best):  # type: ignore[no-untyped-def]
    """Goes on from p with one factor of the normal matrix; False, p being spoilt, where that does not get near.

    length: of the step that led to p; best: cost before it.
    """
    score = np.zeros(PARAMETERS)
    step = np.zeros(PARAMETERS)
    for _ in range(4):
        squares = _score(p, smeared, x0, y0, count, w, score)
        if not squares <= best * (1.0 + 1e-6):
            return False
        step[:] = score
        _substitute(L, step)
        gain = 0.0
        for i in range(PARAMETERS):
            gain += step[i] * score[i]
            p[i] += step[i]
        _keep_possible(p, smeared)
        best, before = squares, length
        length = max(abs(step[0]), abs(step[1]))
        if length < NEAR and gain * count < WORTHLESS * best:
            return True
        if length > SHRINKING * before:
            return False
    return False


@njit(**FAST)
def _score(p, smeared, x0, y0, count, w, score):  # type: ignore[no-untyped-def]
    """Fills score (12), J W r; returns the weighted squared residual."""
    score[:] = 0.0
    total = 0.0
    for first in range(0, count, CHUNK):
        some = min(CHUNK, count - first)
        linearise(p, smeared, x0, y0, first, some, w)
        squares, _ = _add_scores(first, some, w, score)
        total += squares
    return total


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
        count = choose_pixels(image, p, near, w)
        if count < 3 * n:
            return
        strange = _distrust(p, smeared, x0, y0, count, w, H)
        if not _minimise(p, smeared, x0, y0, count, w, H, L):
            return
        if not (left < p[0] < right and top < p[1] < bottom):
            return
        if abs(p[0] - x0) < 1.5 and abs(p[1] - y0) < 1.5:
            break
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    if np.sqrt(24.0 * spread) > LONG_SMEAR / np.sqrt(p[2] * p[4] - p[3] * p[3]):
        smeared = True
        smear(p)
        _normal_equations(p, smeared, x0, y0, count, w, H)
        if not _minimise(p, smeared, x0, y0, count, w, H, L):
            return
        _normal_equations(p, smeared, x0, y0, count, w, H)
        if not _factor(H, 0.0, L):
            return
    if strange or _outlying(count, w) > OUTLYING * abs(p[8]):
        for _ in range(6):
            change = _reweight(count, w)
            _normal_equations(p, smeared, x0, y0, count, w, H)
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
def _distrust(p, smeared, x0, y0, count, w, H):  # type: ignore[no-untyped-def]
    """First weights: little where, away from the outline, a level is far from the start's; True if any is.

    Otherwise a highlight beside the dot could pass for its blurred edge. Fills H as `_normal_equations` does.
    """
    scale = np.float32(STRANGE * abs(p[8]))
    strange = 0
    w[WEIGHT : WEIGHT + count] = np.float32(1.0)
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = min(CHUNK, count - first)
        linearise(p, smeared, x0, y0, first, some, w)
        for k in range(some):
            weight = np.float32(1.0)
            if abs(w[J + 8 * CHUNK + k] - np.float32(0.5)) > np.float32(0.4999):
                z = w[J + 12 * CHUNK + k] / scale
                weight = np.float32(1.0) / (np.float32(1.0) + z * z * z * z)
            if weight < 0.3:
                strange += 1
            w[SIZE + first + k] = weight
        _add_products(first, some, w, H)
    if strange < 4:
        return False
    w[WEIGHT : WEIGHT + count] = w[SIZE : SIZE + count]
    _normal_equations(p, smeared, x0, y0, count, w, H)
    return True


@njit(**FAST)
def _outlying(count, w):  # type: ignore[no-untyped-def]
    count = min(count, LARGEST)
    largest = np.float32(0.0)
    for k in range(count):
        largest = max(largest, abs(w[RESIDUAL + k]))
    return largest
