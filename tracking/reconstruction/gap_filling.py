"""Filling gaps: positions of markers that are out of sight for a few frames."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[Any]

MISSING, MEASURED, FILLED = 0, 1, 2
MAX_MODES = 12  # of the body's motion, in the regression on the other markers
MIN_TRAINING_FRAMES = 12  # in which the marker and the others are seen
TRAINING_WINDOW = 400  # frames on either side of a gap that the regression uses
# Frames count by the similarity of the body's shape to that in the gap: a squared difference of this share of the mean
# square amplitude halves the weight.
SIMILARITY_SCALE = 0.1
CORRELATION_FRAMES = 2.5  # over which the regression's residuals are correlated
RESIDUAL_WINDOW = 8  # frames on either side of a gap whose residuals are used


def fill_gaps(
    position: Array, sigma: Array, time: Array, longest: int, chosen: NDArray[np.bool_] | None = None
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Fill gaps of up to `longest` frames; longer ones stay NaN.

    All markers ride on one body that moves in a few modes. If others are seen in the gap, the marker is predicted from
    them by a regression trained on the frames around, corrected by the regression's residuals near the gap. If too few
    are seen, a cubic spline through the frames around is used. Sigma grows by the uncertainty of either.

    Args:
        position: [m], (T, M, 3), NaN where missing.
        sigma: [m], (T, M, 3).
        time: [s], (T).
        longest: longest gap to fill [frames].
        chosen: only gaps with such a frame are filled, (T, M); all if None.

    Returns:
        Positions, sigma (T, M, 3) and states (T, M): 0 missing, 1 measured, 2 filled.
    """
    seen = np.isfinite(position[..., 0])
    state = seen.astype(np.uint8)
    filled, grown = position.copy(), sigma.copy()
    for marker in range(position.shape[1]):
        frames = np.flatnonzero(seen[:, marker])
        if len(frames) < 4 or longest == 0 or not (chosen is None or chosen[:, marker].any()):
            continue
        for before, after in itertools.pairwise(frames.tolist()):
            if not 1 < after - before <= longest + 1:
                continue
            if chosen is not None and not chosen[before + 1 : after, marker].any():
                continue
            ends = np.maximum(sigma[before, marker], sigma[after, marker]) ** 2
            gap = np.arange(before + 1, after)
            for part in _split_by_seen(gap, seen):
                bridge = _predict_from_others(position, seen, marker, part)
                if bridge is None:
                    bridge = _interpolate_path(position[:, marker], time, frames, part, before, after)
                filled[part, marker] = bridge[0]
                grown[part, marker] = np.sqrt(np.maximum(bridge[1], 1.5 * ends))
            state[gap, marker] = FILLED
    return filled, grown, state


def refill_gaps(
    position: Array, sigma: Array, state: NDArray[np.uint8], time: Array, longest: int, changed: NDArray[np.bool_]
) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Fill those gaps anew that have, or border on, a measurement that was changed; all else stays.

    Args:
        position: [m], (T, M, 3), NaN where missing.
        sigma: [m], (T, M, 3).
        state: (T, M), in which changed measurements are 0 or 1.
        time: [s], (T).
        longest: longest gap to fill [frames].
        changed: which measurements were changed, (T, M).

    Returns:
        As `fill_gaps`.
    """
    measured = state == MEASURED
    anew = np.zeros_like(measured)
    for marker in np.flatnonzero(changed.any(axis=0)):
        padded = np.r_[True, measured[:, marker], True]
        first = np.flatnonzero(padded[:-1] & ~padded[1:])
        last = np.flatnonzero(~padded[:-1] & padded[1:])
        for begin, end in zip(first.tolist(), last.tolist(), strict=True):
            anew[begin:end, marker] = changed[max(begin - 1, 0) : end + 1, marker].any()
    if not anew.any():
        return position, sigma, state
    known = np.where(measured[..., None], position, np.nan)
    filled, grown, new = fill_gaps(known, sigma, time, longest, anew)
    own = np.flatnonzero(anew.any(axis=0))  # markers with such gaps; copying all arrays anew takes longer than filling
    position, sigma, state = position.copy(), sigma.copy(), state.copy()
    taken = (anew | measured)[:, own]
    found = (new[:, own] > 0)[..., None]
    position[:, own] = np.where(taken[..., None], filled[:, own], position[:, own])
    sigma[:, own] = np.where(taken[..., None], np.where(found, grown[:, own], np.nan), sigma[:, own])
    state[:, own] = np.where(taken, new[:, own], state[:, own])
    return position, sigma, state


def _split_by_seen(gap: NDArray[np.int64], seen: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """The frames of a gap, grouped by which markers are seen in them."""
    groups, group = np.unique(seen[gap], axis=0, return_inverse=True)
    return [gap[group.ravel() == number] for number in range(len(groups))]


def _predict_from_others(
    position: Array, seen: NDArray[np.bool_], marker: int, gap: NDArray[np.int64]
) -> tuple[Array, Array] | None:
    """Positions and variances (G, 3) in a gap from the markers seen in all of it; None if there are too few data."""
    near = np.arange(max(gap[0] - TRAINING_WINDOW, 0), min(gap[-1] + TRAINING_WINDOW, len(position) - 1) + 1)
    others = np.flatnonzero(seen[gap[0]])
    others = others[others != marker]
    others = others[seen[np.ix_(near, others)].mean(axis=0) > 0.7] if len(others) else others
    if len(others) < 3:
        return None
    training = near[seen[near, marker] & seen[np.ix_(near, others)].all(axis=1)]
    if len(training) < MIN_TRAINING_FRAMES:
        return None
    inputs, own = position[np.ix_(training, others)].reshape(len(training), -1), position[training, marker]
    mean = inputs.mean(0)
    _, size, modes = np.linalg.svd(inputs - mean, full_matrices=False)
    count = min(MAX_MODES, len(training) // 3, int((size > 1e-6 * size[0]).sum()))
    basis = modes[:count].T
    amplitudes = (inputs - mean) @ basis
    # Similar shapes count for more, because the relation between the markers is not quite linear.
    here = (position[np.ix_(gap, others)].reshape(len(gap), -1) - mean) @ basis
    difference = ((amplitudes - here.mean(0)) ** 2).sum(1) / (amplitudes**2).sum(1).mean()
    weight = (1.0 / (SIMILARITY_SCALE + difference))[:, None]
    weight *= len(training) / weight.sum()
    ridge = 1e-8 * size[0] ** 2 * np.eye(count)
    own_mean, shift = (weight * own).mean(0), (weight * amplitudes).mean(0)
    centred = amplitudes - shift
    gain = np.linalg.solve(centred.T @ (weight * centred) + ridge, centred.T @ (weight * (own - own_mean)))
    residual = own - own_mean - centred @ gain
    offset, variance = _predict_residual(residual, weight, training, gap, max(len(training) - count, 1))
    return (here - shift) @ gain + own_mean + offset, variance


def _predict_residual(
    residual: Array, weight: Array, frames: NDArray[np.int64], gap: NDArray[np.int64], degrees_of_freedom: int
) -> tuple[Array, Array]:
    """The regression's residual in a gap, and its variance, (G, 3) each, by Gaussian process regression.

    The covariance is that of Matern of order 3/2 for a lasting part, plus white noise. Adjacent frames, which share the
    lasting part, give the two variances.

    Args:
        residual: in other frames, (F, 3).
        weight: of these frames, (F, 1), 1 on average.
        frames: their numbers, (F).
        gap: frame numbers, (G).
        degrees_of_freedom: left in `residual`.
    """
    adjacent = np.flatnonzero(np.diff(frames) == 1)
    pairs = max(degrees_of_freedom * len(adjacent) / len(frames), 1.0)
    square = (weight * residual**2).sum(0) / degrees_of_freedom
    pair_weight = np.sqrt(weight[adjacent] * weight[adjacent + 1])
    shared = (pair_weight * residual[adjacent] * residual[adjacent + 1]).sum(0) / pairs
    lasting = np.clip(shared, 1e-3 * square, square)
    white = np.maximum(square - lasting, 1e-3 * square) + 1e-30
    around = np.flatnonzero((frames >= gap[0] - RESIDUAL_WINDOW) & (frames <= gap[-1] + RESIDUAL_WINDOW))
    if len(around):  # the residuals near the gap may be larger than elsewhere
        lasting = np.maximum(lasting, (residual[around] ** 2).mean(0) - white)
    among_frames, with_gap = _correlation(frames[around], frames[around]), _correlation(gap, frames[around])
    predicted, variance = np.empty((2, len(gap), 3))
    for axis in range(3):
        covariance = lasting[axis] * among_frames + white[axis] * np.eye(len(around))
        weights = np.linalg.solve(covariance, lasting[axis] * with_gap.T)
        predicted[:, axis] = weights.T @ residual[around, axis]
        variance[:, axis] = lasting[axis] * (1.0 - (with_gap.T * weights).sum(axis=0)) + white[axis]
    return predicted, variance


def _correlation(frames: NDArray[np.int64], others: NDArray[np.int64]) -> Array:
    """Matern correlation of the lasting part between frames (F) and others (G), (F, G)."""
    distance = np.sqrt(3.0) * np.abs(frames[:, None] - others) / CORRELATION_FRAMES
    correlation: Array = (1.0 + distance) * np.exp(-distance)
    return correlation


def _interpolate_path(
    path: Array, time: Array, frames: NDArray[np.int64], gap: NDArray[np.int64], before: int, after: int
) -> tuple[Array, Array]:
    """Positions (G, 3) on a cubic spline through the frames around, and their variances (G, 3).

    The sigma is half the distance between the spline and the chord across the gap.
    """
    around = frames[np.abs(frames - 0.5 * (before + after)) < 40]
    around = around if len(around) >= 4 else frames
    curve = CubicSpline(time[around], path[around])(time[gap])
    share = ((time[gap] - time[before]) / (time[after] - time[before]))[:, None]
    chord = (1.0 - share) * path[before] + share * path[after]
    return curve, (0.5 * (curve - chord)) ** 2
