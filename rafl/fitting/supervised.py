"""Supervised residual learning (paper, SRL baseline, after Gao et al.): targets, then a network to give them."""

import math
from pathlib import Path

import torch
from torch import Tensor

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.fitting.residual_targets import training_targets
from rafl.fitting.run_folder import FittedModel, Settings, load_model, save_model, stale, write_history
from rafl.fitting.train_field import Report, mean_error, prepared, training_items, validation_batches
from rafl.residual.global_residual import GlobalResidual, motion_of

STATES = 256  # an update
RATE = 1e-3  # Adam's, at the start of the cosine decay
JUDGED = 25  # epochs between rollouts of the validation recordings
PATIENCE = 8  # of these without gain end the training


def fit_supervised(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Solve for each step's residual force, then train a `GlobalResidual` to give it.

    Targets stand in the run's `targets-<dataset>.pt` and are not computed again. The network that simulates the
    validation recordings best is kept; it is asked every 25th epoch.

    Raises:
        InputError: nothing to train on, or datasets of different meshes.
        SimulationError: the recordings cannot be followed.
    """
    cut = prepared(datasets, settings)
    nodes = one_mesh(cut)
    training_items(cut)
    validate = validation_batches(cut)
    states, forces = _lessons(cut, run)
    torch.manual_seed(settings.seed)
    network = GlobalResidual(nodes)
    network.normalise(states, forces)
    wanted = (forces - network.force_mean) / network.force_size
    model = FittedModel("srl", network=network, stepping=cut[0].simulator.stepping)
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs, eta_min=0.01 * RATE)
    history = [{"epoch": 0, "loss": math.nan, "validation_mm": 1e3 * mean_error(validate, FittedModel("original"))}]
    report(history[-1])
    best = math.inf
    for epoch in range(1, settings.epochs + 1):
        total = 0.0
        chosen_batches = torch.randperm(len(states)).split(STATES)
        for chosen in chosen_batches:
            optimiser.zero_grad()
            loss = (network(states[chosen]) - wanted[chosen]).square().mean()
            loss.backward()
            optimiser.step()
            total += loss.item() * len(chosen) / len(states)
        schedule.step()
        if epoch % JUDGED and epoch < settings.epochs:
            continue
        error = 1e3 * mean_error(validate, model)
        history.append({"epoch": epoch, "loss": total, "validation_mm": error})
        if error < best or not (run / "model.pt").exists():
            best = min(best, error)
            save_model(run, model)
        write_history(run, history)
        report(history[-1])
        if stale([row["validation_mm"] for row in history[1:]], PATIENCE):  # row 0 is the untouched simulator
            break
    return load_model(run)


def one_mesh(datasets: list[Dataset]) -> int:
    """The number of vertices that all datasets share.

    Raises:
        InputError: they do not.
    """
    counts = {len(dataset.simulator.mesh.vertices) for dataset in datasets}
    if len(counts) > 1:
        raise InputError(
            f"srl: expected datasets of one mesh, found {', '.join(str(n) for n in sorted(counts))} vertices; train "
            "one model each, or use method rafl"
        )
    return counts.pop()


def _lessons(datasets: list[Dataset], run: Path) -> tuple[Tensor, Tensor]:
    """States (S, 6 N) and target forces (S, 3 N), in single precision."""
    states, forces = [], []
    for number, dataset in enumerate(dataset for dataset in datasets if dataset.split("train")):
        q, v, force = training_targets(dataset, run / f"targets-{number}.pt")
        states.append(motion_of(q, v, torch.from_numpy(dataset.simulator.mesh.vertices)))
        forces.append(force.flatten(1).float())
    return torch.cat(states), torch.cat(forces)
