"""Line search of Newton's method, compiled: a step of a small body combines hundreds of short arrays, and each NumPy
call would cost as much as the arithmetic of one cell."""

from typing import Any

import numpy as np
from numba import njit

# Without fastmath: sums keep the order in which they are written.
EXACT_KERNEL_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy"}
ENERGY_ROUNDING = 1e-13  # rounding error of an energy, relative to the sum of the magnitudes of its parts


@njit(**EXACT_KERNEL_OPTIONS)
def _copy_values(source, target):
    """Copy an array. Numba compiles an assignment to a row with texts for errors of shape, which take seconds."""
    for i in range(len(target)):
        target[i] = source[i]


@njit(**EXACT_KERNEL_OPTIONS)
def trial_positions(q, rows, free, step, length):
    """Trial positions (P, 3 N) of the trajectories `rows` (P) of q (B, 3 N).

    The unknowns, at indices `free` (n), move by length (P) times step (P, n).
    """
    trial = np.empty((len(rows), q.shape[1]))
    for p in range(len(rows)):
        _copy_values(q[rows[p]], trial[p])
        for k in range(len(free)):
            trial[p, free[k]] += length[p] * step[p, k]
    return trial


@njit(**EXACT_KERNEL_OPTIONS)
def fill_residual(at, gradient, free, inertia, target, force, residual):
    """Fill the residual (n) [N] of one body, and sum its energies [J].

    Args:
        at, gradient: positions [m] and derivative of the elastic energy [N], (3 N).
        free: indices of the unknowns in them, (n).
        inertia, target, force: [kg/s^2], [m], [N], (n).
        residual: output.

    Returns:
        Inertial energy [J], work of the external force [J], and largest residual component [N] or NaN if one is NaN.
    """
    inertial, work, largest, defined = 0.0, 0.0, 0.0, True
    for k in range(len(free)):
        x = at[free[k]]
        gap = x - target[k]
        inertial_force = inertia[k] * gap
        inertial += 0.5 * inertial_force * gap
        work += force[k] * x
        total = gradient[free[k]] + inertial_force - force[k]
        residual[k] = total
        size = abs(total)
        largest = max(largest, size)
        defined = defined and size == size
    return inertial, work, largest if defined else np.nan


@njit(**EXACT_KERNEL_OPTIONS)
def evaluate_start(q, elastic, gradient, free, inertia, target, force, energy, residual, largest):
    """Fill energy (B), residual (B, n) and largest residual (B) at the start q; arguments as of `accept_trials`."""
    for b in range(len(q)):
        inertial, work, size = fill_residual(
            q[b], gradient[b].ravel(), free, inertia[b], target[b], force[b], residual[b]
        )
        energy[b], largest[b] = elastic[b] + inertial - work, size


@njit(**EXACT_KERNEL_OPTIONS)
def accept_trials(
    trial,
    elastic,
    gradient,
    rows,
    reused,
    length,
    slope,
    free,
    inertia,
    target,
    force,
    max_stiffness,
    position_error,
    tolerance,
    factorisation_cost,
    q,
    energy,
    residual,
    largest,
    ready,
):
    """Accept the trial positions that pass the test below; return which trials need a shorter step, (P).

    A step with a reused factor passes if it halves the residual and does not raise the energy. If it fails, its factor
    is discarded. A step with a new factor passes if the energy falls sufficiently (Armijo condition); if it fails, it
    is tried again with another length. Near the minimum, energies differ by rounding only, so there a step with a new
    factor also passes if it lowers the residual. A factor is kept if, at the present rate of convergence, the remaining
    steps cost less than a new factorisation.

    Args:
        trial, elastic, gradient: positions (P, 3 N), their elastic energy (P) and its derivative (P, N, 3).
        rows: indices of the tried trajectories in the batch, (P).
        reused: whether the step used the factor of an earlier step, (P).
        length, slope: fraction of the full step, and derivative of the energy along it [J], (P).
        free: indices of the unknowns, (n).
        inertia, target, force: [kg/s^2], [m], [N], (B, n).
        max_stiffness: bound on the stiffness [N/m], (B).
        position_error: rounding error of positions [m], (B).
        tolerance: residual at which a trajectory has converged [N], (B).
        factorisation_cost: number of steps with a reused factor that cost as much as a new factor.
        q, energy, residual, largest, ready: state of the batch; updated for each accepted trial.
    """
    again = np.zeros(len(rows), dtype=np.bool_)
    own = np.empty(len(free))
    for p in range(len(rows)):
        b = rows[p]
        inertial, work, size = fill_residual(trial[p], gradient[p].ravel(), free, inertia[b], target[b], force[b], own)
        total = elastic[p] + inertial - work
        parts = abs(elastic[p]) + inertial + abs(work)
        slack = ENERGY_ROUNDING * parts + 10.0 * position_error[b] * np.sqrt(max_stiffness[b] * parts)
        not_raised = total <= energy[b] + slack
        if reused[p]:
            accepted = not_raised and size <= 0.5 * largest[b]
        else:
            accepted = total <= energy[b] + 1e-4 * length[p] * slope[p] or (not_raised and size < largest[b])
        if accepted:
            shrinking = min(max(size / largest[b], 1e-300), 1.0)
            ready[b] = np.log(max(size / tolerance[b], 1.0)) <= -factorisation_cost * np.log(shrinking)
            _copy_values(trial[p], q[b])
            energy[b], largest[b] = total, size
            _copy_values(own, residual[b])
        else:
            again[p] = not reused[p]
            ready[b] = ready[b] and not reused[p]
    return again
