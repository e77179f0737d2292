"""Training the residual acceleration field end to end through the simulator (paper, RAFL objective)."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from groundwork import InputError
from rafl.dataset import Dataset, Trajectory
from rafl.errors import SimulationError
from rafl.features import GaussPoints, features
from rafl.objective import Recordings, frame_errors, training_loss
from rafl.residual import ResidualField
from rafl.rollout import rollout
from rafl.run import (
    FORMAT,
    FittedModel,
    Settings,
    load_model,
    load_tensors,
    save_model,
    save_tensors,
    write_history,
)

GRADIENT_LIMIT = 10.0  # Adam's step does not depend on the size; a diverging rollout's must not enter its memory

Report = Callable[[dict[str, float]], None]


def shortened(dataset: Dataset, frames: int) -> Dataset:
    """The dataset with only the first `frames` frames of each recording (all when 0)."""
    if frames == 0:
        return dataset

    def cut(item: Trajectory) -> Trajectory:
        arrays = {key: getattr(item, key)[:frames] for key in ("time", "markers", "valid", "sigma")}
        return replace(item, **arrays)

    return replace(dataset, trajectories={name: cut(item) for name, item in dataset.trajectories.items()})


def training_recordings(datasets: list[Dataset]) -> tuple[list[Recordings], list[Recordings]]:
    """Training recordings one by one, validation recordings one batch a dataset.

    Without a validation split the training recordings validate.

    Raises:
        InputError: no recording to train on.
    """
    train = [Recordings.of(dataset, [name]) for dataset in datasets for name in dataset.split("train")]
    if not train:
        where = ", ".join(dataset.name for dataset in datasets)
        raise InputError(
            f"expected recordings with split `train` in {where}, found none; set the split column of "
            "recordings.csv and run rafl-capture again"
        )
    validate = [Recordings.of(dataset, names) for dataset in datasets if (names := dataset.split("val"))]
    return train, validate or train


def mean_error(sets: list[Recordings], model: FittedModel) -> float:
    """Mean marker error [m] over all frames of some recordings; infinite where a simulation fails."""
    errors: list[np.ndarray] = []
    with torch.no_grad():
        for recordings in sets:
            try:
                simulator = recordings.dataset.simulator
                simulated, _ = recordings.simulate(model.residual(simulator), model.parameters(simulator))
            except SimulationError:
                return math.inf
            errors += frame_errors(recordings, simulated)
    return float(np.concatenate(errors).mean())


def fit_residual_field(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Train a `ResidualField`; one Adam step per recording, the best on the validation set is kept.

    After every epoch `checkpoint.pt`, `model.pt` and `history.csv` in `run` are up to date; called again
    with the same settings it goes on from there and ends with the weights of an uninterrupted run.

    Args:
        datasets: one or more specimens.
        settings: how.
        run: folder of the run.
        report: called with each epoch's history row.

    Raises:
        InputError: nothing to train on, or a checkpoint that is not of this run.
        SimulationError: a rollout failed; names recording and step.
    """
    train, validate = training_recordings([shortened(dataset, settings.frames) for dataset in datasets])
    torch.manual_seed(settings.seed)
    field = ResidualField()
    field.scale_to([_sample_features(recordings) for recordings in train])
    model = FittedModel("rafl", field=field)
    optimiser = torch.optim.Adam(field.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, settings.epochs, eta_min=0.02 * settings.learning_rate
    )
    shuffle = torch.Generator().manual_seed(settings.seed)
    history: list[dict[str, float]] = []
    checkpoint = run / "checkpoint.pt"
    if checkpoint.exists():
        saved = load_tensors(checkpoint, "a checkpoint of this run")
        field.load_state_dict(saved["field"])
        optimiser.load_state_dict(saved["optimiser"])
        schedule.load_state_dict(saved["schedule"])
        shuffle.set_state(saved["shuffle"])
        history = saved["history"]
    else:
        first = mean_error(validate, model)
        history.append({"epoch": 0, "loss": math.nan, "validation_mm": 1e3 * first, "learning_rate": 0.0})
        save_model(run, model)
        report(history[-1])
    while history[-1]["epoch"] < settings.epochs and not _stale(history, settings.patience):
        losses = []
        for index in torch.randperm(len(train), generator=shuffle):
            recordings = train[index]
            optimiser.zero_grad()
            simulated, forces = recordings.simulate(field.on(recordings.dataset.simulator))
            loss = training_loss(recordings, simulated, forces)
            loss.backward()
            size = torch.nn.utils.clip_grad_norm_(field.parameters(), GRADIENT_LIMIT)
            if not torch.isfinite(size):
                raise SimulationError(
                    f"the gradient of recording {recordings.names[0]} is not finite in epoch "
                    f"{len(history)}; lower the learning rate"
                )
            optimiser.step()
            losses.append(loss.item())
        rate = float(schedule.get_last_lr()[0])
        schedule.step()
        error = 1e3 * mean_error(validate, model)
        best = min(row["validation_mm"] for row in history)
        history.append(
            {
                "epoch": history[-1]["epoch"] + 1,
                "loss": float(np.mean(losses)),
                "validation_mm": error,
                "learning_rate": rate,
            }
        )
        if error < best:
            save_model(run, model)
        save_tensors(
            checkpoint,
            {
                "format": FORMAT,
                "method": "rafl",
                "field": field.state_dict(),
                "optimiser": optimiser.state_dict(),
                "schedule": schedule.state_dict(),
                "shuffle": shuffle.get_state(),
                "history": history,
            },
        )
        write_history(run, history)
        report(history[-1])
    return load_model(run)


def _stale(history: list[dict[str, float]], patience: int) -> bool:
    errors = [row["validation_mm"] for row in history]
    return len(errors) - 1 - int(np.argmin(errors)) >= patience


def _sample_features(recordings: Recordings) -> torch.Tensor:
    """Features along the untouched simulator's motion, every tenth step."""
    simulator = recordings.dataset.simulator
    with torch.no_grad():
        start = recordings.dataset.start(recordings.names)
        q, _ = rollout(simulator, start, len(recordings.markers) - 1)
        v = torch.diff(q, dim=0, prepend=q[:1]) / simulator.time_step
        points = GaussPoints.of(simulator.mesh, simulator.material.density)
        gravity = torch.tensor(simulator.gravity, dtype=torch.float64)
        chosen = slice(0, None, 10)
        return features(q[chosen].flatten(0, 1), v[chosen].flatten(0, 1), points, gravity)[0]
