"""Training the residual acceleration field end to end through the simulator (paper, RAFL objective)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rafl.common.errors import InputError, SimulationError
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.objective import Recordings, frame_errors, training_loss
from rafl.fitting.distributed import Processes, processes
from rafl.fitting.run_folder import (
    FORMAT,
    FittedModel,
    Settings,
    load_model,
    load_tensors,
    save_model,
    save_tensors,
    stale,
    understood,
    write_history,
)
from rafl.fitting.warm_start import can_teach, warm_start
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.field_force import FieldPoints
from rafl.simulation.rollout import rollout

GRADIENT_LIMIT = 10.0  # Adam's step does not depend on the size; a diverging rollout's must not enter its memory

LAST_RATE = 0.02  # of the first learning rate
CHECKPOINT = "checkpoint.pt"

Report = Callable[[dict[str, float]], None]


def shortened(dataset: Dataset, frames: int) -> Dataset:
    """The dataset with only the first `frames` frames of each recording (all when 0)."""
    if frames == 0:
        return dataset

    def cut(item: Trajectory) -> Trajectory:
        arrays = {key: getattr(item, key)[:frames] for key in ("time", "markers", "valid", "sigma")}
        return replace(item, **arrays)

    return replace(dataset, trajectories={name: cut(item) for name, item in dataset.trajectories.items()})


def prepared(datasets: list[Dataset], settings: Settings) -> list[Dataset]:
    """The datasets with the frames and the integrator to train with."""
    return [_stepped(shortened(dataset, settings.frames), settings) for dataset in datasets]


def _stepped(dataset: Dataset, settings: Settings) -> Dataset:
    if not settings.integrator:
        return dataset
    return replace(dataset, simulator=replace(dataset.simulator, integrator=settings.integrator))


@dataclass(frozen=True)
class Item:
    """One recording to train on."""

    dataset: Dataset
    name: str


def training_items(datasets: list[Dataset]) -> list[Item]:
    """The training recordings of some datasets.

    Raises:
        InputError: none.
    """
    items = [Item(dataset, name) for dataset in datasets for name in dataset.split("train")]
    if not items:
        where = ", ".join(dataset.name for dataset in datasets)
        raise InputError(
            f"expected recordings with split `train` in {where}, found none; set the split column of "
            "recordings.csv and run rafl-capture again"
        )
    return items


def batches(items: list[Item], by_sigma: bool = False) -> list[Recordings]:
    """Recordings simulated together: those of each dataset."""
    names: dict[int, list[str]] = {}
    owners = {id(item.dataset): item.dataset for item in items}
    for item in items:
        names.setdefault(id(item.dataset), []).append(item.name)
    return [Recordings.of(owners[key], chosen, by_sigma) for key, chosen in names.items()]


def validation_batches(datasets: list[Dataset]) -> list[Recordings]:
    """The validation recordings; without any the training recordings validate."""
    chosen = [Item(dataset, name) for dataset in datasets for name in dataset.split("val")]
    return batches(chosen or training_items(datasets))


def mean_error(sets: list[Recordings], model: FittedModel) -> float:
    """Mean marker error [m] over all frames of some recordings; infinite where a simulation fails."""
    errors: list[np.ndarray] = []
    with torch.no_grad():
        for recordings in sets:
            try:
                simulator = model.simulator(recordings.dataset.simulator)
                simulated, _ = recordings.in_simulator(simulator).simulate(
                    model.residual(simulator), model.parameters(simulator)
                )
            except SimulationError:
                return math.inf
            errors += frame_errors(recordings, simulated)
    return float(np.concatenate(errors).mean())


def model_to_go_on_from(run: Path) -> FittedModel:
    """The field that an earlier run trained, or the material that it identified, or both.

    Raises:
        InputError: no run there, or one of another method.
    """
    model = load_model(run)
    if model.network is not None:
        raise InputError(f"expected a run of method rafl or sysid in {run} to go on from, found {model.method}")
    return model


def _trained_on(datasets: list[Dataset], settings: Settings) -> tuple[FittedModel, list[Dataset]]:
    """What training goes on from, and the datasets, all frames, as it uses them: with what that run identified,
    stepping as it did unless an integrator is asked for."""
    start = model_to_go_on_from(Path(settings.start)) if settings.start else FittedModel("rafl")
    values: dict[str, Any] = dict(start.material or {})
    used = []
    for dataset in (_stepped(item, settings) for item in datasets):
        simulator = dataset.simulator if settings.integrator else start.simulator(dataset.simulator)
        used.append(replace(dataset, simulator=replace(simulator, material=replace(simulator.material, **values))))
    return start, used


def nothing_to_follow(datasets: list[Dataset], settings: Settings) -> bool:
    """Whether a warm start is wanted that no dataset, as it will be trained with, can give."""
    _, used = _trained_on(datasets, settings)
    return settings.warm_start > 0 and not any(can_teach(dataset) for dataset in used)


def fit_residual_field(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Train a `ResidualField` by Adam, one step per batch of recordings; the best on the validation set is kept.

    Where a field makes a simulation fail, the best so far takes its place, the learning rate is halved, and training
    goes on with the next batch.

    After every epoch `checkpoint.pt`, `model.pt` and `history.csv` in `run` are up to date; called again
    with the same settings it goes on from there and ends with the weights of an uninterrupted run. Under
    torchrun every batch is shared out to the processes, and process 0 writes.

    Args:
        datasets: one or more specimens.
        settings: how.
        run: folder of the run.
        report: called with each epoch's history row.

    Raises:
        InputError: nothing to train on, or a checkpoint that is not of this run.
        SimulationError: every rollout of an epoch failed; names recording and step.
    """
    with processes() as group:
        return _Training(datasets, settings, run, report, group).go()


class _Training:
    """One process's part of a training."""

    def __init__(
        self, datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: Processes
    ) -> None:
        self.settings, self.run, self.group = settings, run, group
        self.report: Report = report if group.first else lambda row: None
        start, whole = _trained_on(datasets, settings)
        datasets = [shortened(dataset, settings.frames) for dataset in whole]
        self.items, self.validate = training_items(datasets), validation_batches(datasets)
        self.history: list[dict[str, float]] = []
        torch.manual_seed(settings.seed)
        self.field = ResidualField() if start.field is None else start.field
        self.model = FittedModel("rafl", self.field, start.material, stepping=datasets[0].simulator.stepping)
        if not (run / CHECKPOINT).exists():
            if start.field is None:
                self._prepare(datasets)
            warm_start(
                self.field,
                whole,
                run,
                settings.warm_start,
                settings.seed,
                lambda: 1e3 * mean_error(self.validate, self.model),
                self.report,
                learned=start.field is not None,
            )
        self.optimiser = torch.optim.Adam(
            self.field.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimiser, settings.epochs, eta_min=LAST_RATE * settings.learning_rate
        )
        self.shuffle = torch.Generator().manual_seed(settings.seed)

    def _prepare(self, datasets: list[Dataset]) -> None:
        """A new field's symmetry and scale."""
        taught = [dataset for dataset in datasets if dataset.split("train")]
        mirrors = np.logical_and.reduce([dataset.simulator.mirrors for dataset in taught])
        self.field.mirror(torch.from_numpy(mirrors))
        samples = torch.cat([_sample_features(dataset) for dataset in taught])
        self.field.scale_to(samples.square().mean(0).sqrt())

    def go(self) -> FittedModel:
        """Train to the end."""
        if (self.run / CHECKPOINT).exists():
            self._resume()
        else:
            self.group.wait()  # nobody looks for the checkpoint any more
            first = self.group.agree(1e3 * mean_error(self.validate, self.model))
            self.history.append({"epoch": 0, "loss": math.nan, "validation_mm": first, "learning_rate": 0.0})
            self._save(best=True)
        while self.history[-1]["epoch"] < self.settings.epochs and not self._stale():
            loss, failed = self._epoch()
            rate = float(self.optimiser.param_groups[0]["lr"])
            self.schedule.step()
            error = self.group.agree(1e3 * mean_error(self.validate, self.model))
            best = error < min(row["validation_mm"] for row in self.history)
            epoch = self.history[-1]["epoch"] + 1
            row = {"epoch": epoch, "loss": loss, "validation_mm": error, "learning_rate": rate}
            self.history.append(row | ({"failed": failed} if failed else {}))
            self._save(best)
        self.group.wait()
        return load_model(self.run)

    def _stale(self) -> bool:
        return stale([row["validation_mm"] for row in self.history], self.settings.patience)

    def _epoch(self) -> tuple[float, int]:
        """Mean loss of one pass over the recordings, and how many updates failed."""
        total, count, failed = 0.0, 0, 0
        order = torch.randperm(len(self.items), generator=self.shuffle).tolist()
        for first in range(0, len(order), self.settings.batch):
            together = [self.items[k] for k in order[first : first + self.settings.batch]]
            try:
                total += len(together) * self._update(together)
                count += len(together)
            except SimulationError:
                failed += 1
                if first + self.settings.batch >= len(order) and count == 0:
                    raise
                self._retreat()
        return total / count, failed

    def _update(self, together: list[Item]) -> float:
        """One step of the optimiser; the batch's mean loss.

        Raises:
            SimulationError: a simulation failed in one of the processes; raised in all.
        """
        self.optimiser.zero_grad()
        mean, failures = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
        reason = f"a simulation of {', '.join(item.name for item in together)} failed in epoch {len(self.history)}"
        try:
            for recordings in batches(self.group.mine(together), self.settings.by_sigma):
                force = self.field.on(recordings.dataset.simulator, torch.float32)
                simulated, forces = recordings.simulate(force)
                loss = training_loss(recordings, simulated, forces, self.settings.force_penalty)
                loss = loss * len(recordings.names) / len(together)
                loss.backward()
                mean += loss.detach()
        except SimulationError as error:
            failures += 1.0
            reason = f"{reason}: {error}"
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.field.parameters()]
        self.group.add_up([*gradients, mean, failures])
        for parameter, gradient in zip(self.field.parameters(), gradients, strict=True):
            parameter.grad = gradient
        size = torch.nn.utils.clip_grad_norm_(self.field.parameters(), GRADIENT_LIMIT)
        if failures > 0 or not torch.isfinite(size):
            raise SimulationError(f"{reason}; lower the learning rate")
        self.optimiser.step()
        return mean.item()

    def _retreat(self) -> None:
        """To the best field so far, with half the learning rate and nothing in Adam's memory."""
        self.group.wait()  # what process 0 wrote is read
        best = load_model(self.run).field
        assert best is not None
        self.field.load_state_dict(best.state_dict())
        self.optimiser.state.clear()
        for group in self.optimiser.param_groups:
            group["lr"] *= 0.5

    def _resume(self) -> None:
        saved = load_tensors(self.run / CHECKPOINT, "a checkpoint of this run")
        with understood("a checkpoint of this version", self.run / CHECKPOINT):
            self.field.restore(saved["field"])
            self.optimiser.load_state_dict(saved["optimiser"])
            self.schedule.load_state_dict(saved["schedule"])
            self.shuffle.set_state(saved["shuffle"])
            self.history = [{**row} for row in saved["history"]]

    def _save(self, best: bool) -> None:
        if self.group.first:
            if best:
                save_model(self.run, self.model)
            content: dict[str, object] = {
                "format": FORMAT,
                "method": "rafl",
                "field": self.field.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "schedule": self.schedule.state_dict(),
                "shuffle": self.shuffle.get_state(),
                "history": self.history,
            }
            save_tensors(self.run / CHECKPOINT, content)
            write_history(self.run, self.history)
        self.report(self.history[-1])


def _sample_features(dataset: Dataset) -> torch.Tensor:
    """Features along the untouched simulator's motion, every tenth step from the last."""
    simulator, names = dataset.simulator, dataset.split("train")
    steps = max(len(dataset.trajectories[name].time) for name in names) - 1
    with torch.no_grad():
        q, _ = rollout(simulator, dataset.start(names), steps)
    v = torch.diff(q, dim=0, prepend=q[:1]) / simulator.time_step
    states = (np.ascontiguousarray(x.flip(0)[::10].flatten(0, 1).numpy()) for x in (q, v))
    return torch.from_numpy(FieldPoints.of(simulator).features(*states)[0]).T
