"""Residual forces that recordings call for, step by step (paper, eq. 4): what supervised learning learns."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from rafl.common.command_line import progress
from rafl.common.errors import SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.fitting.run_folder import FORMAT, load_tensors, save_tensors, understood
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS, State

Array = NDArray[Any]

PENALTY = 1e-4  # lambda_1 of the targets that are learned from [m^2/N^2]
MOST_ITERATIONS = 12
ENOUGH = 1e-8  # gain, as a share of a step's objective, that ends the iteration


@dataclass(frozen=True)
class Targets:
    """States of some recordings simulated with the forces that follow the markers best, and those forces.

    Attributes:
        q, v: at the start of each step [m], [m/s], (T - 1, B, N, 3).
        force: [N], (T - 1, B, N, 3).
        objective: of each step, sum |x - x_bar|^2 + penalty sum f^2 [m^2], (T - 1, B).
    """

    q: Array
    v: Array
    force: Array
    objective: Array


def residual_targets(
    recordings: Recordings, penalty: float, tick: Callable[[], None] = lambda: None, enough: float = ENOUGH
) -> Targets:
    """Solve eq. 4 for every step in turn, by Gauss and Newton's method.

    The step's adjoint gives all of the markers' derivatives by the force at once; within a step they hardly change
    and are computed once.

    Args:
        recordings: of one dataset, whose simulator steps by plain backward differences.
        penalty: lambda_1 [m^2/N^2].
        tick: called after every step.
        enough: gain, as a share of a step's objective, that ends its iteration.

    Raises:
        SimulationError: a step failed; names recordings and step.
    """
    dataset = recordings.dataset
    simulator = dataset.simulator
    if not can_be_followed(simulator):
        raise SimulationError(
            f"{dataset.name}: expected implicit-euler, one substep and no viscous damping for residual targets, found "
            f"{simulator.integrator}, {simulator.substeps} substeps; fit another method"
        )
    start = dataset.start(recordings.names)
    q, v = start.q.numpy().copy(), start.v.numpy().copy()
    external = start.force.numpy() + simulator.weight
    mass = simulator.node_mass + start.added_mass.numpy()
    force = np.zeros_like(q)
    parts: list[tuple[Array, Array, Array, Array]] = []
    for step in range(1, len(recordings.markers)):
        problem = _Step(recordings, step, q, v, external, mass, penalty, enough)
        after, force, objective = problem.solve(force)
        parts.append((q, v, force, objective))
        q, v = after, (after - q) / simulator.time_step
        tick()
    return Targets(*(np.stack(part) for part in zip(*parts, strict=True)))


def can_be_followed(simulator: Simulator) -> bool:
    """Whether residual targets can be solved for: steps by plain backward differences, no viscous damping."""
    return simulator.integrator == "implicit-euler" and simulator.substeps == 1 and not simulator.parameters().damped


def training_targets(
    dataset: Dataset, path: Path, most: int | None = None, enough: float = ENOUGH
) -> tuple[Tensor, Tensor, Tensor]:
    """States q, v at the start of all training recordings' steps and the residual forces that follow, all (S, N, 3).

    Args:
        dataset: with training recordings.
        path: keeps them; where it exists it is read.
        most: how many markers, drawn at random but always the same, are followed; all unless given.
        enough: as of `residual_targets`.

    Raises:
        SimulationError: the recordings cannot be followed.
    """
    if not path.exists():
        recordings = Recordings.of(dataset, dataset.split("train"))
        if most is not None and len(dataset.markers.names) > most:
            chosen = np.random.default_rng(0).choice(len(dataset.markers.names), most, replace=False)
            recordings = recordings.of_markers(np.sort(chosen))
        with progress() as bar:
            task = bar.add_task(f"{dataset.name}: residual forces", total=len(recordings.markers) - 1)
            targets = residual_targets(recordings, PENALTY, lambda: bar.advance(task), enough)
        shown = recordings.valid[1:].amax(-1).bool()
        content = {key: torch.from_numpy(getattr(targets, key))[shown] for key in ("q", "v", "force")}
        save_tensors(path, {"format": FORMAT, "method": "residual forces", **content})
    saved = load_tensors(path, "residual forces of this run")
    with understood("residual forces of this run", path):
        return saved["q"], saved["v"], saved["force"]


@dataclass(frozen=True)
class _Step:
    """The `number`th step of some recordings from states q, v, and how to follow the markers in it."""

    recordings: Recordings
    number: int
    q: Array
    v: Array
    external: Array
    mass: Array
    penalty: float
    enough: float

    @property
    def simulator(self) -> Simulator:
        return self.recordings.dataset.simulator

    def solve(self, force: Array) -> tuple[Array, Array, Array]:
        """Positions after the step, the force, and the objective (B), starting at the last step's force."""
        x = self._after(force, None)
        gap, objective = self._judge(x, force)
        seen = np.repeat(self.recordings.valid[self.number].numpy(), 3, axis=1)
        slopes = self._slopes(x) * seen[..., None]
        across = slopes.swapaxes(1, 2)
        normal = [cho_factor(a @ a.T + self.penalty * np.eye(len(a)), check_finite=False) for a in slopes]
        free = self.simulator.engine.free_index
        for _ in range(MOST_ITERATIONS):
            flat = force.reshape(len(force), -1)[:, free]
            right = (slopes @ flat[..., None])[..., 0] - gap
            weights = np.stack([cho_solve(a, b, check_finite=False) for a, b in zip(normal, right, strict=True)])
            best = (across @ weights[..., None])[..., 0]
            trial = force.copy()
            trial.reshape(len(force), -1)[:, free] = best
            moved = self._after(trial, x)
            new_gap, new_objective = self._judge(moved, trial)
            better: Array = new_objective < objective
            gain = float(((objective - new_objective) / np.maximum(objective, 1e-30))[better].max(initial=0.0))
            keep = better[:, None, None]
            force, x = np.where(keep, trial, force), np.where(keep, moved, x)
            gap[better], objective[better] = new_gap[better], new_objective[better]
            if gain < self.enough:
                break
        return x, force, objective

    def _after(self, force: Array, guess: Array | None) -> Array:
        inertia, target = self._inertia
        begin = self.q + self.simulator.time_step * self.v if guess is None else guess.copy()
        begin[:, self.simulator.fixed] = self.q[:, self.simulator.fixed]
        what = f"step {self.number} of {', '.join(self.recordings.names)}"
        resistance = self.simulator.resistance(len(self.q))
        return self.simulator.minimise(begin, inertia, target, self.external + force, resistance, what)

    @cached_property
    def _inertia(self) -> tuple[Array, Array]:
        """Inertia (B, N) [kg/s^2] and where it draws the nodes, (B, N, 3) [m]."""
        q, v, mass = (torch.from_numpy(x) for x in (self.q, self.v, self.mass))
        damping = torch.full((len(q), 1), self.simulator.material.mass_damping, dtype=torch.float64)
        state = State(q, v, torch.zeros_like(q))
        problem = INTEGRATORS[self.simulator.integrator].problem(state, mass, damping, self.simulator.time_step)
        return problem.inertia.numpy(), problem.target.numpy()

    def _judge(self, x: Array, force: Array) -> tuple[Array, Array]:
        """Marker gaps (B, 3 M) [m], nought where not seen, and the objective (B)."""
        markers = self.recordings.dataset.markers.positions(torch.from_numpy(x))
        gap = (markers - self.recordings.markers[self.number]) * self.recordings.valid[self.number][..., None]
        flat = gap.flatten(1).numpy()
        return flat, (flat**2).sum(1) + self.penalty * (force**2).sum((1, 2))

    def _slopes(self, x: Array) -> Array:
        """Derivatives of the markers by the forces on free nodes [m/N], (B, 3 M, n)."""
        engine, batch = self.simulator.engine, len(x)
        by_corner = self.recordings.dataset.markers.slopes(torch.from_numpy(x)).numpy()  # (B, M, 3, 4, 3)
        quad = self.recordings.dataset.markers.quad
        count = len(quad)
        right = np.zeros((batch, count, 3, x.shape[1], 3))
        for corner in range(4):
            right[:, np.arange(count), :, quad[:, corner]] += by_corner[:, :, :, corner].swapaxes(0, 1)
        diagonal = np.repeat(self._inertia[0], 3, axis=1)[:, engine.free_index]
        with engine.threads(batch):
            tangents = engine.terms(x, self.simulator.resistance(batch), tangent=True)[2]
            columns = np.ascontiguousarray(right.reshape(batch, 3 * count, -1)[:, :, engine.free_index])
            return engine.solve_once(tangents, diagonal, columns)
