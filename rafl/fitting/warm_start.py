"""Pre-training of a residual field: a fit to residual targets, from which end-to-end training starts.

The fit itself needs no simulation. Its loss measures an error in force by the work that the error would do on the
specimen at rest. That weights bending and the stiff deformations of cross-sections fairly. Forces that follow every
vertex exactly are worse targets: they are mostly noise and stiff modes, which a field fitted to them does not damp.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.data.dataset import Dataset
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.fitting.residual_targets import compute_targets, read_targets, supports_residual_targets
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.features import FEATURES
from rafl.residual.field_force import FieldPoints, layer_outputs
from rafl.residual.field_kernels import SAVED_ROTATION
from rafl.simulation.simulator import Simulator

LEARNING_RATE = 3e-3  # initial learning rate of Adam; it decays as a cosine
WEIGHT_DECAY = 0.3  # of AdamW; without it the field varies more on shapes that it was not trained on
BATCH_STATES = 16  # states per update
MAX_MARKERS = 48  # markers to follow; more add hardly any information
MIN_RELATIVE_GAIN = 0.1  # ends a step's iteration; targets converged to 1e-8 give no better field
MAX_VERTICES = 4000  # of a mesh: the compliance matrix of a larger one does not fit in memory
MAX_QUADRATURE_POINTS = 12_000_000  # over all states of a dataset, 172 bytes each; limits the number of recordings
STATES_PER_CHUNK = 32  # states whose features are computed at once
COLUMNS_PER_CHUNK = 512  # columns of the compliance matrix that are computed at once


class TargetFit:
    """The states and residual targets of one dataset, and the loss of a field on them, in single precision.

    Args:
        dataset: whose states they are.
        targets: file that `compute_few_targets` has written.

    Attributes:
        states: number of states S.
        inputs: features at all quadrature points of a state, (34, S, P).
        rotation: from the co-rotated frame to the specimen frame, (S, P, 3, 3).
        feature_rms: root mean square of each feature, (34).
        point_mass: mass of each point [kg], distributed to the nodes by the shape functions; 0 for fixed nodes, (P, N).
        compliance: displacements of the specimen at rest under unit forces [m/N], (3 N, 3 N).
        force: residual targets [N], (S, 3 N).
        work: mean work of the targets [J].
    """

    def __init__(self, dataset: Dataset, targets: Path) -> None:
        simulator = dataset.simulator
        points = FieldPoints.of(simulator)
        count = 8 * len(points.hexes)
        max_states = _max_states(dataset)
        q, v, force = (part.numpy() for part in read_targets(dataset, targets))
        if len(q) > max_states:
            drawn = np.sort(np.random.default_rng(0).choice(len(q), max_states, replace=False))
            q, v, force = q[drawn], v[drawn], force[drawn]
        nodes = q.shape[1]
        self.states = states = len(q)
        self.inputs = torch.empty(FEATURES, states, count)
        self.rotation = torch.empty(states, count, 3, 3)
        squares = np.zeros(FEATURES)
        for first in range(0, states, STATES_PER_CHUNK):
            chunk = slice(first, first + STATES_PER_CHUNK)
            inputs, saved = points.features(np.ascontiguousarray(q[chunk]), np.ascontiguousarray(v[chunk]))
            squares += (inputs**2).sum(axis=1)
            self.inputs[:, chunk] = torch.from_numpy(inputs).reshape(FEATURES, -1, count)
            rotation = saved[:, :, SAVED_ROTATION : SAVED_ROTATION + 9].transpose(0, 1, 3, 2)
            self.rotation[chunk] = torch.from_numpy(rotation).reshape(-1, count, 3, 3)
        self.feature_rms = np.sqrt(squares / (states * count))
        point_mass = np.zeros((count, nodes), np.float32)
        for cell, corners in enumerate(points.hexes):
            point_mass[8 * cell : 8 * cell + 8, corners] = points.shape * points.mass[cell][:, None]
        point_mass[:, simulator.fixed] = 0.0
        self.point_mass = torch.from_numpy(point_mass)
        self.compliance = _compliance(simulator)
        self.force = torch.from_numpy(force.reshape(states, -1).astype(np.float32))
        self.work = self._mean_work(self.force)

    def _mean_work(self, force: Tensor) -> Tensor:
        """Mean over states of the work of forces (S, 3 N) [N] on the displacements that they cause [J]."""
        return ((force @ self.compliance) * force).sum(1).mean()

    def loss(self, field: ResidualField, chosen: Tensor) -> Tensor:
        """Work of the error in force in the chosen states, as a fraction of the work of all targets."""
        points = layer_outputs(self.inputs[:, chosen].flatten(1), field.weights(torch.float32))[-1]
        corotated = points.reshape(3, len(chosen), -1).permute(1, 2, 0)
        acceleration = (self.rotation[chosen] @ corotated[..., None])[..., 0]
        force = torch.einsum("pn,bpi->bni", self.point_mass, acceleration).flatten(1)
        return self._mean_work(force - self.force[chosen]) / self.work


def _max_states(dataset: Dataset) -> int:
    """Largest number of states whose features are kept; at least one batch."""
    return max(MAX_QUADRATURE_POINTS // (8 * len(dataset.simulator.mesh.hexes)), BATCH_STATES)


def compute_few_targets(dataset: Dataset, path: Path, group: ProcessGroup = ALONE) -> None:
    """Write the targets of as many recordings as `TargetFit` can keep to a file; see `compute_targets`."""
    compute_targets(_limit_recordings(dataset), path, MAX_MARKERS, MIN_RELATIVE_GAIN, group)


def _limit_recordings(dataset: Dataset) -> Dataset:
    """As many evenly spaced training recordings as have about `_max_states` states in total; at least one."""
    names = dataset.split("train")
    steps = max(len(dataset.trajectories[name].time) - 1 for name in names)
    count = min(max(_max_states(dataset) // max(steps, 1), 1), len(names))
    kept = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, count).round().astype(int))]
    return replace(dataset, trajectories={name: dataset.trajectories[name] for name in kept})


def _compliance(simulator: Simulator) -> Tensor:
    """Displacements of the specimen at rest under unit forces on its nodes [m/N], (3 N, 3 N)."""
    rest, size = simulator.mesh.vertices[None], 3 * len(simulator.mesh.vertices)
    compliance = torch.empty(size, size)
    for first in range(0, size, COLUMNS_PER_CHUNK):
        unit = np.eye(size, min(COLUMNS_PER_CHUNK, size - first), -first).reshape(1, size // 3, 3, -1)
        solution = torch.from_numpy(simulator.solve_tangent(rest, unit)).reshape(size, -1)
        compliance[:, first : first + COLUMNS_PER_CHUNK] = solution
    return compliance


def can_fit_targets(dataset: Dataset) -> bool:
    """Whether pre-training can use a dataset: training recordings, a supported simulator, at most 4000 vertices."""
    small = len(dataset.simulator.mesh.vertices) <= MAX_VERTICES
    return small and bool(dataset.split("train")) and supports_residual_targets(dataset.simulator)


def pretrain(
    field: ResidualField,
    datasets: list[Dataset],
    run: Path,
    epochs: int,
    seed: int,
    validate: Callable[[], float],
    report: Callable[[dict[str, float]], None],
    trained: bool = False,
    group: ProcessGroup = ALONE,
) -> None:
    """Fit a field, in place, to the residual targets of the training recordings.

    Datasets that do not allow it are skipped. The best fit to the recorded states need not be stable near them, so
    the weights of the epoch with the lowest error in simulation are kept.

    Several processes share the recordings, for the targets and for the errors in simulation. Process 0 alone updates
    the weights: it alone needs memory for the states, and the result does not depend on the number of processes.

    Args:
        field: to be trained.
        datasets: any.
        run: folder for the targets, `targets-<number>.pt`.
        epochs: passes over the states; 0 leaves the weights unchanged.
        seed: of the order of states.
        validate: returns the field's error in simulation [mm]; called in all processes.
        report: called after each epoch with `warm_start` (its number), `missing` (the error in force as a fraction of
            the targets, root mean square in the norm of the loss) and `validation_mm`.
        trained: whether the field was trained before; a new field's scale is set from the states.
        group: processes that train together.

    Raises:
        SimulationError: the targets cannot be computed.
    """
    if epochs == 0:
        return
    usable = [(dataset, run / f"targets-{k}.pt") for k, dataset in enumerate(datasets) if can_fit_targets(dataset)]
    if not usable:
        return
    updates = None
    try:
        for dataset, path in usable:
            compute_few_targets(dataset, path, group)
        with group.fail_together():
            if group.is_main:
                updates = _Updates(field, [TargetFit(dataset, path) for dataset, path in usable], epochs, seed, trained)
    except SimulationError as error:
        raise SimulationError(f"{error}; train without pre-training: --warm-start 0") from None

    def validated() -> tuple[float, dict[str, Tensor]]:
        group.copy_from_main(list(field.state_dict().values()))
        return validate(), {key: value.clone() for key, value in field.state_dict().items()}

    least, kept = validated()
    for epoch in range(epochs):
        missing = math.nan if updates is None else updates.run_epoch()
        reached, weights = validated()
        report({"warm_start": epoch + 1, "missing": missing, "validation_mm": reached})
        if reached < least:
            least, kept = reached, weights
    field.load_state_dict(kept)


class _Updates:
    """The updates of a field's weights, by process 0.

    Args:
        field: to be trained.
        fits: of the datasets.
        epochs: number of passes.
        seed: of the order of states.
        trained: see `pretrain`.
    """

    def __init__(self, field: ResidualField, fits: list[TargetFit], epochs: int, seed: int, trained: bool) -> None:
        self.field, self.fits = field, fits
        if not trained:
            with torch.no_grad():
                field.set_scale(torch.from_numpy(np.sqrt(np.mean([fit.feature_rms**2 for fit in fits], axis=0))))
        self.optimiser = torch.optim.AdamW(field.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        self.order = torch.Generator().manual_seed(seed)
        updates = epochs * sum(max(fit.states // BATCH_STATES, 1) for fit in fits)
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimiser, max(updates, 1), eta_min=0.01 * LEARNING_RATE
        )

    def run_epoch(self) -> float:
        """Root mean squared loss of one pass over the states."""
        total = 0.0
        batches = [(fit, chosen) for fit in self.fits for chosen in _state_batches(fit.states, self.order)]
        for k in torch.randperm(len(batches), generator=self.order):
            fit, chosen = batches[k]
            self.optimiser.zero_grad()
            loss = fit.loss(self.field, chosen)
            torch.autograd.backward(loss)
            self.optimiser.step()
            self.schedule.step()
            total += loss.item()
        return float(np.sqrt(total / len(batches)))


def _state_batches(states: int, order: torch.Generator) -> tuple[Tensor, ...]:
    """Random batches of state numbers; an incomplete last batch is dropped unless it is the only one."""
    return torch.split(torch.randperm(states, generator=order), BATCH_STATES)[: max(states // BATCH_STATES, 1)]
