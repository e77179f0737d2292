"""A residual field's first lesson: the least forces that let the simulator follow the recordings step by step.

Fitting the field to these forces takes no simulation. What a wrong force would do is measured by the work it would do
on the body at rest, which weighs bending and the stiff cross-sections fairly. End-to-end training starts from there.
Forces that follow every vertex exactly are a worse lesson: most of them is noise and stiff modes that a field fitted
to them does not damp.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.data.dataset import Dataset
from rafl.fitting.residual_targets import can_be_followed, training_targets
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.features import FEATURES
from rafl.residual.field_force import FieldPoints, accelerations
from rafl.residual.field_kernels import KEPT_TURN
from rafl.simulation.simulator import Simulator

RATE = 3e-3  # Adam's, at the start of the cosine decay
DECAY = 0.3  # of the weights, a unit of rate: without it the field is wilder on shapes it has not seen
BATCH = 16  # states an update
MARKERS = 48  # that are followed at most: more tell hardly more
ENOUGH = 0.1  # gain that ends a step's iteration: a lesson from forces to 1e-8 is no better
LARGEST = 4000  # vertices: beyond, the body's compliance does not fit as a full matrix
MOST_POINTS = 12_000_000  # quadrature points of a dataset's states, 172 bytes each: fewer recordings are followed
TOGETHER = 32  # states whose features are worked out at once
COLUMNS = 512  # of the compliance, likewise


class Lesson:
    """One dataset's states, ready for updates in single precision."""

    def __init__(self, dataset: Dataset, targets: Path) -> None:
        simulator = dataset.simulator
        points = FieldPoints.of(simulator)
        each = 8 * len(points.hexes)
        most = max(MOST_POINTS // each, BATCH)
        chosen = _as_many_as_fit(dataset, most)
        q, v, missing = (part.numpy() for part in training_targets(chosen, targets, MARKERS, ENOUGH))
        if len(q) > most:
            drawn = np.sort(np.random.default_rng(0).choice(len(q), most, replace=False))
            q, v, missing = q[drawn], v[drawn], missing[drawn]
        nodes = q.shape[1]
        self.states = states = len(q)
        self.inputs = torch.empty(FEATURES, states, each)
        self.turn = torch.empty(states, each, 3, 3)
        squares = np.zeros(FEATURES)
        for first in range(0, states, TOGETHER):
            some = slice(first, first + TOGETHER)
            inputs, kept = points.features(np.ascontiguousarray(q[some]), np.ascontiguousarray(v[some]))
            squares += (inputs**2).sum(axis=1)
            self.inputs[:, some] = torch.from_numpy(inputs).reshape(FEATURES, -1, each)
            turn = kept[:, :, KEPT_TURN : KEPT_TURN + 9].transpose(0, 1, 3, 2)
            self.turn[some] = torch.from_numpy(turn).reshape(-1, each, 3, 3)
        self.size = np.sqrt(squares / (states * each))
        shares = np.zeros((each, nodes), np.float32)
        for cell, corners in enumerate(points.hexes):
            shares[8 * cell : 8 * cell + 8, corners] = points.shape * points.mass[cell][:, None]
        shares[:, simulator.fixed] = 0.0
        self.shares = torch.from_numpy(shares)
        self.compliance = _compliance(simulator)
        self.force = torch.from_numpy(missing.reshape(states, -1).astype(np.float32))
        self.work = self._work(self.force)

    def _work(self, force: Tensor) -> Tensor:
        return ((force @ self.compliance) * force).sum(1).mean()

    def loss(self, field: ResidualField, chosen: Tensor) -> Tensor:
        """Work of the force still missing in some states, as a share of all that was missing at first."""
        points = accelerations(self.inputs[:, chosen].flatten(1), field.weights(torch.float32))[-1]
        acceleration = points.reshape(3, len(chosen), -1).permute(1, 2, 0)
        pull = (self.turn[chosen] @ acceleration[..., None])[..., 0]
        force = torch.einsum("pn,bpi->bni", self.shares, pull).flatten(1)
        return self._work(force - self.force[chosen]) / self.work


def _as_many_as_fit(dataset: Dataset, states: int) -> Dataset:
    """The training recordings, evenly left out where they have more states than that; one at least."""
    names = dataset.split("train")
    steps = max(len(dataset.trajectories[name].time) - 1 for name in names)
    count = min(max(states // max(steps, 1), 1), len(names))
    kept = [names[k] for k in np.unique(np.linspace(0, len(names) - 1, count).round().astype(int))]
    return replace(dataset, trajectories={name: dataset.trajectories[name] for name in kept})


def _compliance(simulator: Simulator) -> Tensor:
    """Displacements [m] of the body at rest by unit forces on its nodes, (3 N, 3 N)."""
    rest, size = simulator.mesh.vertices[None], 3 * len(simulator.mesh.vertices)
    compliance = torch.empty(size, size)
    for first in range(0, size, COLUMNS):
        unit = np.eye(size, min(COLUMNS, size - first), -first).reshape(1, size // 3, 3, -1)
        compliance[:, first : first + COLUMNS] = torch.from_numpy(simulator.solve_tangent(rest, unit)).reshape(size, -1)
    return compliance


def can_teach(dataset: Dataset) -> bool:
    """Whether a warm start learns from it: training recordings that can be followed, on a mesh not too large."""
    small = len(dataset.simulator.mesh.vertices) <= LARGEST
    return small and bool(dataset.split("train")) and can_be_followed(dataset.simulator)


def warm_start(
    field: ResidualField,
    datasets: list[Dataset],
    run: Path,
    epochs: int,
    seed: int,
    judge: Callable[[], float],
    report: Callable[[dict[str, float]], None],
    learned: bool = False,
) -> None:
    """Fit a field, in place, to the forces that the training recordings call for.

    Of datasets only those count that can teach. What fits the recorded states best need not be stable beside them:
    of all epochs the one is kept that simulates best.

    Args:
        field: to be trained.
        datasets: any.
        run: folder that keeps the forces, `targets-<dataset>.pt`.
        epochs: passes over the states; 0 leaves the weights as they are.
        seed: of the order of states.
        judge: the field's error in simulation [mm].
        report: called after each epoch with `warm_start` (its number), `missing` (the share of the missing force's
            effect, root mean square, that the field does not give) and `validation_mm`.
        learned: whether the field goes on from an earlier training; one that does not is scaled to these states.
    """
    if epochs == 0:
        return
    try:
        lessons = [
            Lesson(dataset, run / f"targets-{number}.pt")
            for number, dataset in enumerate(datasets)
            if can_teach(dataset)
        ]
    except SimulationError as error:
        raise SimulationError(f"{error}; train without following the recordings first: --warm-start 0") from None
    if not lessons:
        return
    if not learned:
        with torch.no_grad():
            field.scale_to(torch.from_numpy(np.sqrt(np.mean([lesson.size**2 for lesson in lessons], axis=0))))
    optimiser = torch.optim.AdamW(field.parameters(), lr=RATE, weight_decay=DECAY)
    order = torch.Generator().manual_seed(seed)
    batches = sum(max(lesson.states // BATCH, 1) for lesson in lessons)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(epochs * batches, 1), eta_min=0.01 * RATE)
    errors, kept = [judge()], {key: value.clone() for key, value in field.state_dict().items()}
    for epoch in range(epochs):
        total = 0.0
        turns = [
            (lesson, chosen)
            for lesson in lessons
            for chosen in torch.randperm(lesson.states, generator=order).split(BATCH)[: max(lesson.states // BATCH, 1)]
        ]
        for k in torch.randperm(len(turns), generator=order):
            lesson, chosen = turns[k]
            optimiser.zero_grad()
            loss = lesson.loss(field, chosen)
            loss.backward()
            optimiser.step()
            schedule.step()
            total += loss.item()
        errors.append(judge())
        report({"warm_start": epoch + 1, "missing": float(np.sqrt(total / len(turns))), "validation_mm": errors[-1]})
        if errors[-1] < min(errors[:-1]):
            kept = {key: value.clone() for key, value in field.state_dict().items()}
    field.load_state_dict(kept)
