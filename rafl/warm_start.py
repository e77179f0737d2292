"""A residual field's first weights from the equations of motion, where a dataset shows every vertex.

Where positions at all steps are known, so is the force that the simulator lacks in each step; fitting the field to it
takes no simulation. What a wrong force would do is measured by the work it would do on the body at rest, which weighs
bending and the stiff cross-sections fairly. End-to-end training starts from there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.dataset import Dataset
from rafl.field_force import FieldPoints, accelerations
from rafl.field_kernels import KEPT_TURN
from rafl.residual import ResidualField
from rafl.run import stale

Array = NDArray[Any]

RATE = 3e-3  # Adam's, at the start of the cosine decay
BATCH = 16  # states an update
PATIENCE = 3  # epochs that do not simulate better, after which the lesson is over
LARGEST = 1000  # vertices: beyond, the body's compliance does not fit as a full matrix


@dataclass(frozen=True)
class MissingForces:
    """States of the recordings, and the forces that would have made the simulator follow them.

    Attributes:
        q, v: [m], [m/s], (S, N, 3).
        force: [N], (S, N, 3); nought on held nodes.
    """

    q: Array
    v: Array
    force: Array


def shows_every_vertex(dataset: Dataset) -> bool:
    """Whether the markers are the mesh's vertices, all seen, and steps are plain backward differences."""
    markers, simulator = dataset.markers, dataset.simulator
    at = markers.quad[np.arange(len(markers.quad)), markers.weights.argmax(axis=1)]
    return (
        len(at) == len(simulator.mesh.vertices)
        and bool((markers.weights.max(axis=1) == 1.0).all() and (markers.normal_offset == 0.0).all())
        and bool((at == np.arange(len(at))).all())
        and all(dataset.trajectories[name].valid.all() for name in dataset.split("train"))
        and simulator.integrator == "implicit-euler"
        and simulator.substeps == 1
        and not simulator.parameters().damped
        and simulator.material.mass_damping == 0.0
    )


def missing_forces(dataset: Dataset, names: list[str]) -> MissingForces:
    """Of recordings that show every vertex (paper, eq. 1, solved for the residual force)."""
    simulator = dataset.simulator
    h = simulator.time_step
    parts: list[tuple[Array, Array, Array]] = []
    for name in names:
        item = dataset.trajectories[name]
        q = np.concatenate([item.q[None], item.markers[1:]])
        v = np.concatenate([item.v[None], np.diff(q, axis=0) / h])
        mass = (simulator.node_mass + item.added_mass)[:, None]
        force = mass / h**2 * (q[1:] - q[:-1] - h * v[:-1]) - simulator.weight - item.load
        force += simulator.elastic_gradient(np.ascontiguousarray(q[1:]))
        force[:, simulator.fixed] = 0.0
        parts.append((q[:-1], v[:-1], force))
    return MissingForces(*(np.concatenate(part) for part in zip(*parts, strict=True)))


class _Lesson:
    """One dataset's states, ready for updates in single precision."""

    def __init__(self, dataset: Dataset) -> None:
        simulator, missing = dataset.simulator, missing_forces(dataset, dataset.split("train"))
        states, nodes = missing.q.shape[:2]
        points = FieldPoints.of(simulator)
        inputs, kept = points.features(missing.q, missing.v)
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
        self.force = torch.from_numpy(missing.force.reshape(states, -1).astype(np.float32))
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
    epochs: int,
    seed: int,
    judge: Callable[[], float],
    report: Callable[[dict[str, float]], None],
) -> None:
    """Fit a field, in place, to the forces missing in the training recordings.

    Sets the field's scale too. Datasets that do not show every vertex, or are too large, teach nothing here. What
    fits the recorded states best need not be stable beside them: of all epochs the one is kept that simulates best.

    Args:
        field: to be trained.
        datasets: any.
        epochs: passes over the states; 0 leaves the weights as they are.
        seed: of the order of states.
        judge: the field's error in simulation [mm].
        report: called after each epoch with `warm_start` (its number), `missing` (the share of the missing force's
            effect, root mean square, that the field does not give) and `validation_mm`.
    """
    fit = [item for item in datasets if shows_every_vertex(item) and len(item.simulator.mesh.vertices) <= LARGEST]
    if not fit or epochs == 0:
        return
    lessons = [_Lesson(dataset) for dataset in fit]
    size = torch.from_numpy(np.sqrt(np.mean([lesson.size**2 for lesson in lessons], axis=0)))
    with torch.no_grad():
        field.scale.copy_(1.0 / size.clamp_min(1e-3 * size.max()))
    optimiser = torch.optim.Adam(field.parameters(), lr=RATE)
    order = torch.Generator().manual_seed(seed)
    batches = sum(lesson.states // BATCH for lesson in lessons)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(epochs * batches, 1), eta_min=0.01 * RATE)
    errors, kept = [judge()], {key: value.clone() for key, value in field.state_dict().items()}
    for epoch in range(epochs):
        total = 0.0
        turns = [
            (lesson, chosen)
            for lesson in lessons
            for chosen in torch.randperm(lesson.states, generator=order).split(BATCH)[: lesson.states // BATCH]
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
        if stale(errors, PATIENCE):
            break
    field.load_state_dict(kept)
