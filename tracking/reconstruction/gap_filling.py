"""Bridging gaps: markers out of sight for a few frames."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[Any]

MISSING, MEASURED, FILLED = 0, 1, 2
MODES = 12  # of the body's motion that a gap is filled from
FEWEST_FRAMES = 12  # seen, before a marker is said to move as others do
WIDEST = 400  # frames on either side of a gap that are learned from
ALIKE = 0.1  # of the motion's mean square: frames in which the body was bent as unlike as that count for half
# What the others do not tell of a marker's path is alike over so many frames, and is asked of so many around a gap.
LASTING, AROUND = 2.5, 8


def fill_gaps(position: Array, sigma: Array, time: Array, longest: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Bridge gaps of up to `longest` frames; longer ones stay NaN.

    All markers ride on one body that moves in a few modes: where others are seen, a marker is put where it
    stood whenever the others stood so, and nearer to its own path by what that misses in the frames around. Where none
    is seen, a cubic through the frames around. Sigma grows by how far off either way may be.

    Args:
        position: [m], (T, M, 3), NaN where missing.
        sigma: [m], (T, M, 3).
        time: [s], (T).
        longest: gap that is bridged [frames].

    Returns:
        Positions, sigma (T, M, 3) and states (T, M): 0 missing, 1 measured, 2 filled.
    """
    seen = np.isfinite(position[..., 0])
    state = seen.astype(np.uint8)
    filled, grown = position.copy(), sigma.copy()
    for marker in range(position.shape[1]):
        frames = np.flatnonzero(seen[:, marker])
        if len(frames) < 4 or longest == 0:
            continue
        for before, after in itertools.pairwise(frames.tolist()):
            if not 1 < after - before <= longest + 1:
                continue
            ends = np.maximum(sigma[before, marker], sigma[after, marker]) ** 2
            whole = np.arange(before + 1, after)
            for gap in _by_who_is_seen(whole, seen):
                bridge = _as_the_others(position, seen, marker, gap)
                if bridge is None:
                    bridge = _along_its_path(position[:, marker], time, frames, gap, before, after)
                filled[gap, marker] = bridge[0]
                grown[gap, marker] = np.sqrt(np.maximum(bridge[1], 1.5 * ends))
            state[whole, marker] = FILLED
    return filled, grown, state


def _by_who_is_seen(gap: NDArray[np.int64], seen: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """The frames of a gap, those together in which the same markers are seen."""
    kinds, kind = np.unique(seen[gap], axis=0, return_inverse=True)
    return [gap[kind.ravel() == number] for number in range(len(kinds))]


def _as_the_others(
    position: Array, seen: NDArray[np.bool_], marker: int, gap: NDArray[np.int64]
) -> tuple[Array, Array] | None:
    """Positions and variances (G, 3) from the markers seen in a gap, the same in all of it; None where few are."""
    near = np.arange(max(gap[0] - WIDEST, 0), min(gap[-1] + WIDEST, len(position) - 1) + 1)
    others = np.flatnonzero(seen[gap[0]])
    others = others[others != marker]
    others = others[seen[np.ix_(near, others)].mean(axis=0) > 0.7] if len(others) else others
    if len(others) < 3:
        return None
    taught = near[seen[near, marker] & seen[np.ix_(near, others)].all(axis=1)]
    if len(taught) < FEWEST_FRAMES:
        return None
    inputs, own = position[np.ix_(taught, others)].reshape(len(taught), -1), position[taught, marker]
    mean = inputs.mean(0)
    _, size, modes = np.linalg.svd(inputs - mean, full_matrices=False)
    count = min(MODES, len(taught) // 3, int((size > 1e-6 * size[0]).sum()))
    basis = modes[:count].T
    amounts = (inputs - mean) @ basis
    # Where the body was bent alike counts for more: how markers ride on it is not quite linear.
    here = (position[np.ix_(gap, others)].reshape(len(gap), -1) - mean) @ basis
    unlike = ((amounts - here.mean(0)) ** 2).sum(1) / (amounts**2).sum(1).mean()
    weight = (1.0 / (ALIKE + unlike))[:, None]
    weight *= len(taught) / weight.sum()
    ridge = 1e-8 * size[0] ** 2 * np.eye(count)
    own_mean, shift = (weight * own).mean(0), (weight * amounts).mean(0)
    centred = amounts - shift
    gain = np.linalg.solve(centred.T @ (weight * centred) + ridge, centred.T @ (weight * (own - own_mean)))
    away = own - own_mean - centred @ gain
    missed, variance = _what_they_miss(away, weight, taught, gap, max(len(taught) - count, 1))
    return (here - shift) @ gain + own_mean + missed, variance


def _what_they_miss(
    away: Array, weight: Array, frames: NDArray[np.int64], gap: NDArray[np.int64], free: int
) -> tuple[Array, Array]:
    """Likeliest of what the others miss of a path in a gap, and how uncertain that is: its variance, (G, 3) each.

    A Gaussian process with Matern's covariance of order 3/2: a part that lasts and a part that each frame has anew,
    told apart by what frames side by side share.

    Args:
        away: what they miss in other frames, (F, 3).
        weight: how much these frames count, (F, 1), 1 on the average.
        frames: which these are, (F).
        gap: (G).
        free: degrees of freedom left in `away`.
    """
    beside = np.flatnonzero(np.diff(frames) == 1)
    pairs = max(free * len(beside) / len(frames), 1.0)
    square = (weight * away**2).sum(0) / free
    shared = (np.sqrt(weight[beside] * weight[beside + 1]) * away[beside] * away[beside + 1]).sum(0) / pairs
    lasting = np.clip(shared, 1e-3 * square, square)
    anew = np.maximum(square - lasting, 1e-3 * square) + 1e-30
    around = np.flatnonzero((frames >= gap[0] - AROUND) & (frames <= gap[-1] + AROUND))
    if len(around):  # the body may be where they miss more than elsewhere
        lasting = np.maximum(lasting, (away[around] ** 2).mean(0) - anew)
    of_all, of_gap = _alike(frames[around], frames[around]), _alike(gap, frames[around])
    missed, variance = np.empty((2, len(gap), 3))
    for axis in range(3):
        covariance = lasting[axis] * of_all + anew[axis] * np.eye(len(around))
        told = np.linalg.solve(covariance, lasting[axis] * of_gap.T)
        missed[:, axis] = told.T @ away[around, axis]
        variance[:, axis] = lasting[axis] * (1.0 - (of_gap.T * told).sum(axis=0)) + anew[axis]
    return missed, variance


def _alike(frames: NDArray[np.int64], others: NDArray[np.int64]) -> Array:
    """Correlation of what lasts between frames (F) and others (G), (F, G)."""
    apart = np.sqrt(3.0) * np.abs(frames[:, None] - others) / LASTING
    return (1.0 + apart) * np.exp(-apart)


def _along_its_path(
    path: Array, time: Array, frames: NDArray[np.int64], gap: NDArray[np.int64], before: int, after: int
) -> tuple[Array, Array]:
    """Positions (G, 3) on a cubic through the frames around, and the square of half its bend across the gap (G, 3)."""
    around = frames[np.abs(frames - 0.5 * (before + after)) < 40]
    around = around if len(around) >= 4 else frames
    curve = CubicSpline(time[around], path[around])(time[gap])
    share = ((time[gap] - time[before]) / (time[after] - time[before]))[:, None]
    line = (1.0 - share) * path[before] + share * path[after]
    return curve, (0.5 * (curve - line)) ** 2
