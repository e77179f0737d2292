"""Levenberg-Marquardt minimisation of a disc's weighted squared residual, and the uncertainty of the result."""

import numpy as np
from numba import njit

from rafl.tracking.detection.disc_model import (
    BLOCK_INDEX,
    CHUNK,
    FAST,
    MAX_EDGE_VARIANCE,
    MAX_PIXELS,
    MIN_EDGE_VARIANCE,
    PARAMETER_COUNT,
    WEIGHT,
    WEIGHTED,
    J,
    X,
    Y,
    linearise,
    pad_to_lanes,
)
from rafl.tracking.detection.normal_equations import add_scores, factorise, normal_equations, substitute

# Entries of a fit's quality, by index:
# 0: 1 if it converged; 1, 2: variance of the centre along x and y for independent errors of one grey level [px^2];
# 3, 4: the same by the residuals summed over blocks of pixels [px^2]; 5: mean squared residual; 6: mean weight;
# 7, 8: shift of the centre by the pixels of reduced weight [px];
# 9: variance of A's mean diagonal for independent errors of one grey level;
# 10: variance of the pixel noise, estimated only where the residual is large.
QUALITY_COUNT = 11
# A step within these three limits leaves the normal matrix nearly unchanged.
SMALL_SHIFT = 1.0  # px: of the centre
SMALL_RADIUS_CHANGE = 0.3  # px
SMALL_RELATIVE_CHANGE = 0.05  # of the contrast and of the edge's sigma
MAX_FINAL_DAMPING = 1e-3  # of the normal matrix's diagonal: less changes neither the steps nor the variances much
# A step within these two limits is the last but one: the next would be smaller still.
FINAL_STEP = 0.005  # px: of the centre
FINAL_GAIN = 0.01  # fraction of the squared residual
NEGLIGIBLE_GAIN = 0.4  # of one pixel's mean squared residual: a smaller gain says nothing more about the disc
MAX_MOTION_VARIANCE = 0.2  # of the squared radius: limit of W's variance for large dots, where above MAX_EDGE_VARIANCE
FALLBACK_DAMPING = 0.1  # of the last attempt: it suppresses poorly determined parameters, but not the centre's step
ROUNDING_INCREASE = 1e-3  # fraction of the squared residual: an increase that rounding may cause
# A step of the centre shorter than SHORT_STEP [px] after another small one ends the fit, even if the squared residual
# grows by this fraction. The derivatives neglect how the light's slope and a directional blur change them. If an
# irregular outline leaves a large residual, no step remains although the minimum is not quite reached.
SHORT_STEP, ACCEPTED_INCREASE = 0.02, 1e-2
REDUCED_WEIGHT = 0.9  # a pixel below this weight counts as one of reduced weight
BLOCK = 4  # px: errors of pixels closer than this are not assumed to be independent


@njit(**FAST)
def _clip_edge_variance(p, instants):
    """Clip W's variances to their bounds, and its off-diagonal so that W stays positive definite."""
    widest = max(MAX_EDGE_VARIANCE, MAX_MOTION_VARIANCE / max(p[2] * p[4] - p[3] * p[3], 1e-12))
    p[5] = min(max(p[5], MIN_EDGE_VARIANCE), widest)
    if instants > 1:
        return
    p[7] = min(max(p[7], MIN_EDGE_VARIANCE), widest)
    limit = 0.95 * np.sqrt(p[5] * p[7])
    p[6] = min(max(p[6], -limit), limit)


@njit(**FAST)
def _is_small(p, step):
    """Whether a step from p leaves the normal matrix nearly unchanged."""
    radius_change = max(abs(step[2]), abs(step[4])) / (p[2] * p[4] - p[3] * p[3])
    change = max(abs(step[8] / p[8]), 0.5 * (abs(step[5]) + abs(step[7])) / (p[5] + p[7]))
    return (
        max(abs(step[0]), abs(step[1])) < SMALL_SHIFT
        and radius_change < SMALL_RADIUS_CHANGE
        and change < SMALL_RELATIVE_CHANGE
    )


@njit(**FAST)
def _assess(p, instants, x0, y0, count, w, L, quality):
    """Fill quality, and take a small step with the given factor L; returns its length, the cost before it and its gain.

    The centre's variance is computed twice: for independent errors as large as the residual, and from the scores summed
    over blocks of pixels, because compression causes errors that neighbours share. Pixels of reduced weight, at a
    highlight's edge, may all have errors of one sign: the shift of the centre that they cause is a further error.
    """
    n = PARAMETER_COUNT
    response = np.zeros((2, n))  # rows of H^-1: the centre's response to each score
    size = np.zeros(n)
    for axis in range(2):
        response[axis, axis] = 1.0
        substitute(L, response[axis])
        size[2 + 2 * axis] = 0.5
    substitute(L, size)
    side = _number_blocks(count, w)
    blocks = np.zeros((2, side * side))
    independent, shift = np.zeros(2), np.zeros(2)
    score = np.zeros(n)
    cost = 0.0
    total_weight = 0.0
    for first in range(0, count, CHUNK):
        some = pad_to_lanes(min(CHUNK, count - first))
        linearise(p, instants, x0, y0, first, some, w)
        _add_influence(first, some, w, response, independent, blocks, shift)
        squares, weight = add_scores(first, some, w, score)
        cost += squares
        total_weight += weight
    for axis in range(2):
        block_variance = 0.0
        for cell in range(side * side):
            block_variance += blocks[axis, cell] ** 2
        quality[1 + axis] = independent[axis]
        quality[3 + axis] = block_variance
        quality[7 + axis] = shift[axis]
    step = score.copy()
    substitute(L, step)
    gain = 0.0
    for i in range(n):
        gain += step[i] * score[i]
        p[i] += step[i]
    _clip_edge_variance(p, instants)
    quality[5] = max(cost - gain, 0.0) / max(total_weight - n, 1.0)
    quality[6] = total_weight / count
    quality[9] = 0.5 * (size[2] + size[4])
    return max(abs(step[0]), abs(step[1])), cost, gain


@njit(**FAST)
def _number_blocks(count, w):
    """Fill the index of each pixel's block in a square grid of blocks; returns the blocks along the grid's side."""
    count = min(pad_to_lanes(count), MAX_PIXELS)
    farthest = 0  # the compiler vectorises a maximum of integers, but not of floats
    for k in range(count):
        farthest = max(farthest, max(abs(int(w[X + k])), abs(int(w[Y + k]))))
    scale, side = np.float32(1.0 / BLOCK), 2 * farthest // BLOCK + 2
    reach, width = np.float32(farthest), np.float32(side)
    for k in range(count):
        row, column = np.floor((w[Y + k] + reach) * scale), np.floor((w[X + k] + reach) * scale)
        w[BLOCK_INDEX + k] = row * width + column
    return side


@njit(**FAST)
def _add_influence(first, count, w, response, independent, blocks, shift):
    """Add a chunk's influence on the centre: its squares, and its products with the residuals.

    The products are summed by block, and over the pixels of reduced weight.
    """
    count = min(count, CHUNK)
    first = min(max(first, 0), MAX_PIXELS - CHUNK)
    for axis in range(2):
        influence = WEIGHTED + axis * CHUNK
        w[influence : influence + count] = np.float32(0.0)
        for i in range(0, PARAMETER_COUNT, 4):  # four rows at once: fewer loads and stores
            row = J + i * CHUNK
            factor0, factor1 = np.float32(response[axis, i]), np.float32(response[axis, i + 1])
            factor2, factor3 = np.float32(response[axis, i + 2]), np.float32(response[axis, i + 3])
            for k in range(count):
                value0, value1 = w[row + k], w[row + CHUNK + k]
                value2, value3 = w[row + 2 * CHUNK + k], w[row + 3 * CHUNK + k]
                w[influence + k] += factor0 * value0 + factor1 * value1 + factor2 * value2 + factor3 * value3
        total = np.float32(0.0)
        reduced = np.float32(0.0)
        for k in range(count):
            w[influence + k] *= w[WEIGHT + first + k]
            total += w[influence + k] * w[influence + k]
            w[influence + k] *= w[J + 12 * CHUNK + k]
            reduced += w[influence + k] if w[WEIGHT + first + k] < np.float32(REDUCED_WEIGHT) else np.float32(0.0)
        independent[axis] += total
        shift[axis] += reduced
    for k in range(count):
        block = int(w[BLOCK_INDEX + first + k])
        blocks[0, block] += w[WEIGHTED + k]
        blocks[1, block] += w[WEIGHTED + CHUNK + k]


@njit(**FAST)
def _is_final(length, gain, cost, count):
    """Whether the step after this one would gain nothing that matters."""
    return (length < FINAL_STEP and gain < FINAL_GAIN * cost) or gain * count < NEGLIGIBLE_GAIN * cost


@njit(**FAST)
def minimise(p, instants, x0, y0, count, w, H, L, quality):
    """Minimise from p by Levenberg-Marquardt steps; fills p and quality; returns False if it fails.

    H holds the normal equations at p. After a step that leaves the normal matrix nearly unchanged, `_assess` takes
    another with the same factor, in the pass over the pixels that computes `quality`. This is usually the final step.
    """
    n = PARAMETER_COUNT
    trial, candidate = p.copy(), p.copy()
    step = np.zeros(n)
    damping = 1e-3
    best = np.inf
    for attempt in range(40):
        if attempt > 0:
            normal_equations(trial, instants, x0, y0, count, w, H)
        cost = H[n, n]
        if not cost < np.inf:
            return False
        if cost > best * (1.0 + 1e-6):  # go back and take a shorter step
            damping = max(30.0 * damping, 1e-3)
            if damping > 1e4:
                break
            step *= 0.2
            for i in range(n):
                trial[i] = p[i] + step[i]
            _clip_edge_variance(trial, instants)
            continue
        best = cost
        for i in range(n):
            p[i] = trial[i]
        damping = max(0.1 * damping, 1e-7)
        for i in range(n):
            step[i] = H[n, i]
        if not factorise(H, damping, L):
            return False
        substitute(L, step)
        gain = 0.0
        for i in range(n):
            gain += step[i] * H[n, i]
        for i in range(n):
            trial[i] = p[i] + step[i]
        _clip_edge_variance(trial, instants)
        length = max(abs(step[0]), abs(step[1]))
        final, small = _is_final(length, gain, best, count), _is_small(p, step)
        if not (damping < MAX_FINAL_DAMPING and (final or small)):
            continue
        for i in range(n):
            candidate[i] = trial[i]
        length, cost, gain = _assess(trial, instants, x0, y0, count, w, L, quality)
        increase = ACCEPTED_INCREASE if small and length < SHORT_STEP else ROUNDING_INCREASE
        if cost < best * (1.0 + increase) and (final or _is_final(length, gain, cost, count)):
            for i in range(n):
                p[i] = trial[i]
            return True
        for i in range(n):
            trial[i] = candidate[i]
    # Rounding hides the remaining gain, or some parameters are poorly determined.
    normal_equations(p, instants, x0, y0, count, w, H)
    if not factorise(H, FALLBACK_DAMPING, L):
        return False
    length, cost, gain = _assess(p, instants, x0, y0, count, w, L, quality)
    return _is_final(length, gain, cost, count)
