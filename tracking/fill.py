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


def fill_gaps(position: Array, sigma: Array, time: Array, longest: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Bridge gaps of up to `longest` frames; longer ones stay NaN.

    All markers ride on one body that moves in a few modes: where others are seen, a marker is put where it
    stood whenever the others stood so, corrected to join its own path at both ends. Where none is
    seen, a cubic through the frames around. Sigma grows by what either way misses on frames that were
    seen, or by half the curve's bend across the gap.

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
            gap = np.arange(before + 1, after)
            base = np.maximum(sigma[before, marker], sigma[after, marker])
            bridge = _as_the_others(position, seen, marker, gap)
            if bridge is None:
                bridge = _along_its_path(position[:, marker], time, frames, before, after)
            filled[gap, marker] = bridge[0]
            grown[gap, marker] = np.sqrt(1.5 * base**2 + bridge[1] ** 2)
            state[gap, marker] = FILLED
    return filled, grown, state


def _as_the_others(
    position: Array, seen: NDArray[np.bool_], marker: int, gap: NDArray[np.int64]
) -> tuple[Array, Array] | None:
    """Positions (G, 3) from the markers seen all through the gap, and what that misses elsewhere (3)."""
    near = np.arange(max(gap[0] - WIDEST, 0), min(gap[-1] + WIDEST, len(position) - 1) + 1)
    others = np.flatnonzero(seen[gap].all(axis=0) & seen[gap[0] - 1] & seen[gap[-1] + 1])
    others = others[others != marker]
    others = others[seen[np.ix_(near, others)].mean(axis=0) > 0.7] if len(others) else others
    if len(others) < 3:
        return None
    taught = near[seen[near, marker] & seen[np.ix_(near, others)].all(axis=1)]
    if len(taught) < FEWEST_FRAMES:
        return None
    inputs = position[np.ix_(taught, others)].reshape(len(taught), -1)
    mean = inputs.mean(0)
    _, size, modes = np.linalg.svd(inputs - mean, full_matrices=False)
    count = min(MODES, len(taught) // 3, int((size > 1e-6 * size[0]).sum()))
    basis = modes[:count].T
    amounts = (inputs - mean) @ basis
    # Where the body was bent alike counts for more: how markers ride on it is not quite linear.
    here = (position[np.ix_(gap, others)].reshape(len(gap), -1) - mean) @ basis
    unlike = ((amounts - here.mean(0)) ** 2).sum(1) / (amounts**2).sum(1).mean()
    weight = (1.0 / (0.05 + unlike))[:, None]
    weight *= len(taught) / weight.sum()
    ridge = 1e-8 * size[0] ** 2 * np.eye(count)
    target_mean = (weight * position[taught, marker]).mean(0)
    shift = (weight * amounts).mean(0)
    centred = amounts - shift
    gain = np.linalg.solve(
        centred.T @ (weight * centred) + ridge, centred.T @ (weight * (position[taught, marker] - target_mean))
    )

    def predicted(frames: NDArray[np.int64]) -> Array:
        own = (position[np.ix_(frames, others)].reshape(len(frames), -1) - mean) @ basis
        return (own - shift) @ gain + target_mean

    squares = weight * (predicted(taught) - position[taught, marker]) ** 2
    missed = np.sqrt(squares.sum(0) / max(len(taught) - count, 1))
    ends = np.array([gap[0] - 1, gap[-1] + 1])
    away = position[ends, marker] - predicted(ends)
    share = ((gap - ends[0]) / (ends[1] - ends[0]))[:, None]
    return predicted(gap) + (1.0 - share) * away[0] + share * away[1], missed


def _along_its_path(
    path: Array, time: Array, frames: NDArray[np.int64], before: int, after: int
) -> tuple[Array, Array]:
    """Positions (G, 3) on a cubic through the frames around, and half its bend across the gap (G, 3)."""
    around = frames[np.abs(frames - 0.5 * (before + after)) < 40]
    around = around if len(around) >= 4 else frames
    gap = np.arange(before + 1, after)
    curve = CubicSpline(time[around], path[around])(time[gap])
    share = ((time[gap] - time[before]) / (time[after] - time[before]))[:, None]
    line = (1.0 - share) * path[before] + share * path[after]
    return curve, 0.5 * np.abs(curve - line)
