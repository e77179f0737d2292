"""Levenberg and Marquardt's steps towards the disc that explains some pixels best, and how well its place is known."""

import numpy as np
from numba import njit
from rafl.tracking.detection.disc_model import (
    BLOCK_OF,
    CHUNK,
    FAST,
    LARGEST,
    LEAST_BLUR,
    MOST_BLUR,
    PARAMETERS,
    WEIGHT,
    WEIGHTED,
    J,
    X,
    Y,
    filled_up,
    linearise,
)
from rafl.tracking.detection.normal_equations import add_scores, factorise, normal_equations, substitute

# Converged; the centre's variances by independent errors of one grey level (2), by blocks (2); mean squared residual;
# share used; how far the pixels that are not quite trusted pull the centre (2); the variance of A's mean diagonal by
# independent errors of one grey level; the pixels' own noise's variance, where the residual is large enough to ask; the
# variance of what neighbouring pixels' residuals do not share.
QUALITY = 12
# Steps that leave the normal matrix nearly as it was: of the centre and of the radius [px], and the share by which the
# contrast and the edge's variance may change.
CLOSE, SWELLING, CHANGE = 1.0, 0.3, 0.05
LITTLE = 1e-3  # of the normal matrix' diagonal: damping that changes neither steps nor variances to speak of
# The centre's last step [px], and what it may be worth as a share of the squared residual: the next is smaller still.
SETTLED, WORTH = 0.005, 0.01
WORTHLESS = 0.4  # of a pixel's mean squared residual: a gain that says nothing more about the disc
LONGEST = 0.2  # of the radius' square: what W's variance along a large dot's way may be beyond `MOST_BLUR`
MUCH = 0.1  # damping of the last try, that holds back what the pixels hardly tell and leaves the centre its step
LEVEL = 1e-3  # of the squared residual: as much as before, but for rounding
# A step that short [px], after another small one, is the last though the squared residual be larger by that share than
# before: derivatives leave out how light that falls off and an edge blurred along one way change them, so that where an
# outline drawn by hand leaves much residual, no step is left where it is not quite the least.
RESTING, RISEN = 0.02, 1e-2
DOUBTED = 0.9  # weight: below it a pixel is not quite trusted
BLOCK = 4  # px: errors closer than this are not taken to be independent


@njit(**FAST)
def _keep_possible(p, instants):
    """Keeps W's variances within bounds and its off-diagonal below what makes it indefinite."""
    widest = max(MOST_BLUR, LONGEST / max(p[2] * p[4] - p[3] * p[3], 1e-12))
    p[5] = min(max(p[5], LEAST_BLUR), widest)
    if instants > 1:
        return
    p[7] = min(max(p[7], LEAST_BLUR), widest)
    most = 0.95 * np.sqrt(p[5] * p[7])
    p[6] = min(max(p[6], -most), most)


@njit(**FAST)
def _is_close(p, step):
    """Whether a step from p leaves the normal matrix nearly as it was."""
    swelling = max(abs(step[2]), abs(step[4])) / (p[2] * p[4] - p[3] * p[3])
    change = max(abs(step[8] / p[8]), 0.5 * (abs(step[5]) + abs(step[7])) / (p[5] + p[7]))
    return max(abs(step[0]), abs(step[1])) < CLOSE and swelling < SWELLING and change < CHANGE


@njit(**FAST)
def _assess(p, instants, x0, y0, count, w, L, quality):
    """Fills quality and takes a small step by the factor at hand; returns its length, the cost before it and the gain.

    Variances as independent errors of the residual's size give them, and as the scores summed over blocks
    of pixels say: compression leaves errors that neighbours share. Pixels that are not quite trusted, at a highlight's
    edge, may all be off to one side: how far they pull the centre is an error by itself.
    """
    n = PARAMETERS
    pull = np.zeros((2, n))  # rows of H^-1: how the centre follows each score
    size = np.zeros(n)
    for axis in range(2):
        pull[axis, axis] = 1.0
        substitute(L, pull[axis])
        size[2 + 2 * axis] = 0.5
    substitute(L, size)
    side = _number_blocks(count, w)
    blocks = np.zeros((2, side * side))
    white, doubted = np.zeros(2), np.zeros(2)
    score = np.zeros(n)
    cost = 0.0
    used = 0.0
    for first in range(0, count, CHUNK):
        some = filled_up(min(CHUNK, count - first))
        linearise(p, instants, x0, y0, first, some, w)
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
    _keep_possible(p, instants)
    quality[5] = max(cost - gain, 0.0) / max(used - n, 1.0)
    quality[6] = used / count
    quality[9] = 0.5 * (size[2] + size[4])
    return max(abs(step[0]), abs(step[1])), cost, gain


@njit(**FAST)
def _number_blocks(count, w):
    """Fills in which block of a square of them each pixel lies; returns how many blocks the square's side has."""
    count = min(filled_up(count), LARGEST)
    most = 0  # a maximum of whole numbers becomes vector instructions, one of floats does not
    for k in range(count):
        most = max(most, max(abs(int(w[X + k])), abs(int(w[Y + k]))))
    scale, side = np.float32(1.0 / BLOCK), 2 * most // BLOCK + 2
    reach, width = np.float32(most), np.float32(side)
    for k in range(count):
        row, column = np.floor((w[Y + k] + reach) * scale), np.floor((w[X + k] + reach) * scale)
        w[BLOCK_OF + k] = row * width + column
    return side


@njit(**FAST)
def _add_influence(first, count, w, pull, white, blocks, doubted):
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
def _is_last(length, gain, cost, count):
    """Whether the step after this one would not be worth its while."""
    return (length < SETTLED and gain < WORTH * cost) or gain * count < WORTHLESS * cost


@njit(**FAST)
def minimise(p, instants, x0, y0, count, w, H, L, quality):
    """Levenberg and Marquardt's steps from p, which is filled with the result, as is quality; False where they fail.

    H holds the normal equations at p. A step that leaves the normal matrix nearly as it was is followed by another with
    the same factor, from the look at the pixels that `quality` takes: mostly the last.
    """
    n = PARAMETERS
    trial, settled = p.copy(), p.copy()
    step = np.zeros(n)
    damping = 1e-3
    best = np.inf
    for attempt in range(40):
        if attempt > 0:
            normal_equations(trial, instants, x0, y0, count, w, H)
        cost = H[n, n]
        if not cost < np.inf:
            return False
        if cost > best * (1.0 + 1e-6):  # back, and less far
            damping = max(30.0 * damping, 1e-3)
            if damping > 1e4:
                break
            step *= 0.2
            trial[:] = p + step
            _keep_possible(trial, instants)
            continue
        best = cost
        p[:] = trial
        damping = max(0.1 * damping, 1e-7)
        for i in range(n):
            step[i] = H[n, i]
        if not factorise(H, damping, L):
            return False
        substitute(L, step)
        gain = 0.0
        for i in range(n):
            gain += step[i] * H[n, i]
        trial[:] = p + step
        _keep_possible(trial, instants)
        length = max(abs(step[0]), abs(step[1]))
        last, close = _is_last(length, gain, best, count), _is_close(p, step)
        if not (damping < LITTLE and (last or close)):
            continue
        settled[:] = trial
        length, cost, gain = _assess(trial, instants, x0, y0, count, w, L, quality)
        risen = RISEN if close and length < RESTING else LEVEL
        if cost < best * (1.0 + risen) and (last or _is_last(length, gain, cost, count)):
            p[:] = trial
            return True
        trial[:] = settled
    # Where rounding hides what is left to gain, or along what the pixels hardly tell.
    normal_equations(p, instants, x0, y0, count, w, H)
    if not factorise(H, MUCH, L):
        return False
    length, cost, gain = _assess(p, instants, x0, y0, count, w, L, quality)
    return _is_last(length, gain, cost, count)
