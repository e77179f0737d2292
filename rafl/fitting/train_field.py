"""End-to-end training of the residual acceleration field through the simulator (paper, RAFL objective)."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.common.errors import InputError, SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, frame_errors, training_loss
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.fitting.run_folder import (
    FORMAT,
    FittedModel,
    Report,
    Settings,
    expect_content,
    has_stalled,
    load_model,
    load_tensors,
    save_model,
    save_tensors,
    write_history,
)
from rafl.fitting.warm_start import can_fit_targets, pretrain
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.energy_limit import MARGIN, MIN_FRACTION, energy_scale, largest_work
from rafl.residual.field_force import FieldPoints
from rafl.simulation.rollout import rollout

# Larger gradients are scaled down: Adam's step does not depend on their size, but the huge gradient of a diverging
# rollout would spoil its moments.
MAX_GRADIENT_NORM = 10.0
FINAL_RATE_FRACTION = 0.02  # last learning rate as a fraction of the first
CHECKPOINT_FILE = "checkpoint.pt"


def prepare_datasets(datasets: list[Dataset], settings: Settings) -> list[Dataset]:
    """The datasets with the frames and the integrator of the settings."""
    return [_with_integrator(dataset.first_frames(settings.frames), settings) for dataset in datasets]


def _with_integrator(dataset: Dataset, settings: Settings) -> Dataset:
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
        InputError: there are none.
    """
    items = [Item(dataset, name) for dataset in datasets for name in dataset.split("train")]
    if not items:
        where = ", ".join(dataset.name for dataset in datasets)
        raise InputError(
            f"expected recordings with split `train` in {where}, found none; set the split column of "
            "recordings.csv and run rafl-capture again"
        )
    return items


def batches_by_dataset(items: list[Item], settings: Settings | None = None) -> list[Recordings]:
    """One batch of recordings for each dataset; a batch is simulated at once.

    settings: of the fit that compares them; None if only errors are of interest.
    """
    names: dict[int, list[str]] = {}
    owners = {id(item.dataset): item.dataset for item in items}
    for item in items:
        names.setdefault(id(item.dataset), []).append(item.name)
    if settings is None:
        return [Recordings.of(owners[key], chosen) for key, chosen in names.items()]
    return [Recordings.of(owners[key], chosen, settings.by_sigma, settings.objective) for key, chosen in names.items()]


def validation_batches(datasets: list[Dataset]) -> list[Recordings]:
    """The validation recordings, or the training recordings if there are none."""
    chosen = [Item(dataset, name) for dataset in datasets for name in dataset.split("val")]
    return batches_by_dataset(chosen or training_items(datasets))


def recording_errors(
    batches: list[Recordings], model: FittedModel, group: ProcessGroup = ALONE
) -> list[NDArray[np.float64]]:
    """Sum over the frames of the mean marker error [m], and the number of frames, of some recordings, (R) each.

    Raises:
        SimulationError: a simulation fails.
    """

    def compute(recordings: Recordings, rows: list[int]) -> NDArray[np.float64]:
        simulator = model.simulator(recordings.dataset.simulator)
        with torch.no_grad():
            simulated, _ = recordings.in_simulator(simulator).simulate(
                model.residual(simulator), model.parameters(simulator)
            )
        return np.array([[each.sum(), len(each)] for each in frame_errors(recordings, simulated)])

    return list(group.by_recording(batches, 2, compute).T)


def mean_error(batches: list[Recordings], model: FittedModel, group: ProcessGroup = ALONE) -> float:
    """Mean marker error [m] over all frames of some recordings; infinite if a simulation fails."""
    try:
        sums, frames = recording_errors(batches, model, group)
    except SimulationError:
        return math.inf
    return float(sums.sum() / frames.sum())


def load_start_model(run: Path) -> FittedModel:
    """The field or the identified material of an earlier run, or both, to start training from.

    Raises:
        InputError: no run there, or one of another method.
    """
    model = load_model(run)
    if model.network is not None:
        raise InputError(f"expected a run of method rafl or sysid in {run} to start from, found {model.method}")
    return model


def _start_and_datasets(datasets: list[Dataset], settings: Settings) -> tuple[FittedModel, list[Dataset]]:
    """The model that training starts from, and the datasets, all frames, with its material and time integration.

    An integrator in the settings overrides the model's time integration.
    """
    start = load_start_model(Path(settings.start)) if settings.start else FittedModel("rafl")
    identified = (start.material or {}).items()
    values: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in identified}
    used = []
    for dataset in (_with_integrator(item, settings) for item in datasets):
        simulator = dataset.simulator if settings.integrator else start.simulator(dataset.simulator)
        used.append(replace(dataset, simulator=replace(simulator, material=replace(simulator.material, **values))))
    return start, used


def pretraining_unavailable(datasets: list[Dataset], settings: Settings) -> bool:
    """Whether the settings ask for pre-training and no dataset, with its training settings, allows it."""
    _, used = _start_and_datasets(datasets, settings)
    return settings.warm_start > 0 and not any(can_fit_targets(dataset) for dataset in used)


def fit_residual_field(
    datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: ProcessGroup = ALONE
) -> FittedModel:
    """Train a `ResidualField` by Adam, one update per batch of recordings, and keep the best on the validation set.

    If the field makes a simulation fail, the best field so far replaces it, the learning rate is halved, and training
    continues with the next batch.

    `checkpoint.pt`, `model.pt` and `history.csv` in `run` are written after every epoch. A second call with the same
    settings resumes from the checkpoint and ends with the weights of an uninterrupted run. Several processes share
    every batch.

    Args:
        datasets: one or more specimens.
        settings: of the training.
        run: folder of the run.
        report: called with each epoch's history row.
        group: processes that train together.

    Raises:
        InputError: no training recordings, or a checkpoint of another run.
        SimulationError: every rollout of an epoch failed; names recording and step.
    """
    return _Training(datasets, settings, run, report, group).train()


class _Training:
    """The training in one of the processes."""

    def __init__(
        self, datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: ProcessGroup
    ) -> None:
        self.settings, self.run, self.group, self.report = settings, run, group, report
        start, full_length = _start_and_datasets(datasets, settings)
        datasets = [dataset.first_frames(settings.frames) for dataset in full_length]
        self.items, self.validation = training_items(datasets), validation_batches(datasets)
        self.training = batches_by_dataset(self.items, settings)
        self.history: list[dict[str, float]] = []
        torch.manual_seed(settings.seed)
        self.field = ResidualField() if start.field is None else start.field
        integration = datasets[0].simulator.time_integration
        self.model = FittedModel("rafl", self.field, start.material, time_integration=integration)
        self.resumes = group.on_main((run / CHECKPOINT_FILE).exists)
        if not self.resumes:
            if start.field is None:
                self._initialise_field(datasets)
            pretrain(
                self.field,
                full_length,
                run,
                settings.warm_start,
                settings.seed,
                self._validation_mm,
                self.report,
                trained=start.field is not None,
                group=group,
            )
        self.optimiser = torch.optim.Adam(
            self.field.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimiser, settings.epochs, eta_min=FINAL_RATE_FRACTION * settings.learning_rate
        )
        self.shuffle = torch.Generator().manual_seed(settings.seed)

    def _initialise_field(self, datasets: list[Dataset]) -> None:
        """Set the symmetry and the scale of a new field from the training datasets."""
        training = [dataset for dataset in datasets if dataset.split("train")]
        mirrors = np.logical_and.reduce([dataset.simulator.symmetry_planes for dataset in training])
        self.field.impose_symmetry(torch.from_numpy(mirrors))
        with self.group.fail_together():
            if self.group.is_main:
                samples = torch.cat([_sample_features(dataset) for dataset in training])
                self.field.set_scale(samples.square().mean(0).sqrt())
        self.group.copy_from_main(list(self.field.state_dict().values()))

    def _validation_mm(self) -> float:
        """The model's validation error [mm]."""
        return 1e3 * mean_error(self.validation, self.model, self.group)

    def train(self) -> FittedModel:
        """Train until the last epoch or until the validation error has stalled."""
        if self.resumes:
            self._resume()
        else:
            first = self._validation_mm()
            self.history.append({"epoch": 0, "loss": math.nan, "validation_mm": first, "learning_rate": 0.0})
            self._save(best=True)
        while self.history[-1]["epoch"] < self.settings.epochs and not self._has_stalled():
            loss, failed = self._run_epoch()
            rate = float(self.optimiser.param_groups[0]["lr"])
            self.schedule.step()
            error = self._validation_mm()
            best = error < min(row["validation_mm"] for row in self.history)
            epoch = self.history[-1]["epoch"] + 1
            row = {"epoch": epoch, "loss": loss, "validation_mm": error, "learning_rate": rate}
            self.history.append(row | ({"failed": failed} if failed else {}))
            self._save(best)
        self.group.wait()
        model = load_model(self.run)
        if self.settings.limit_energy and model.energy_fraction is None:
            model = replace(model, energy_fraction=self._energy_fraction(model))
            if self.group.is_main:
                save_model(self.run, model)
        self.group.wait()
        return model

    def _energy_fraction(self, model: FittedModel) -> float:
        """Limit of the field's work on other motions, from that on the training and validation recordings."""

        def compute(recordings: Recordings, rows: list[int]) -> NDArray[np.float64]:
            simulator = model.simulator(recordings.dataset.simulator)
            parameters, start = model.parameters(simulator), recordings.dataset.start(recordings.names)
            external = start.force + torch.from_numpy(simulator.weight)
            try:
                with torch.no_grad():
                    scale = energy_scale(simulator, parameters, start.q, start.v, external)
                    work = largest_work(
                        *recordings.in_simulator(simulator).simulate_vertices(model.residual(simulator), parameters)
                    )
            except SimulationError:
                return np.full((len(rows), 1), np.nan)
            return (work / scale).numpy()[:, None]

        batches = [*batches_by_dataset(self.items), *self.validation]
        largest = self.group.by_recording(batches, 1, compute)
        ends = np.cumsum([len(recordings.names) for recordings in batches])
        finite = [float(each.max()) for each in np.split(largest, ends[:-1]) if not np.isnan(each).any()]
        return MARGIN * max([MIN_FRACTION, *finite])

    def _has_stalled(self) -> bool:
        return has_stalled([row["validation_mm"] for row in self.history], self.settings.patience)

    def _run_epoch(self) -> tuple[float, int]:
        """Mean loss of one pass over the recordings, and the number of failed updates."""
        total, count, failed = 0.0, 0, 0
        order = torch.randperm(len(self.items), generator=self.shuffle).tolist()
        for first in range(0, len(order), self.settings.batch):
            batch = [self.items[k] for k in order[first : first + self.settings.batch]]
            try:
                total += len(batch) * self._update(batch)
                count += len(batch)
            except SimulationError:
                failed += 1
                if first + self.settings.batch >= len(order) and count == 0:
                    raise
                self._restore_best()
        return total / count, failed

    def _update(self, batch: list[Item]) -> float:
        """Update the weights once; returns the batch's mean loss.

        Raises:
            SimulationError: a simulation failed in one of the processes; raised in all.
        """
        self.optimiser.zero_grad()
        mean, failures = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
        reason = f"a simulation of {', '.join(item.name for item in batch)} failed in epoch {len(self.history)}"
        try:
            for recordings in self._recordings(self.group.share(batch)):
                force = self.field.on(recordings.dataset.simulator, torch.float32)
                simulated, forces = recordings.simulate(force)
                loss = training_loss(recordings, simulated, forces, self.settings.force_penalty)
                loss = loss * len(recordings.names) / len(batch)
                torch.autograd.backward(loss)
                mean += loss.detach()
        except SimulationError as error:
            failures += 1.0
            reason = f"{reason}: {error}"
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.field.parameters()]
        self.group.sum_over_processes([*gradients, mean, failures])
        for parameter, gradient in zip(self.field.parameters(), gradients, strict=True):
            parameter.grad = gradient
        norm = torch.nn.utils.clip_grad_norm_(self.field.parameters(), MAX_GRADIENT_NORM)
        if failures > 0 or not torch.isfinite(norm):
            raise SimulationError(f"{reason}; lower the learning rate")
        self.optimiser.step()
        return mean.item()

    def _recordings(self, items: list[Item]) -> list[Recordings]:
        """One batch for each dataset that has some of the items, no longer than the longest of them."""
        result = []
        for whole in self.training:
            names = [item.name for item in items if item.dataset is whole.dataset]
            if names:
                longest = max(len(whole.dataset.trajectories[name].time) for name in names)
                result.append(whole.select([whole.names.index(name) for name in names]).first_frames(longest))
        return result

    def _restore_best(self) -> None:
        """Return to the best field so far, halve the learning rate and clear Adam's moments."""
        self.group.wait()  # until process 0 has written the model
        best = load_model(self.run).field
        assert best is not None
        self.field.load_state_dict(best.state_dict())
        self.optimiser.state.clear()
        for group in self.optimiser.param_groups:
            group["lr"] *= 0.5

    def _resume(self) -> None:
        saved = load_tensors(self.run / CHECKPOINT_FILE, "a checkpoint of this run")
        with expect_content("a checkpoint of this version", self.run / CHECKPOINT_FILE):
            self.field.restore(saved["field"])
            self.optimiser.load_state_dict(saved["optimiser"])
            self.schedule.load_state_dict(saved["schedule"])
            self.shuffle.set_state(saved["shuffle"])
            self.history = [{**row} for row in saved["history"]]
            if not all(isinstance(value, (int, float)) for row in self.history for value in row.values()):
                raise TypeError("a history of something else than numbers")
            for weight, state in self.optimiser.state.items():
                kept = [value for value in state.values() if value.dim()]
                if any(value.shape != weight.shape or not value.isfinite().all() for value in (weight, *kept)):
                    raise ValueError("the optimiser's state has other shapes than the weights, or infinite numbers")

    def _save(self, best: bool) -> None:
        """Write the model, if it is the best so far, the checkpoint and the history; report the last epoch."""
        if self.group.is_main:
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
            save_tensors(self.run / CHECKPOINT_FILE, content)
            write_history(self.run, self.history)
        self.report(self.history[-1])


def _sample_features(dataset: Dataset) -> torch.Tensor:
    """Features (S, 34) along the baseline simulator's motion, every tenth step counted back from the last."""
    simulator, names = dataset.simulator, dataset.split("train")
    steps = max(len(dataset.trajectories[name].time) for name in names) - 1
    with torch.no_grad():
        q, _ = rollout(simulator, dataset.start(names), steps)
    v = torch.diff(q, dim=0, prepend=q[:1]) / simulator.time_step
    states = (np.ascontiguousarray(x.flip(0)[::10].flatten(0, 1).numpy()) for x in (q, v))
    return torch.from_numpy(FieldPoints.of(simulator).features(*states)[0]).T
