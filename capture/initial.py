"""The first frame: static equilibrium under virtual forces that puts the markers where they were seen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.errors import SimulationError
from rafl.markers import Markers
from rafl.simulator import Simulator

Array = NDArray[Any]

# Prior standard deviations of a nodal force [N]: of the part that varies linearly over the loaded
# nodes (a pull and a moment), and of the rest, which would dent the mesh to please single markers.
LINEAR_SIGMA, LOCAL_SIGMA = 1.0, 0.05
LEAST_SIGMA = 5e-5  # markers are not pulled closer than this: the mesh is not the specimen [m]
FIRST_DAMPING, LAST_DAMPING = 1e2, 1e8  # of a step, as a multiple of the prior
CONVERGED = 1e-6  # relative fall of the objective


@dataclass(frozen=True)
class InitialState:
    """Where the mesh was in the first frame.

    Attributes:
        q: [m], (N, 3).
        force: virtual nodal forces, gravity excepted [N], (N, 3).
        residual: root mean square marker distance over the observed axes [m].
    """

    q: Array
    force: Array
    residual: float


def fit_first_frame(
    simulator: Simulator, markers: Markers, nodes: NDArray[np.int64], target: Array, sigma: Array, what: str
) -> InitialState:
    """Virtual forces on some nodes such that the equilibrium's markers match the first frame.

    Levenberg-Marquardt on sum |x(q(f)) - target|^2 / sigma^2 + f . C^-1 f with C the prior of the forces;
    the Jacobian through the equilibrium is the implicit-function theorem's, dx/df = dx/dq K^-1.

    Args:
        simulator: of the specimen.
        markers: tied to its mesh.
        nodes: that forces act on, (L).
        target: markers of the first frame [m], (M, 3), NaN where not seen.
        sigma: their standard deviation [m], (M, 3).
        what: recording, for messages.

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    seen = np.isfinite(target[:, 0])
    wanted = target[seen].ravel()
    weight = 1.0 / np.maximum(sigma[seen], LEAST_SIGMA).ravel()
    force = np.zeros_like(simulator.mesh.vertices)
    precision = _force_precision(simulator.mesh.vertices[nodes])
    where = f"{what}: first frame"

    def equilibrium(at: Array, start: Array | None) -> Array:
        begin = None if start is None else start[None]
        return simulator.equilibrium((simulator.weight + at)[None], begin, where)[0]

    def gap_of(q: Array) -> Array:
        return markers.positions(torch.from_numpy(q)).numpy()[seen].ravel() - wanted

    def objective(q: Array, at: Array) -> float:
        return float(((weight * gap_of(q)) ** 2).sum() + (at[nodes] * (precision @ at[nodes])).sum())

    q = equilibrium(force, None)
    value = objective(q, force)
    damping = FIRST_DAMPING
    prior = np.kron(precision, np.eye(3))
    while True:
        jacobian = weight[:, None] * _marker_jacobian(simulator, markers, nodes, q, seen)
        system = jacobian.T @ jacobian + prior
        right = jacobian.T @ (weight * gap_of(q)) + prior @ force[nodes].ravel()
        fall = -np.inf
        while fall <= 0.0 and damping <= LAST_DAMPING:
            trial = force.copy()
            trial[nodes] -= np.linalg.solve(system + damping * prior, right).reshape(-1, 3)
            try:
                trial_q = equilibrium(trial, q)
            except SimulationError:  # too far at once: damped more, the next trial is nearer
                fall = -np.inf
            else:
                fall = value - objective(trial_q, trial)
            damping *= 0.1 if fall > 0.0 else 10.0
        if fall <= 0.0:
            break
        q, force, value = trial_q, trial, value - fall
        if damping < 1.0 and fall < CONVERGED * value:
            break
    observed = sigma[seen].ravel() < 10.0 * np.median(sigma[seen])
    residual = float(np.sqrt((gap_of(q)[observed] ** 2).mean() * 3.0))
    return InitialState(q, force, residual)


def _force_precision(places: Array) -> Array:
    """Inverse prior covariance of one component of the forces on nodes at `places` (L, 3), (L, L)."""
    modes = np.column_stack([np.ones(len(places)), (places - places.mean(0)) / np.ptp(places, axis=0).max()])
    u, s, _ = np.linalg.svd(modes, full_matrices=False)
    u = u[:, s > 1e-9 * s[0]]
    linear = u @ u.T
    return linear / LINEAR_SIGMA**2 + (np.eye(len(places)) - linear) / LOCAL_SIGMA**2


def _marker_jacobian(
    simulator: Simulator, markers: Markers, nodes: NDArray[np.int64], q: Array, seen: NDArray[np.bool_]
) -> Array:
    """Derivative of the seen markers (3 M') by the forces on the nodes (3 L) [m/N]."""
    by_q = torch.autograd.functional.jacobian(markers.positions, torch.from_numpy(q), vectorize=True).numpy()
    rows = by_q[seen].reshape(-1, *q.shape)  # (3 M', N, 3)
    solved = simulator.solve_tangent(q[None], np.moveaxis(rows, 0, -1)[None])[0]
    return np.moveaxis(solved[nodes], -1, 0).reshape(len(rows), -1)
