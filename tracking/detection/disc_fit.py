"""Fit discs to pixels: weigh the pixels, and find out whether the disc moved far during the exposure.

Arrays are copied in loops. Numba compiles an assignment to a slice with texts for errors of shape, which take seconds.
"""

from typing import Any

import numpy as np
from numba import njit

from rafl.tracking.detection.disc_model import (
    CHUNK,
    FAST,
    FLAT,
    LEVEL_WEIGHT,
    MAX_PIXELS,
    PARAMETER_COUNT,
    RESIDUAL,
    VALUE,
    WEIGHT,
    WORK,
    J,
    X,
    Y,
    count_instants,
    linearise,
    pad_to_lanes,
    select_pixels,
    split_motion_blur,
)
from rafl.tracking.detection.levenberg_marquardt import QUALITY_COUNT, minimise
from rafl.tracking.detection.normal_equations import add_products, normal_equations

OUTLIER_RESIDUAL = 0.12  # fraction of the contrast: a pixel with a larger residual shows something else than the dot
LEVEL_TOLERANCE = 0.2  # fraction of the contrast: a level this far from those of the start gets half the weight
NOISE_SIGMAS = 3.5  # sigmas of the pixel noise: lower limit of the level tolerance
MIN_NOISE_RESIDUAL = 0.1  # fraction of the contrast: the pixel noise is estimated only for larger residuals
MIN_LIGHT_CHANGE = 0.05  # logarithm: a smaller change of the light does not matter
MAX_UNEXPLAINED = 0.5  # fraction of the unexplained pixels that may remain where a change of the light explains them
MIN_UNEXPLAINED_FRACTION = 0.01  # of the pixels: fewer may be due to noise
LOW_WEIGHT = 0.3  # a pixel of less weight counts as unexplained
# Numba compiles a function both alone and inlined in its callers, and the two round differently under fast-math. Which
# one runs depends on whether they were compiled in this process or loaded from the cache. The start's unexplained
# pixels depend on the last bit.
STRICT: dict[str, Any] = FAST | {"fastmath": {"nsz"}}
WIDENING_SIGMAS = 1.2  # sigmas of the edge: what occludes the dot is blurred as well
MAX_SHORT_MOTION = 0.4  # fraction of the radius: a longer motion during the exposure is no blurred edge


@njit(**FAST)
def _reweight(p, instants, x0, y0, count, unexplained, tolerance, w):
    """Update the weights by the residuals over their median size; returns the largest change of a weight.

    Pixels at the outline have a median of their own, because a dot drawn by hand is nowhere exactly a disc. Unexplained
    pixels and those around them get no weight.

    unexplained: whether there are any. tolerance: as a fraction of the contrast, see `_fill_level_weights`.
    """
    count = min(count, MAX_PIXELS)
    for first in range(0, count, CHUNK):
        linearise(p, instants, x0, y0, first, pad_to_lanes(min(CHUNK, count - first)), w)
        _fill_level_weights(first, min(CHUNK, count - first), p[8], tolerance, w)
    if unexplained:
        _exclude_around_unexplained(WIDENING_SIGMAS * np.sqrt(0.5 * (p[5] + p[5 if instants > 1 else 7])), count, w)
    else:
        w[LEVEL_WEIGHT : LEVEL_WEIGHT + count] = np.float32(1.0)
    scale = _robust_scale(1, count, w)
    outline = max(_robust_scale(0, count, w), scale)
    change = np.float32(0.0)
    for k in range(count):
        z = w[RESIDUAL + k] / (np.float32(4.0) * (scale if w[FLAT + k] > np.float32(0.0) else outline))
        new = w[LEVEL_WEIGHT + k] / (np.float32(1.0) + z * z * z * z)
        change = max(change, abs(new - w[WEIGHT + k]))
        w[WEIGHT + k] = new
    return change


@njit(**FAST)
def _robust_scale(max_flat, count, w):
    """Sigma of the residuals, by their median: of pixels at the outline (max_flat 0) or of all (1)."""
    count = min(count, MAX_PIXELS)
    found = 0
    for k in range(count):
        w[WORK + found] = abs(w[RESIDUAL + k])
        found += int((w[FLAT + k] <= max_flat) & (w[LEVEL_WEIGHT + k] > np.float32(0.0)))
    return np.float32(1.4826) * np.median(w[WORK : WORK + max(found, 1)]) + np.float32(0.3)


@njit(**FAST)
def _exclude_around_unexplained(reach, count, w):
    """Set the level weight to 0 within reach [px] of the unexplained pixels."""
    count = min(count, MAX_PIXELS)
    square = np.float32(reach * reach)
    unexplained = 0
    for k in range(count):
        if w[LEVEL_WEIGHT + k] < np.float32(LOW_WEIGHT):
            w[WORK + unexplained] = k
            unexplained += 1
    for item in range(unexplained):
        k = int(w[WORK + item])
        x, y = w[X + k], w[Y + k]
        for other in range(count):
            near = (w[X + other] - x) ** 2 + (w[Y + other] - y) ** 2 < square
            w[LEVEL_WEIGHT + other] = np.float32(0.0) if near else w[LEVEL_WEIGHT + other]


@njit(**FAST)
def fit_disc(image, deep_image, p, near, robust, w, quality):
    """Fit a disc, from the initial parameters p (12); fills p with the result, and quality (QUALITY_COUNT).

    image, deep_image: 8-bit and float32 grey levels, one of them empty: one signature, so that this is compiled once.
    near (K, 3): centre and radius of other dots. robust: reduce the weight of pixels that the initial parameters do not
    explain. w (SCRATCH_SIZE), float32: scratch array.
    """
    start = p.copy()
    while _fit(image, deep_image, p, near, robust, w, quality):
        for i in range(PARAMETER_COUNT):  # the initial parameters may be wrong instead of the pixels
            p[i] = start[i]
        robust = not robust  # now False, with which the fit has no unexplained pixels


@njit(**FAST)
def _fit(image, deep_image, p, near, robust, w, quality):
    """Fit once, see `fit_disc`; returns True if the fit fails and some pixels counted as unexplained."""
    n = PARAMETER_COUNT
    quality[:] = 0.0
    H = np.empty((n + 1, n + 1))
    L = np.empty((n, n))
    instants = 1
    reach = 1.0 + 2.0 / np.sqrt(max(p[2] * p[4] - p[3] * p[3], 1e-12))
    left, right, top, bottom = p[0] - reach, p[0] + reach, p[1] - reach, p[1] + reach
    unexplained, tolerance = False, LEVEL_TOLERANCE
    count = 0
    x0 = 0
    y0 = 0
    for _ in range(4):  # select the pixels again if the disc has moved away from them
        x0, y0 = int(np.rint(p[0])), int(np.rint(p[1]))
        count = select_pixels(image, p, near, w) if image.size else select_pixels(deep_image, p, near, w)
        if count < 3 * n:
            return False
        unexplained, tolerance = _initial_weights(p, x0, y0, count, robust, w, H)
        if not minimise(p, instants, x0, y0, count, w, H, L, quality):
            return unexplained
        if not (left < p[0] < right and top < p[1] < bottom):
            return unexplained
        if abs(p[0] - x0) < 1.5 and abs(p[1] - y0) < 1.5:
            break
    spread = np.sqrt(0.25 * (p[5] - p[7]) ** 2 + p[6] * p[6])
    if np.sqrt(24.0 * spread) > MAX_SHORT_MOTION / np.sqrt(p[2] * p[4] - p[3] * p[3]):
        blurred, before = p.copy(), quality.copy()
        split_motion_blur(p)
        instants = count_instants(p)  # constant: another number would change the cost
        normal_equations(p, instants, x0, y0, count, w, H)
        if not minimise(p, instants, x0, y0, count, w, H, L, quality):  # a small dot's motion may look like its blur
            instants = 1
            for i in range(n):
                p[i] = blurred[i]
            for i in range(QUALITY_COUNT):
                quality[i] = before[i]
            normal_equations(p, instants, x0, y0, count, w, H)
    if unexplained or _count_above(OUTLIER_RESIDUAL * abs(p[8]), count, w) > 0:
        for _ in range(6):
            change = _reweight(p, instants, x0, y0, count, unexplained, tolerance, w)
            normal_equations(p, instants, x0, y0, count, w, H)
            if not minimise(p, instants, x0, y0, count, w, H, L, quality):
                return unexplained
            if change < 0.1:
                break
    if instants > 1:  # back to W, so that another fit may start from it
        p[5], p[6], p[7] = p[5] + p[6] ** 2 / 12.0, p[6] * p[7] / 12.0, p[5] + p[7] ** 2 / 12.0
    if quality[5] > (MIN_NOISE_RESIDUAL * p[8]) ** 2:
        quality[10] = min(_pixel_noise(RESIDUAL, count, w) ** 2, quality[5])
    quality[0] = 1.0
    return False


@njit(**FAST)
def _initial_weights(p, x0, y0, count, robust, w, H):
    """Initial weights: low where a level is far from those of the initial parameters.

    At the outline, all levels between the disc's and that of its surroundings are expected. Without these weights, a
    highlight beside the dot could pass for its blurred edge. Fills H as `normal_equations` does. Returns whether any
    pixels are unexplained, and the tolerance of the levels as a fraction of the contrast.
    """
    tolerance = LEVEL_TOLERANCE
    w[WEIGHT : WEIGHT + count] = np.float32(1.0)
    unexplained = _weigh_by_levels(p, x0, y0, count, tolerance, w, H)
    if robust and unexplained >= max(4.0, MIN_UNEXPLAINED_FRACTION * count):
        unexplained = _adjust_light(p, x0, y0, count, unexplained, w, H)
    if robust and unexplained >= max(4.0, MIN_UNEXPLAINED_FRACTION * count):
        tolerance = max(LEVEL_TOLERANCE, NOISE_SIGMAS * _pixel_noise(VALUE, count, w) / abs(p[8]))
        if tolerance > LEVEL_TOLERANCE:
            unexplained = _weigh_by_levels(p, x0, y0, count, tolerance, w, H)
    if not robust or unexplained < max(4.0, MIN_UNEXPLAINED_FRACTION * count):
        return False, tolerance
    _exclude_around_unexplained(WIDENING_SIGMAS * np.sqrt(0.5 * (p[5] + p[7])), count, w)
    for k in range(count):
        w[WEIGHT + k] = w[LEVEL_WEIGHT + k]
    normal_equations(p, 1, x0, y0, count, w, H)
    return True, tolerance


@njit(**FAST)
def _adjust_light(p, x0, y0, count, unexplained, w, H):
    """Adapt the initial parameters to the light in the frame if that explains most of the unexplained pixels.

    Light changes the dot and its surroundings by the same factor; an occlusion does not. Returns how many pixels remain
    unexplained.
    """
    contrast, level = p[8], p[9]
    bright_level = np.float32(max(level, level + contrast) - 0.25 * abs(contrast))
    bright = 0
    for k in range(min(count, MAX_PIXELS)):
        expected = w[VALUE + k] - w[RESIDUAL + k]
        w[WORK + bright] = w[VALUE + k] / max(expected, np.float32(1.0))
        bright += int((w[FLAT + k] > np.float32(0.0)) & (expected > bright_level))
    light = np.median(w[WORK : WORK + max(bright, 1)])
    if bright == 0 or abs(np.log(max(light, 0.01))) < MIN_LIGHT_CHANGE:
        return unexplained
    p[8], p[9] = contrast * light, level * light
    left = _weigh_by_levels(p, x0, y0, count, LEVEL_TOLERANCE, w, H)
    if left < MAX_UNEXPLAINED * unexplained:
        return left
    p[8], p[9] = contrast, level
    return _weigh_by_levels(p, x0, y0, count, LEVEL_TOLERANCE, w, H)


@njit(**FAST)
def _weigh_by_levels(p, x0, y0, count, tolerance, w, H):
    """Fill the level weights for parameters p; returns how many are low. Fills H as `normal_equations` does."""
    unexplained = 0
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = pad_to_lanes(min(CHUNK, count - first))
        linearise(p, 1, x0, y0, first, some, w)
        unexplained += _fill_level_weights(first, min(CHUNK, count - first), p[8], tolerance, w)
        add_products(first, some, w, H)
    return unexplained


@njit(**FAST)
def _pixel_noise(row, count, w):
    """Sigma of the noise, by the median difference of horizontally adjacent pixels in row `row` of w."""
    count = min(count, MAX_PIXELS)
    found = 0
    for k in range(1, count):
        beside = (w[Y + k] == w[Y + k - 1]) & (w[X + k] - w[X + k - 1] < np.float32(2.5))
        w[WORK + found] = abs(w[row + k] - w[row + k - 1])
        found += int(beside)
    return 1.4826 / np.sqrt(2.0) * np.median(w[WORK : WORK + max(found, 1)])


@njit(**STRICT)
def _fill_level_weights(first, count, contrast, tolerance, w):
    """Fill a linearised chunk's weights by their levels, and which pixels are flat; returns how many weights are low.

    tolerance: fraction of the contrast: a level this far outside the expected range gets half the weight.
    """
    count = min(count, CHUNK)
    first = min(max(first, 0), MAX_PIXELS - CHUNK)
    zero, one = np.float32(0.0), np.float32(1.0)
    inverse = np.float32(1.0 / tolerance)
    scale = inverse / np.float32(abs(contrast))
    over = inverse / np.float32(contrast)
    unexplained = np.int32(0)
    for k in range(count):
        step = w[J + 8 * CHUNK + k]
        deviation = w[J + 12 * CHUNK + k]
        beyond = deviation * over - (one - step) * inverse  # beyond the disc's level
        short = -deviation * over - step * inverse  # short of its surroundings' level
        far = abs(step - np.float32(0.5)) > np.float32(0.4999)
        z = deviation * scale if far else max(max(beyond, short), zero)
        weight = one / (one + z * z * z * z)
        w[LEVEL_WEIGHT + first + k] = weight
        w[FLAT + first + k] = one if far else zero
        unexplained += np.int32(1) if weight < np.float32(LOW_WEIGHT) else np.int32(0)
    return unexplained


@njit(**FAST)
def _count_above(limit, count, w):
    """Count the residuals above a bound; the compiler vectorises a sum but not a maximum."""
    count = min(count, MAX_PIXELS)
    bound = np.float32(limit)
    total = np.float32(0.0)
    for k in range(count):
        total += np.float32(1.0) if abs(w[RESIDUAL + k]) > bound else np.float32(0.0)
    return total
