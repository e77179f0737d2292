"""Errors of marker positions that the fits do not show, estimated from the recording itself.

Compression, hand-drawn outlines and partial cover shift a dot without a trace in the fit. But all markers ride on one
body, which moves smoothly in a few modes. What a marker's path has beyond that is error.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

MIN_FRAMES, MIN_MARKERS = 12, 4  # that show all of these markers: fewer do not tell modes from errors
MIN_SEEN_SHARE = 0.8  # of the frames: a marker seen in fewer is left out, so that frames with all markers remain
# A mode above this share of one marker's motion in the whole (sums of squares) is that marker's alone: an error.
MAX_OWN_SHARE = 0.8
MAX_SIGMAS = 3.0  # a position's sigma is at least its distance from the modes' position over this
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute value
# Errors of frames that an encoder predicts from others, with loss, are shared by more pixels than a fit can tell: its
# sigma is too small by this factor for a dot that stays in place. Measured on 115 videos of x264 at crf 12 to 28.
PREDICTED_FRAMES_FACTOR = 1.7
# An encoder lets all dots lag alike, which looks like a motion of the body. But a body moves smoothly: frames so far
# apart predict each mode's amplitude. Two distances on either side suffice for two frequencies.
FRAME_DISTANCES = 1, 2


def with_error_floor(pixel: Array, sigma: Array, predicted_frames: bool) -> Array:
    """Sigmas that are nowhere smaller than the recording's own errors [px], (T, D, 2).

    A marker's error is estimated from its distance to the position that the body's modes give it, whatever its cause: a
    codec, or a dot that is no disc. In predicted frames, what its neighbours in time do not explain counts too.

    Args:
        pixel: paths of one camera's markers [px], (T, D, 2), NaN where not seen.
        sigma: from the fits [px], (T, D, 2).
        predicted_frames: whether the video's encoder predicted frames from others, with loss.
    """
    sigma = PREDICTED_FRAMES_FACTOR * sigma if predicted_frames else sigma
    seen = np.isfinite(sigma[..., 0])
    markers = np.flatnonzero(seen.mean(axis=0) > MIN_SEEN_SHARE)
    frames = np.flatnonzero(seen[:, markers].all(axis=1)) if len(markers) else np.zeros(0, int)
    if len(frames) < MIN_FRAMES or len(markers) < MIN_MARKERS:
        return sigma
    index = np.ix_(frames, markers)
    residual, shared = _residuals(pixel[index])
    error = NORMAL_MAD * np.median(np.abs(residual + shared if predicted_frames else residual), axis=0)
    floor = np.tile(np.median(error, axis=0), (sigma.shape[1], 1))
    floor[markers] = error
    result: Array = np.maximum(sigma, floor)
    result[index] = np.maximum(result[index], np.abs(residual) / MAX_SIGMAS)
    return result


def _residuals(path: Array) -> tuple[Array, Array]:
    """Errors of paths (F, M, 2) beyond the body's modes, and within these beyond smooth motion [px], (F, M, 2) each."""
    count, markers = path.shape[:2]
    deviation = (path - path.mean(axis=0)).reshape(count, -1)
    _, size, modes = np.linalg.svd(deviation, full_matrices=False)
    own_share = (modes.reshape(len(modes), markers, 2) ** 2).sum(axis=2).max(axis=1)
    most = min(_count_modes(size**2, *deviation.shape), count // 4, markers // 2)
    modes = modes[: max(most, 1)]
    modes = modes[own_share[: len(modes)] <= MAX_OWN_SHARE]
    # The modes follow each marker's own errors too, by its share in them.
    left = 1.0 - (modes**2).sum(axis=0)
    left *= 1.0 - (len(modes) + 1) / count
    amplitude = deviation @ modes.T
    residual = (deviation - amplitude @ modes) / np.sqrt(left)
    return residual.reshape(path.shape), (_jumps(amplitude) @ modes).reshape(path.shape)


def _jumps(amplitude: Array) -> Array:
    """Errors of the modes' amplitudes (F, R) that those of neighbouring frames do not predict, (F, R)."""
    reach = max(FRAME_DISTANCES)
    inner = np.arange(reach, len(amplitude) - reach)
    errors = np.zeros_like(amplitude)
    for mode in range(amplitude.shape[1]):
        own = amplitude[:, mode]
        beside = np.stack([own[inner - distance] + own[inner + distance] for distance in FRAME_DISTANCES], axis=1)
        weights = np.linalg.lstsq(beside, own[inner], rcond=None)[0]
        # The neighbours' errors, which are as large, count by their weights.
        errors[inner, mode] = (own[inner] - beside @ weights) / np.sqrt(1.0 + 2.0 * (weights**2).sum())
    return errors


def _count_modes(square: Array, rows: int, columns: int) -> int:
    """Number of modes beyond noise, from the squared singular values of a matrix, if at least half of them are noise.

    Those of noise follow the distribution of Marchenko and Pastur. Its median is about 1 - 0.35 times the matrix's
    aspect ratio.
    """
    long, short = max(rows - 1, columns), min(rows - 1, columns)
    noise = float(np.median(square[:short])) / (long - 0.35 * short)
    return int((square > 1.1 * noise * (np.sqrt(long) + np.sqrt(short)) ** 2).sum())
