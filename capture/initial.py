"""The first frame: static equilibrium under virtual forces that puts the markers where they were seen."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.markers import Markers
from rafl.simulator import Simulator

Array = NDArray[np.float64]

FORCE_SIGMA = 1.0  # prior standard deviation of a nodal force [N]
LEAST_SIGMA = 2e-5  # markers are not pulled closer than this: the mesh is not the specimen [m]
ITERATIONS = 30
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

    Gauss-Newton on sum |x(q(f)) - target|^2 / sigma^2 + |f|^2, the Jacobian through the equilibrium
    by the implicit-function theorem: dx/df = dx/dq K^-1.

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
    seen = np.isfinite(target).all(axis=1)
    wanted = target[seen].ravel()
    weight = 1.0 / np.maximum(sigma[seen], LEAST_SIGMA).ravel()
    force = np.zeros_like(simulator.mesh.vertices)
    where = f"{what}: first frame"

    def equilibrium(at: Array, start: Array | None) -> Array:
        begin = None if start is None else start[None]
        return simulator.equilibrium((simulator.weight + at)[None], begin, where)[0]

    def gap_of(q: Array) -> Array:
        return markers.positions(torch.from_numpy(q)).numpy()[seen].ravel() - wanted

    def objective(q: Array, at: Array) -> float:
        return float(((weight * gap_of(q)) ** 2).sum() + ((at / FORCE_SIGMA) ** 2).sum())

    q = equilibrium(force, None)
    value = objective(q, force)
    for _ in range(ITERATIONS):
        jacobian = weight[:, None] * _marker_jacobian(simulator, markers, nodes, q, seen)
        system = jacobian.T @ jacobian + np.eye(jacobian.shape[1]) / FORCE_SIGMA**2
        right = jacobian.T @ (weight * gap_of(q)) + force[nodes].ravel() / FORCE_SIGMA**2
        step = -np.linalg.solve(system, right).reshape(-1, 3)
        length = 1.0
        while length > 1e-3:
            trial = force.copy()
            trial[nodes] += length * step
            trial_q = equilibrium(trial, q)
            trial_value = objective(trial_q, trial)
            if trial_value < value:
                break
            length *= 0.5
        else:
            break
        fall = value - trial_value
        q, force, value = trial_q, trial, trial_value
        if fall < CONVERGED * value:
            break
    observed = sigma[seen].ravel() < 10.0 * np.median(sigma[seen])
    residual = float(np.sqrt((gap_of(q)[observed] ** 2).mean() * 3.0))
    return InitialState(q, force, residual)


def _marker_jacobian(
    simulator: Simulator, markers: Markers, nodes: NDArray[np.int64], q: Array, seen: NDArray[np.bool_]
) -> Array:
    """Derivative of the seen markers (3 M') by the forces on the nodes (3 L) [m/N]."""
    by_q = torch.autograd.functional.jacobian(markers.positions, torch.from_numpy(q), vectorize=True).numpy()
    rows = by_q[seen].reshape(-1, *q.shape)  # (3 M', N, 3)
    batch = (np.full(1, value) for value in simulator.material.lame)
    columns = np.moveaxis(rows, 0, -1)[None]
    solved = simulator.tangent_solve(q[None], *batch, np.zeros((1, len(q))), columns)[0]
    return np.moveaxis(solved[nodes], -1, 0).reshape(len(rows), -1)
