"""Residual targets: the residual forces that make each step follow the recorded markers (paper, eq. 4)."""

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

from rafl.common.arrays import ArrayFormat, check_shape, check_values
from rafl.common.command_line import progress
from rafl.common.errors import SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.fitting.run_folder import FORMAT, expect_content, load_tensors, save_tensors
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS, State

Array = NDArray[Any]

FORCE_PENALTY = 1e-4  # lambda_1 of the targets that models are trained on [m^2/N^2]
MAX_ITERATIONS = 12
MIN_RELATIVE_GAIN = 1e-8  # the iteration ends when its gain is below this fraction of a step's objective


@dataclass(frozen=True)
class ResidualTargets:
    """Residual forces of every step, and the states of the simulation that they drive.

    Attributes:
        q, v: positions [m] and velocities [m/s] at the start of each step, (T - 1, B, N, 3).
        force: residual forces [N], (T - 1, B, N, 3).
        objective: of each step, sum |x - x_bar|^2 + penalty sum f^2 [m^2], (T - 1, B).
    """

    q: Array
    v: Array
    force: Array
    objective: Array


def residual_targets(
    recordings: Recordings,
    penalty: float,
    on_step: Callable[[], None] = lambda: None,
    min_gain: float = MIN_RELATIVE_GAIN,
) -> ResidualTargets:
    """Solve eq. 4 for each step in turn by the Gauss-Newton method.

    The adjoint of a step gives the derivatives of all markers with respect to the force. They hardly change within a
    step and are computed once.

    Args:
        recordings: of one dataset, whose simulator supports residual targets.
        penalty: lambda_1 [m^2/N^2].
        on_step: called after every step.
        min_gain: the iteration of a step ends when its gain is below this fraction of the objective.

    Raises:
        SimulationError: the simulator does not support residual targets, or a step failed; names recording and step.
    """
    dataset = recordings.dataset
    simulator = dataset.simulator
    if not supports_residual_targets(simulator):
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
        fit = _StepFit(recordings, step, q, v, external, mass, penalty, min_gain)
        after, force, objective = fit.solve(force)
        parts.append((q, v, force, objective))
        q, v = after, (after - q) / simulator.time_step
        on_step()
    return ResidualTargets(*(np.stack(part) for part in zip(*parts, strict=True)))


def supports_residual_targets(simulator: Simulator) -> bool:
    """Whether residual targets can be computed: backward differences, one substep, no viscous damping."""
    return simulator.integrator == "implicit-euler" and simulator.substeps == 1 and not simulator.parameters().damped


def compute_targets(
    dataset: Dataset,
    path: Path,
    max_markers: int | None = None,
    min_gain: float = MIN_RELATIVE_GAIN,
    group: ProcessGroup = ALONE,
) -> None:
    """Write the residual targets of the training recordings to a file, unless it exists.

    Args:
        dataset: with training recordings.
        path: file of the results.
        max_markers: largest number of markers to follow, drawn with a fixed seed; None for all.
        min_gain: see `residual_targets`.
        group: processes that share the recordings.

    Raises:
        SimulationError: the targets cannot be computed.
    """
    if group.on_main(path.exists):
        return
    recordings = Recordings.of(dataset, dataset.split("train"))
    if max_markers is not None and len(dataset.markers.names) > max_markers:
        chosen = np.random.default_rng(0).choice(len(dataset.markers.names), max_markers, replace=False)
        recordings = recordings.select_markers(np.sort(chosen))
    steps, own = len(recordings.markers) - 1, group.share(range(len(recordings.names)))
    shape = (steps, len(recordings.names), len(dataset.simulator.mesh.vertices), 3)
    gathered = {key: torch.zeros(shape, dtype=torch.float64) for key in ("q", "v", "force")}
    with group.fail_together(), progress(group.is_main) as bar:
        if own:
            task = bar.add_task(f"{dataset.name}: residual targets", total=steps)
            part = recordings.select(own)
            targets = residual_targets(part, FORCE_PENALTY, lambda: bar.advance(task), min_gain)
            for key, values in gathered.items():
                values[:, own] = torch.from_numpy(getattr(targets, key))
    observed = recordings.observed[1:].amax(-1).bool()
    for values in gathered.values():
        group.sum_over_processes([values])
    if group.is_main:
        content = {key: values[observed] for key, values in gathered.items()}
        save_tensors(path, {"format": FORMAT, "method": "residual forces", **content})


def read_targets(dataset: Dataset, path: Path) -> tuple[Tensor, Tensor, Tensor]:
    """States q, v at the start of the training recordings' steps, and their residual targets, all (S, N, 3).

    Args:
        dataset: as in `compute_targets`.
        path: file that it wrote.

    Raises:
        InputError: the file is damaged, or holds other contents.
    """
    saved = load_tensors(path, "residual targets of this run")
    with expect_content("residual targets of this run", path):
        count = len(saved["q"])
        for key in ("q", "v", "force"):
            expected = ArrayFormat((count, len(dataset.simulator.mesh.vertices), 3))
            check_shape(key, saved[key].numpy(), expected, {})
            check_values(key, saved[key].numpy(), expected)
        return saved["q"], saved["v"], saved["force"]


@dataclass(frozen=True)
class _StepFit:
    """Fit of the residual force in one step of some recordings.

    Attributes:
        recordings: B recordings to follow.
        number: of the step; it ends at this frame.
        q, v: state at the start of the step [m], [m/s], (B, N, 3).
        external: load and weight [N], (B, N, 3).
        mass: of the nodes [kg], (B, N).
        penalty: lambda_1 [m^2/N^2].
        min_gain: see `residual_targets`.
    """

    recordings: Recordings
    number: int
    q: Array
    v: Array
    external: Array
    mass: Array
    penalty: float
    min_gain: float

    @property
    def simulator(self) -> Simulator:
        return self.recordings.dataset.simulator

    def solve(self, force: Array) -> tuple[Array, Array, Array]:
        """Positions after the step, the force, and the objective (B); starts from `force`, that of the last step.

        The iteration of each recording ends on its own, so that it does not depend on the others.
        """
        x = self._simulate(force, None)
        gap, objective = self._gap_and_objective(x, force)
        jacobian = self._force_jacobian(x)
        by_marker = self._seen @ jacobian.reshape(*self._seen.shape[:3], -1)
        jacobian = by_marker.reshape(jacobian.shape)
        transposed = jacobian.swapaxes(1, 2)
        normal = [cho_factor(a @ a.T + self.penalty * np.eye(len(a)), check_finite=False) for a in jacobian]
        free = self.simulator.engine.free_index
        running = np.ones(len(force), dtype=bool)
        for _ in range(MAX_ITERATIONS):
            flat = force.reshape(len(force), -1)[:, free]
            right = (jacobian @ flat[..., None])[..., 0] - gap
            weights = np.stack([cho_solve(a, b, check_finite=False) for a, b in zip(normal, right, strict=True)])
            minimiser = (transposed @ weights[..., None])[..., 0]
            trial = force.copy()
            trial.reshape(len(force), -1)[:, free] = minimiser
            new_x = self._simulate(trial, x)
            new_gap, new_objective = self._gap_and_objective(new_x, trial)
            better: Array = running & (new_objective < objective)
            gain = np.where(better, (objective - new_objective) / np.maximum(objective, 1e-30), 0.0)
            keep = better[:, None, None]
            force, x = np.where(keep, trial, force), np.where(keep, new_x, x)
            gap[better], objective[better] = new_gap[better], new_objective[better]
            running &= gain >= self.min_gain
            if not running.any():
                break
        return x, force, objective

    def _simulate(self, force: Array, guess: Array | None) -> Array:
        """Positions after the step [m], (B, N, 3), under residual forces (B, N, 3) [N]."""
        inertia, target = self._inertia
        begin = self.q + self.simulator.time_step * self.v if guess is None else guess.copy()
        begin[:, self.simulator.fixed] = self.q[:, self.simulator.fixed]
        label = f"step {self.number} of {', '.join(self.recordings.names)}"
        state = self.simulator.constitutive_state(len(self.q))
        return self.simulator.minimise(begin, inertia, target, self.external + force, state, label)

    @cached_property
    def _seen(self) -> Array:
        """Projections onto the directions in which each marker was measured, (B, M, 3, 3)."""
        return self.recordings.seen_directions(self.number).numpy()

    @cached_property
    def _inertia(self) -> tuple[Array, Array]:
        """Inertia (B, N) [kg/s^2] and the inertial target positions (B, N, 3) [m]."""
        q, v, mass = (torch.from_numpy(x) for x in (self.q, self.v, self.mass))
        damping = torch.full((len(q), 1), self.simulator.material.mass_damping, dtype=torch.float64)
        state = State(q, v, torch.zeros_like(q))
        problem = INTEGRATORS[self.simulator.integrator].problem(state, mass, damping, self.simulator.time_step)
        return problem.inertia.numpy(), problem.target.numpy()

    def _gap_and_objective(self, x: Array, force: Array) -> tuple[Array, Array]:
        """Marker gaps (B, 3 M) [m] in the directions that were measured, and the objective (B) [m^2]."""
        markers = self.recordings.dataset.markers.positions(torch.from_numpy(x))
        gap = (markers - self.recordings.markers[self.number]).numpy()
        flat = (self._seen @ gap[..., None]).reshape(len(gap), -1)
        return flat, (flat**2).sum(1) + self.penalty * (force**2).sum((1, 2))

    def _force_jacobian(self, x: Array) -> Array:
        """Derivatives of the markers with respect to the forces on free nodes [m/N], (B, 3 M, n)."""
        engine, batch = self.simulator.engine, len(x)
        by_corner = self.recordings.dataset.markers.corner_jacobian(torch.from_numpy(x)).numpy()  # (B, M, 3, 4, 3)
        quad = self.recordings.dataset.markers.quad
        count = len(quad)
        right = np.zeros((batch, count, 3, x.shape[1], 3))
        for corner in range(4):
            right[:, np.arange(count), :, quad[:, corner]] += by_corner[:, :, :, corner].swapaxes(0, 1)
        diagonal = np.repeat(self._inertia[0], 3, axis=1)[:, engine.free_index]
        with engine.thread_limit(batch):
            tangents = engine.evaluate(x, self.simulator.constitutive_state(batch), tangent=True)[2]
            columns = np.ascontiguousarray(right.reshape(batch, 3 * count, -1)[:, :, engine.free_index])
            return engine.solve_once(tangents, diagonal, columns)
