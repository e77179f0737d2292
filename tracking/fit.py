"""Fitting discs to pixels: which pixels to trust, and how sure the centre is."""

import numpy as np
from numba import njit

from tracking.disc import (
    BLOCK_OF,
    CHUNK,
    FAST,
    LARGEST,
    PARAMETERS,
    RESIDUAL,
    SIZE,
    WEIGHT,
    WEIGHTED,
    J,
    X,
    Y,
    choose_pixels,
    filled_up,
    linearise,
    smear,
)
from tracking.minimise import add_products, add_scores, keep_possible, minimise, normal_equations, substitute

# Converged; the centre's variances by independent errors of one grey level (2), by blocks (2); mean squared residual;
# share used; how far the pixels that are not quite trusted pull the centre (2).
QUALITY = 9
OUTLYING = 0.12  # of the contrast: a pixel farther off than this shows something else than the dot
STRANGE = 0.25  # of the contrast: a level this far from what the start expects
LONG_SMEAR = 0.4  # of the radius: motion during the exposure that a blurred edge does not describe any more
DOUBTED = 0.9  # weight: below it a pixel is not quite trusted
# The centre's last step, and what it may be worth as a share of the squared residual: the next is smaller still.
SETTLED, WORTH = 0.005, 0.01
SHRINKING = 0.4  # of one step to the next by the same normal matrix, at most
BLOCK = 4  # px: errors closer than this are not taken to be independent


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
def _settle(p, smeared, x0, y0, count, w, H, L, length, cost, quality):  # type: ignore[no-untyped-def]
    """Small steps from where `minimise` ended, to the minimum; fills quality and returns whether it was reached.

    length: of the step that led to p [px]; cost: before it.
    """
    for _ in range(4):
        for _ in range(4):
            if not length < np.inf:
                return False
            before, cost_before = length, cost
            length, cost, gain = _assess(p, smeared, x0, y0, count, w, L, quality)
            if cost > cost_before * 1.001:
                break
            if length < SETTLED and gain < WORTH * cost:
                return True
            if length > SHRINKING * before:
                break
        normal_equations(p, smeared, x0, y0, count, w, H)
        length, cost = minimise(p, smeared, x0, y0, count, w, H, L)
    return False


@njit(**FAST)
def _assess(p, smeared, x0, y0, count, w, L, quality):  # type: ignore[no-untyped-def]
    """Fills quality and takes a small step by the factor at hand; returns its length, the cost before it and the gain.

    Variances as independent errors of the residual's size give them, and as the scores summed over blocks
    of pixels say: compression leaves errors that neighbours share. Pixels that are not quite trusted, at a highlight's
    edge, may all be off to one side: how far they pull the centre is an error by itself.
    """
    n = PARAMETERS
    pull = np.zeros((2, n))  # rows of H^-1: how the centre follows each score
    for axis in range(2):
        pull[axis, axis] = 1.0
        substitute(L, pull[axis])
    side = _number_blocks(count, w)
    blocks = np.zeros((2, side * side))
    white, doubted = np.zeros(2), np.zeros(2)
    score = np.zeros(n)
    cost = 0.0
    used = 0.0
    for first in range(0, count, CHUNK):
        some = filled_up(min(CHUNK, count - first))
        linearise(p, smeared, x0, y0, first, some, w)
        _add_influence(first, some, w, pull, white, blocks, doubted)
        squares, weight = add_scores(first, some, w, score)
        cost += squares
        used += weight
    for axis in range(2):
        shared = 0.0
        for cell in range(side * side):
            shared += blocks[axis, cell] ** 2
        quality[1 + axis] = white[axis]
        quality[3 + axis] = shared
        quality[7 + axis] = doubted[axis]
    step = score.copy()
    substitute(L, step)
    gain = 0.0
    for i in range(n):
        gain += step[i] * score[i]
        p[i] += step[i]
    keep_possible(p, smeared)
    quality[5] = max(cost - gain, 0.0) / max(used - n, 1.0)
    quality[6] = used / count
    return max(abs(step[0]), abs(step[1])), cost, gain


@njit(**FAST)
def _number_blocks(count, w):  # type: ignore[no-untyped-def]
    """Fills in which block of a square of them each pixel lies; returns how many blocks the square's side has."""
    count = min(filled_up(count), LARGEST)
    reach = np.float32(0.0)
    for k in range(count):
        away = max(abs(w[X + k]), abs(w[Y + k]))
        reach = away if away > reach else reach
    scale, side = np.float32(1.0 / BLOCK), 2 * int(reach) // BLOCK + 2
    width = np.float32(side)
    for k in range(count):
        row, column = np.floor((w[Y + k] + reach) * scale), np.floor((w[X + k] + reach) * scale)
        w[BLOCK_OF + k] = row * width + column
    return side


@njit(**FAST)
def _add_influence(first, count, w, pull, white, blocks, doubted):  # type: ignore[no-untyped-def]
    """Each pixel's weight in the centre, squared, and times its residual, summed by block and over doubted ones."""
    count = min(count, CHUNK)
    first = min(max(first, 0), LARGEST - CHUNK)
    for axis in range(2):
        influence = WEIGHTED + axis * CHUNK
        w[influence : influence + count] = np.float32(0.0)
        for i in range(0, PARAMETERS, 4):  # four rows at once: what is filled is loaded and stored less often
            row = J + i * CHUNK
            factor0, factor1 = np.float32(pull[axis, i]), np.float32(pull[axis, i + 1])
            factor2, factor3 = np.float32(pull[axis, i + 2]), np.float32(pull[axis, i + 3])
            for k in range(count):
                value0, value1 = w[row + k], w[row + CHUNK + k]
                value2, value3 = w[row + 2 * CHUNK + k], w[row + 3 * CHUNK + k]
                w[influence + k] += factor0 * value0 + factor1 * value1 + factor2 * value2 + factor3 * value3
        total = np.float32(0.0)
        pulled = np.float32(0.0)
        for k in range(count):
            w[influence + k] *= w[WEIGHT + first + k]
            total += w[influence + k] * w[influence + k]
            w[influence + k] *= w[J + 12 * CHUNK + k]
            pulled += w[influence + k] if w[WEIGHT + first + k] < np.float32(DOUBTED) else np.float32(0.0)
        white[axis] += total
        doubted[axis] += pulled
    for k in range(count):
        block = int(w[BLOCK_OF + first + k])
        blocks[0, block] += w[WEIGHTED + k]
        blocks[1, block] += w[WEIGHTED + CHUNK + k]


@njit(**FAST)
def fit_disc(image, p, near, w, quality):  # type: ignore[no-untyped-def]
    """Fit a disc from the start p (12), which is filled with the result, as is quality (QUALITY).

    near (K, 3): centre and radius of other dots. w (SCRATCH), float32, is room to work in.
    """
    n = PARAMETERS
    quality[:] = 0.0
    H = np.empty((n + 1, n + 1))
    L = np.empty((n, n))
    smeared = False
    away = 1.0 + 2.0 / np.sqrt(max(p[2] * p[4] - p[3] * p[3], 1e-12))
    left, right, top, bottom = p[0] - away, p[0] + away, p[1] - away, p[1] + away
    strange = False
    length = cost = np.inf
    count = 0
    x0 = 0
    y0 = 0
    for _ in range(4):  # the pixels are chosen anew where the disc has left those it began with
        x0, y0 = int(np.rint(p[0])), int(np.rint(p[1]))
        count = choose_pixels(image, p, near, w)
        if count < 3 * n:
            return
        strange = _distrust(p, smeared, x0, y0, count, w, H)
        length, cost = minimise(p, smeared, x0, y0, count, w, H, L)
        if not (length < np.inf and left < p[0] < right and top < p[1] < bottom):
            return
        if abs(p[0] - x0) < 1.5 and abs(p[1] - y0) < 1.5:
            break
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    if np.sqrt(24.0 * spread) > LONG_SMEAR / np.sqrt(p[2] * p[4] - p[3] * p[3]):
        smeared = True
        smear(p)
        normal_equations(p, smeared, x0, y0, count, w, H)
        length, cost = minimise(p, smeared, x0, y0, count, w, H, L)
    if not _settle(p, smeared, x0, y0, count, w, H, L, length, cost, quality):
        return
    if strange or _outlying(count, w) > OUTLYING * abs(p[8]):
        for _ in range(6):
            change = _reweight(count, w)
            normal_equations(p, smeared, x0, y0, count, w, H)
            length, cost = minimise(p, smeared, x0, y0, count, w, H, L)
            if not _settle(p, smeared, x0, y0, count, w, H, L, length, cost, quality):
                return
            if change < 0.1:
                break
    if smeared:  # back to W, from which another fit may start
        p[5], p[6], p[7] = p[5] + p[6] ** 2 / 12.0, p[6] * p[7] / 12.0, p[5] + p[7] ** 2 / 12.0
    quality[0] = 1.0


@njit(**FAST)
def _distrust(p, smeared, x0, y0, count, w, H):  # type: ignore[no-untyped-def]
    """First weights: little where, away from the outline, a level is far from the start's; True if any is.

    Otherwise a highlight beside the dot could pass for its blurred edge. Fills H as `normal_equations` does.
    """
    scale = np.float32(STRANGE * abs(p[8]))
    strange = np.float32(0.0)
    w[WEIGHT : WEIGHT + count] = np.float32(1.0)
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = filled_up(min(CHUNK, count - first))
        linearise(p, smeared, x0, y0, first, some, w)
        strange += _weigh_levels(first, min(CHUNK, count - first), scale, w)
        add_products(first, some, w, H)
    if strange < 4:
        return False
    w[WEIGHT : WEIGHT + count] = w[SIZE : SIZE + count]
    normal_equations(p, smeared, x0, y0, count, w, H)
    return True


@njit(**FAST)
def _weigh_levels(first, count, scale, w):  # type: ignore[no-untyped-def]
    """Fills a linearised chunk's weights, 1 at the outline; returns how many are small."""
    count = min(count, CHUNK)
    first = min(max(first, 0), LARGEST - CHUNK)
    one = np.float32(1.0)
    strange = np.float32(0.0)
    for k in range(count):
        z = w[J + 12 * CHUNK + k] / scale
        far = abs(w[J + 8 * CHUNK + k] - np.float32(0.5)) > np.float32(0.4999)
        weight = one / (one + z * z * z * z) if far else one
        w[SIZE + first + k] = weight
        strange += one if weight < np.float32(0.3) else np.float32(0.0)
    return strange


@njit(**FAST)
def _outlying(count, w):  # type: ignore[no-untyped-def]
    count = min(count, LARGEST)
    largest = np.float32(0.0)
    for k in range(count):
        largest = max(largest, abs(w[RESIDUAL + k]))
    return largest
