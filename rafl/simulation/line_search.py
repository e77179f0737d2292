"""The bookkeeping of Newton's method between its large terms, compiled: a small body's step has hundreds of short
arrays to combine, and each call of NumPy would cost as much as a cell's arithmetic."""

from typing import Any

import numpy as np
from numba import njit

PLAIN: dict[str, Any] = {"cache": True, "error_model": "numpy"}  # sums exactly as they are written
LEVEL = 1e-13  # of the energy's parts, what two equal energies may differ by


@njit(**PLAIN)
def moved(q, rows, free, step, length):
    """Positions (P, 3 N) of q (B, 3 N) at `rows` (P), their free places (n) moved by length (P) times step (P, n)."""
    trial = np.empty((len(rows), q.shape[1]))
    for p in range(len(rows)):
        trial[p] = q[rows[p]]
        for k in range(len(free)):
            trial[p, free[k]] += length[p] * step[p, k]
    return trial


@njit(**PLAIN)
def balance(at, gradient, free, inertia, target, force, residual):
    """Fill one body's residual (n) [N]; its inertial energy, the forces' work [J] and the largest residual [N].

    Args:
        at, gradient: positions [m] and derivative of the elastic energy [N], (3 N).
        free: places of the unknowns in them, (n).
        inertia, target, force: [kg/s^2], [m], [N], (n).
        residual: output.
    """
    inertial, work, largest, defined = 0.0, 0.0, 0.0, True
    for k in range(len(free)):
        x = at[free[k]]
        gap = x - target[k]
        pull = inertia[k] * gap
        inertial += 0.5 * pull * gap
        work += force[k] * x
        total = gradient[free[k]] + pull - force[k]
        residual[k] = total
        size = abs(total)
        largest = max(largest, size)
        defined = defined and size == size
    return inertial, work, largest if defined else np.nan


@njit(**PLAIN)
def begin(q, elastic, gradient, free, inertia, target, force, energy, residual, largest):
    """Fill the energy (B), residual (B, n) and largest residual (B) of a batch where it is; arguments as of `judge`."""
    for b in range(len(q)):
        inertial, work, size = balance(q[b], gradient[b].ravel(), free, inertia[b], target[b], force[b], residual[b])
        energy[b], largest[b] = elastic[b] + inertial - work, size


@njit(**PLAIN)
def judge(
    trial,
    elastic,
    gradient,
    rows,
    old,
    length,
    slope,
    free,
    inertia,
    target,
    force,
    stiffest,
    reach,
    enough,
    patience,
    q,
    energy,
    residual,
    largest,
    ready,
):
    """Take over the trials that are good enough; which are to be tried again, (P).

    A step by an old factor is good when it halves the residual and does not raise the energy; if it is not, the factor
    is given up. One by a new factor is good when the energy falls by enough, and is to be tried again with another
    length when it does not. Close to the minimum energies differ by rounding only: the residual decides there. A factor
    is kept where at this pace the rest takes fewer steps than a new one costs.

    Args:
        trial, elastic, gradient: positions (P, 3 N), their elastic energy (P) and its derivative (P, N, 3).
        rows: of the batch, that are tried, (P).
        old: whether by the factor of an earlier step, (P).
        length, slope: of their steps, share of a whole one and derivative of the energy [J], (P).
        free: places of the unknowns, (n).
        inertia, target, force: (B, n).
        stiffest, reach, enough: [N/m], [m], [N], (B).
        patience: how many steps cost as much as a factor.
        q, energy, residual, largest, ready: where each body is; changed where a trial is taken over.
    """
    again = np.zeros(len(rows), dtype=np.bool_)
    own = np.empty(len(free))
    for p in range(len(rows)):
        b = rows[p]
        inertial, work, size = balance(trial[p], gradient[p].ravel(), free, inertia[b], target[b], force[b], own)
        total = elastic[p] + inertial - work
        parts = abs(elastic[p]) + inertial + abs(work)
        slack = LEVEL * parts + 10.0 * reach[b] * np.sqrt(stiffest[b] * parts)
        level = total <= energy[b] + slack
        if old[p]:
            good = level and size <= 0.5 * largest[b]
        else:
            good = total <= energy[b] + 1e-4 * length[p] * slope[p] or (level and size < largest[b])
        if good:
            shrinking = min(max(size / largest[b], 1e-300), 1.0)
            ready[b] = np.log(max(size / enough[b], 1.0)) <= -patience * np.log(shrinking)
            q[b] = trial[p]
            energy[b], largest[b] = total, size
            residual[b] = own
        else:
            again[p] = not old[p]
            ready[b] = ready[b] and not old[p]
    return again
