"""Fitting discs to pixels: which pixels to trust, and whether the disc moved far while the shutter was open."""

from typing import Any

import numpy as np
from numba import njit
from rafl.tracking.detection.disc_model import (
    CHUNK,
    FAST,
    FLAT,
    LARGEST,
    PARAMETERS,
    RESIDUAL,
    SHOWN,
    SIZE,
    VALUE,
    WEIGHT,
    J,
    X,
    Y,
    choose_pixels,
    filled_up,
    instants_of,
    linearise,
    smear,
)
from rafl.tracking.detection.levenberg_marquardt import minimise
from rafl.tracking.detection.normal_equations import add_products, normal_equations

OUTLYING = 0.12  # of the contrast: a pixel farther off than this shows something else than the dot
STRANGE = 0.2  # of the contrast: a level this far from what the start expects
NOISY = 3.5  # standard deviations of the pixels' noise: where that is more, it is not strange yet
ASKED = 0.1  # of the contrast: a residual up to which it does not matter how much of it is noise
LIT, EXPLAINED = 0.05, 0.5  # of the light's logarithm: a change that matters; of what is strange: what is left of it
FEW = 0.01  # of the pixels: so many may look strange by noise
LITTLE = 0.3  # weight
# A function that is optimised both alone and within its callers is rounded as its one or other copy has it, by whether
# they are compiled in this process or were before; and a start's strange pixels turn on the last bit.
AS_WRITTEN: dict[str, Any] = FAST | {"fastmath": {"nsz"}}
BESIDE = 1.2  # standard deviations of the edge: what shows something else is blurred as well
LONG_SMEAR = 0.4  # of the radius: motion during the exposure that a blurred edge does not describe any more


@njit(**FAST)
def _reweight(p, instants, x0, y0, count, strange, share, w):
    """Less weight to pixels far off, by the median of the residuals' size; returns the largest change.

    At the outline by the median there: a dot drawn by hand is nowhere quite a disc. None at all to pixels that show
    something strange, and beside them.
    """
    count = min(count, LARGEST)
    for first in range(0, count, CHUNK):
        linearise(p, instants, x0, y0, first, filled_up(min(CHUNK, count - first)), w)
        _weigh_levels(first, min(CHUNK, count - first), p[8], share, w)
    if strange:
        _widen(BESIDE * np.sqrt(0.5 * (p[5] + p[5 if instants > 1 else 7])), count, w)
    else:
        w[SHOWN : SHOWN + count] = np.float32(1.0)
    scale = _usual_size(1, count, w)
    outline = max(_usual_size(0, count, w), scale)
    change = np.float32(0.0)
    for k in range(count):
        z = w[RESIDUAL + k] / (np.float32(4.0) * (scale if w[FLAT + k] > np.float32(0.0) else outline))
        new = w[SHOWN + k] / (np.float32(1.0) + z * z * z * z)
        change = max(change, abs(new - w[WEIGHT + k]))
        w[WEIGHT + k] = new
    return change


@njit(**FAST)
def _usual_size(most, count, w):
    """A standard deviation by the median of the residuals at the outline, where `most` is 0, or at all pixels (1)."""
    count = min(count, LARGEST)
    found = 0
    for k in range(count):
        w[SIZE + found] = abs(w[RESIDUAL + k])
        found += int((w[FLAT + k] <= most) & (w[SHOWN + k] > np.float32(0.0)))
    return np.float32(1.4826) * np.median(w[SIZE : SIZE + max(found, 1)]) + np.float32(0.3)


@njit(**FAST)
def _widen(reach, count, w):
    """Takes all weight by the level shown from pixels within reach [px] of those that have little."""
    count = min(count, LARGEST)
    square = np.float32(reach * reach)
    few = 0
    for k in range(count):
        if w[SHOWN + k] < np.float32(LITTLE):
            w[SIZE + few] = k
            few += 1
    for item in range(few):
        k = int(w[SIZE + item])
        x, y = w[X + k], w[Y + k]
        for other in range(count):
            near = (w[X + other] - x) ** 2 + (w[Y + other] - y) ** 2 < square
            w[SHOWN + other] = np.float32(0.0) if near else w[SHOWN + other]


@njit(**FAST)
def fit_disc(image, p, near, wary, w, quality):
    """Fit a disc from the start p (12), which is filled with the result, as is quality (QUALITY).

    near (K, 3): centre and radius of other dots. wary: of pixels that the start does not explain. w (SCRATCH), float32,
    is room to work in.
    """
    start = p.copy()
    if _fit(image, p, near, wary, w, quality):  # the start may be what is strange
        p[:] = start
        _fit(image, p, near, False, w, quality)


@njit(**FAST)
def _fit(image, p, near, wary, w, quality):
    """One try of `fit_disc`; True where it fails and some pixels were distrusted."""
    n = PARAMETERS
    quality[:] = 0.0
    H = np.empty((n + 1, n + 1))
    L = np.empty((n, n))
    instants = 1
    away = 1.0 + 2.0 / np.sqrt(max(p[2] * p[4] - p[3] * p[3], 1e-12))
    left, right, top, bottom = p[0] - away, p[0] + away, p[1] - away, p[1] + away
    strange, share = False, STRANGE
    count = 0
    x0 = 0
    y0 = 0
    for _ in range(4):  # the pixels are chosen anew where the disc has left those it began with
        x0, y0 = int(np.rint(p[0])), int(np.rint(p[1]))
        count = choose_pixels(image, p, near, w)
        if count < 3 * n:
            return False
        strange, share = _distrust(p, x0, y0, count, wary, w, H)
        if not minimise(p, instants, x0, y0, count, w, H, L, quality):
            return strange
        if not (left < p[0] < right and top < p[1] < bottom):
            return strange
        if abs(p[0] - x0) < 1.5 and abs(p[1] - y0) < 1.5:
            break
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    if np.sqrt(24.0 * spread) > LONG_SMEAR / np.sqrt(p[2] * p[4] - p[3] * p[3]):
        blurred, before = p.copy(), quality.copy()
        smear(p)
        instants = instants_of(p)  # the same to the end: with another number nothing goes down evenly
        normal_equations(p, instants, x0, y0, count, w, H)
        if not minimise(p, instants, x0, y0, count, w, H, L, quality):  # a small dot's way may look like its blur
            instants = 1
            p[:], quality[:] = blurred, before
            normal_equations(p, instants, x0, y0, count, w, H)
    if strange or _count_beyond(OUTLYING * abs(p[8]), count, w) > 0:
        for _ in range(6):
            change = _reweight(p, instants, x0, y0, count, strange, share, w)
            normal_equations(p, instants, x0, y0, count, w, H)
            if not minimise(p, instants, x0, y0, count, w, H, L, quality):
                return strange
            if change < 0.1:
                break
    if instants > 1:  # back to W, from which another fit may start
        p[5], p[6], p[7] = p[5] + p[6] ** 2 / 12.0, p[6] * p[7] / 12.0, p[5] + p[7] ** 2 / 12.0
    if quality[5] > (ASKED * p[8]) ** 2:
        quality[10] = min(_noise(RESIDUAL, count, w) ** 2, quality[5])
    quality[11] = _grain(count, w)
    quality[0] = 1.0
    return False


@njit(**FAST)
def _distrust(p, x0, y0, count, wary, w, H):
    """First weights: little where a level is far from the start's, at the outline from all between; whether any is.

    Otherwise a highlight beside the dot could pass for its blurred edge. Also returns how far is far, as a share of the
    contrast. Fills H as `normal_equations` does.
    """
    share = STRANGE
    w[WEIGHT : WEIGHT + count] = np.float32(1.0)
    strange = _weigh_start(p, x0, y0, count, share, w, H)
    if wary and strange >= max(4.0, FEW * count):
        strange = _relight(p, x0, y0, count, strange, w, H)
    if wary and strange >= max(4.0, FEW * count):
        share = max(STRANGE, NOISY * _noise(VALUE, count, w) / abs(p[8]))
        if share > STRANGE:
            strange = _weigh_start(p, x0, y0, count, share, w, H)
    if not wary or strange < max(4.0, FEW * count):
        return False, share
    _widen(BESIDE * np.sqrt(0.5 * (p[5] + p[7])), count, w)
    w[WEIGHT : WEIGHT + count] = w[SHOWN : SHOWN + count]
    normal_equations(p, 1, x0, y0, count, w, H)
    return True, share


@njit(**FAST)
def _relight(p, x0, y0, count, strange, w, H):
    """Gives a start the light of the picture, where that explains most of what is strange; returns how much is left.

    Light brightens a dot and its surroundings by the same factor; what shows something else than the dot does not.
    """
    contrast, level = p[8], p[9]
    least = np.float32(max(level, level + contrast) - 0.25 * abs(contrast))
    bright = 0
    for k in range(min(count, LARGEST)):
        expected = w[VALUE + k] - w[RESIDUAL + k]
        w[SIZE + bright] = w[VALUE + k] / max(expected, np.float32(1.0))
        bright += int((w[FLAT + k] > np.float32(0.0)) & (expected > least))
    light = np.median(w[SIZE : SIZE + max(bright, 1)])
    if bright == 0 or abs(np.log(max(light, 0.01))) < LIT:
        return strange
    p[8], p[9] = contrast * light, level * light
    left = _weigh_start(p, x0, y0, count, STRANGE, w, H)
    if left < EXPLAINED * strange:
        return left
    p[8], p[9] = contrast, level
    return _weigh_start(p, x0, y0, count, STRANGE, w, H)


@njit(**FAST)
def _weigh_start(p, x0, y0, count, share, w, H):
    """Weights by the levels that a start expects; returns how many are small. Fills H as `normal_equations` does."""
    strange = 0
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = filled_up(min(CHUNK, count - first))
        linearise(p, 1, x0, y0, first, some, w)
        strange += _weigh_levels(first, min(CHUNK, count - first), p[8], share, w)
        add_products(first, some, w, H)
    return strange


@njit(**FAST)
def _noise(row, count, w):
    """The standard deviation of what pixels side by side in a line do not share, by the median of its size."""
    count = min(count, LARGEST)
    found = 0
    for k in range(1, count):
        beside = (w[Y + k] == w[Y + k - 1]) & (w[X + k] - w[X + k - 1] < np.float32(2.5))
        w[SIZE + found] = abs(w[row + k] - w[row + k - 1])
        found += int(beside)
    return 1.4826 / np.sqrt(2.0) * np.median(w[SIZE : SIZE + max(found, 1)])


@njit(**FAST)
def _grain(count, w):
    """The variance of what the residuals of pixels side by side in a line do not share, as they are trusted."""
    count = min(count, LARGEST)
    square, pairs = np.float32(0.0), np.float32(0.0)
    for k in range(1, count):
        beside = (w[Y + k] == w[Y + k - 1]) & (w[X + k] - w[X + k - 1] < np.float32(2.5))
        trust = w[WEIGHT + k] * w[WEIGHT + k - 1] if beside else np.float32(0.0)
        square += trust * (w[RESIDUAL + k] - w[RESIDUAL + k - 1]) ** 2
        pairs += trust
    return 0.5 * square / max(pairs, np.float32(1.0))


@njit(**AS_WRITTEN)
def _weigh_levels(first, count, contrast, share, w):
    """Fills a linearised chunk's weights by the levels shown, and which are flat; returns how many are small.

    share: of the contrast: a level this far from what is expected gets half of the weight.
    """
    count = min(count, CHUNK)
    first = min(max(first, 0), LARGEST - CHUNK)
    zero, one = np.float32(0.0), np.float32(1.0)
    inverse = np.float32(1.0 / share)
    scale = inverse / np.float32(abs(contrast))
    over = inverse / np.float32(contrast)
    strange = np.int32(0)
    for k in range(count):
        step = w[J + 8 * CHUNK + k]
        away = w[J + 12 * CHUNK + k]
        beyond = away * over - (one - step) * inverse  # the disc's level
        short = -away * over - step * inverse  # its surroundings'
        far = abs(step - np.float32(0.5)) > np.float32(0.4999)
        z = away * scale if far else max(max(beyond, short), zero)
        weight = one / (one + z * z * z * z)
        w[SHOWN + first + k] = weight
        w[FLAT + first + k] = one if far else zero
        strange += np.int32(1) if weight < np.float32(LITTLE) else np.int32(0)
    return strange


@njit(**FAST)
def _count_beyond(most, count, w):
    """How many residuals are larger; a sum becomes vector instructions, a maximum would not."""
    count = min(count, LARGEST)
    limit = np.float32(most)
    total = np.float32(0.0)
    for k in range(count):
        total += np.float32(1.0) if abs(w[RESIDUAL + k]) > limit else np.float32(0.0)
    return total
