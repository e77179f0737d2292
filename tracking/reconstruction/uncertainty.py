"""Errors of marker positions that the fits do not show, estimated from the recording itself.

Compression, hand-drawn outlines and partial cover shift a dot without a trace in the fit. But all markers ride on one
body, which moves smoothly in a few modes. What a marker's path has beyond that is error.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

MIN_FRAMES, MIN_MARKERS = 12, 4  # fewer do not tell modes from errors
MIN_SEEN_SHARE = 0.5  # of the frames, in which a marker is seen, and of these markers, in a frame: others are left out
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
MAX_SHARED_RATIO = 1.0  # of this shared error to a dot's own: motion that is no smoother is not taken for an error
# The first modes fill best what is not seen: the model gets one mode after the other, each with rounds of fitting. Six
# are enough for a body that bends and twists; more begin to follow the errors.
MAX_MODES, ROUNDS_PER_MODE = 6, 4
ROBUST_SIGMAS = 3.0  # a position farther from the model counts as one that is this far


def with_error_floor(pixel: Array, sigma: Array, half_width: Array, predicted_frames: bool) -> Array:
    """Sigmas that are nowhere smaller than the recording's own errors [px], (T, D, 2).

    A marker's error is estimated from its distance to the position that the body's modes give it, whatever its cause: a
    codec, a dot that is no disc, or something in front of it. In predicted frames, what a mode's neighbours in time do
    not explain counts too. Something in front of a whole row shifts all its dots alike; but where the skin turns, all
    outlines change smoothly. A change of one outline beyond that is a part that is not seen, and its centre may be off
    by as much.

    Args:
        pixel: paths of one camera's markers [px], (T, D, 2), NaN where not seen.
        sigma: from the fits [px], (T, D, 2).
        half_width: of the dots along x and y [px], (T, D, 2), NaN where not known.
        predicted_frames: whether the video's encoder predicted frames from others, with loss.
    """
    sigma = PREDICTED_FRAMES_FACTOR * sigma if predicted_frames else sigma
    residual, jumps = _beyond_modes(pixel)
    known = np.flatnonzero(np.isfinite(residual).any(axis=(0, 2)))
    if not len(known):
        return sigma
    error, shared = (NORMAL_MAD * np.nanmedian(np.abs(part[:, known]), axis=0) for part in (residual, jumps))
    if predicted_frames:
        error = np.hypot(error, np.minimum(shared, MAX_SHARED_RATIO * error))
    floor = np.tile(np.median(error, axis=0), (sigma.shape[1], 1))
    floor[known] = error
    change = _beyond_modes(half_width)[0]
    least = np.fmax(np.abs(residual), np.abs(change)) / MAX_SIGMAS
    result: Array = np.where(np.isfinite(sigma), np.fmax(np.maximum(sigma, floor), least), np.nan)
    return result


def _beyond_modes(path: Array) -> tuple[Array, Array]:
    """`_errors` of the paths (T, D, 2) that are known in most frames, NaN elsewhere; (T, D, 2) each."""
    seen = np.isfinite(path[..., 0])
    markers = np.flatnonzero(seen.mean(axis=0) > MIN_SEEN_SHARE)
    frames = np.flatnonzero(seen[:, markers].sum(axis=1) > MIN_SEEN_SHARE * len(markers))
    residual, jumps = np.full((2, *path.shape), np.nan)
    if len(frames) >= MIN_FRAMES and len(markers) >= MIN_MARKERS:
        index, shape = np.ix_(frames, markers), (len(frames), len(markers), 2)
        residual[index], jumps[index] = (part.reshape(shape) for part in _errors(path[index].reshape(len(frames), -1)))
    return residual, jumps


def _errors(path: Array) -> tuple[Array, Array]:
    """Errors of paths (T, 2 M) [px], NaN where not seen, by a robust low-rank model that fills what is not seen.

    Returns:
        The paths beyond the body's modes, scaled to the size of the errors themselves, and the modes' motion that
        neighbouring frames do not predict; (T, 2 M) each.
    """
    count, columns = path.shape
    known, frames = np.isfinite(path), np.arange(count)
    filled = np.array([np.interp(frames, frames[own], path[own, k]) for k, own in enumerate(known.T)]).T
    for number in range(MAX_MODES * ROUNDS_PER_MODE):
        deviation = filled - filled.mean(axis=0)
        square, modes = (part[..., ::-1] for part in np.linalg.eigh(deviation.T @ deviation))
        most = min(1 + number // ROUNDS_PER_MODE, _count_modes(square, count, columns), count // 4, columns // 4)
        own_share = (modes.reshape(-1, 2, columns) ** 2).sum(axis=1).max(axis=0)
        modes = modes[:, : max(most, 1)].T
        modes = modes[own_share[: len(modes)] <= MAX_OWN_SHARE]
        amplitude = deviation @ modes.T
        model = filled.mean(axis=0) + amplitude @ modes
        residual = path - model
        limit = ROBUST_SIGMAS * NORMAL_MAD * np.nanmedian(np.abs(residual), axis=0)
        filled = np.where(known, model + np.clip(residual, -limit, limit), model)
    # The modes follow each marker's own errors too, by its share in them.
    left = (1.0 - (modes**2).sum(axis=0)) * (1.0 - (len(modes) + 1) / count)
    return residual / np.sqrt(left), _jumps(amplitude) @ modes


def _jumps(amplitude: Array) -> Array:
    """Errors of the modes' amplitudes (T, R) that those of neighbouring frames do not predict, (T, R)."""
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
