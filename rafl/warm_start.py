"""A residual field's first weights from the least forces that let the simulator follow the recordings step by step.

Fitting the field to these forces takes no simulation. What a wrong force would do is measured by the work it would do
on the body at rest, which weighs bending and the stiff cross-sections fairly. End-to-end training starts from there.
Forces that follow every vertex exactly are a worse lesson: most of them is noise and stiff modes that a field fitted
to them does not damp.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rafl.dataset import Dataset
from rafl.errors import SimulationError
from rafl.field_force import FieldPoints, accelerations
from rafl.field_kernels import KEPT_TURN
from rafl.residual import ResidualField
from rafl.targets import can_be_followed, training_targets

RATE = 3e-3  # Adam's, at the start of the cosine decay
DECAY = 0.3  # of the weights, a unit of rate: without it the field is wilder on shapes it has not seen
BATCH = 16  # states an update
MARKERS = 48  # that are followed at most: more tell hardly more
LARGEST = 1000  # vertices: beyond, the body's compliance does not fit as a full matrix


class _Lesson:
    """One dataset's states, ready for updates in single precision."""

    def __init__(self, dataset: Dataset, targets: Path) -> None:
        simulator = dataset.simulator
        q, v, missing = (part.numpy() for part in training_targets(dataset, targets, MARKERS))
        states, nodes = q.shape[:2]
        points = FieldPoints.of(simulator)
        inputs, kept = points.features(q, v)
        each = 8 * len(points.hexes)
        self.states = states
        self.size = np.sqrt((inputs**2).mean(axis=1))
        self.inputs = torch.from_numpy(inputs.astype(np.float32)).reshape(len(inputs), states, each)
        turn = kept[:, :, KEPT_TURN : KEPT_TURN + 9].transpose(0, 1, 3, 2).reshape(states, each, 3, 3)
        self.turn = torch.from_numpy(turn.astype(np.float32))
        shares = np.zeros((each, nodes))
        for cell, corners in enumerate(points.hexes):
            shares[8 * cell : 8 * cell + 8, corners] = points.shape * points.mass[cell][:, None]
        shares[:, simulator.fixed] = 0.0
        self.shares = torch.from_numpy(shares.astype(np.float32))
        rest = simulator.mesh.vertices[None]
        compliance = simulator.solve_tangent(rest, np.eye(3 * nodes).reshape(1, nodes, 3, -1))[0]
        self.compliance = torch.from_numpy(compliance.reshape(3 * nodes, -1).astype(np.float32))
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


def warm_start(
    field: ResidualField,
    datasets: list[Dataset],
    run: Path,
    epochs: int,
    seed: int,
    judge: Callable[[], float],
    report: Callable[[dict[str, float]], None],
) -> None:
    """Fit a field, in place, to the forces that the training recordings call for.

    Sets the field's scale too. Datasets that are large, or whose simulator damps by viscosity or steps otherwise than
    by backward differences, teach nothing here. What fits the recorded states best need not be stable beside them: of
    all epochs the one is kept that simulates best.

    Args:
        field: to be trained.
        datasets: any.
        run: folder that keeps the forces, `targets-<dataset>.pt`.
        epochs: passes over the states; 0 leaves the weights as they are.
        seed: of the order of states.
        judge: the field's error in simulation [mm].
        report: called after each epoch with `warm_start` (its number), `missing` (the share of the missing force's
            effect, root mean square, that the field does not give) and `validation_mm`.
    """
    if epochs == 0:
        return
    try:
        lessons = [
            _Lesson(dataset, run / f"targets-{number}.pt")
            for number, dataset in enumerate(item for item in datasets if item.split("train"))
            if can_be_followed(dataset.simulator) and len(dataset.simulator.mesh.vertices) <= LARGEST
        ]
    except SimulationError as error:
        raise SimulationError(f"{error}; train without following the recordings first: --warm-start 0") from None
    if not lessons:
        return
    size = torch.from_numpy(np.sqrt(np.mean([lesson.size**2 for lesson in lessons], axis=0)))
    with torch.no_grad():
        field.scale_to(size)
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
