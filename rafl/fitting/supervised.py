"""Supervised residual learning (paper, SRL baseline, after Gao et al.): a network is trained on residual targets."""

import math
from pathlib import Path

import torch
from torch import Tensor

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.fitting.residual_targets import training_targets
from rafl.fitting.run_folder import FittedModel, Settings, has_stalled, load_model, save_model, write_history
from rafl.fitting.train_field import Report, mean_error, prepare_datasets, training_items, validation_batches
from rafl.residual.global_residual import GlobalResidual, network_input

BATCH_STATES = 256  # states per update
LEARNING_RATE = 1e-3  # initial learning rate of Adam; it decays as a cosine
VALIDATION_INTERVAL_EPOCHS = 25  # epochs between simulations of the validation recordings
PATIENCE_VALIDATIONS = 8  # validations without a better error before training stops


def fit_supervised(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Compute the residual targets of all steps, then train a `GlobalResidual` to predict them.

    The targets are saved in the run's `targets-<number>.pt` and are not computed again. The network is validated by
    simulation every 25 epochs, and the best one is kept.

    Raises:
        InputError: no training recordings, or datasets of different meshes.
        SimulationError: the targets cannot be computed.
    """
    shortened = prepare_datasets(datasets, settings)
    nodes = shared_vertex_count(shortened)
    training_items(shortened)
    validate = validation_batches(shortened)
    states, forces = _training_data(shortened, run)
    torch.manual_seed(settings.seed)
    network = GlobalResidual(nodes)
    network.set_normalisation(states, forces)
    targets = (forces - network.force_mean) / network.force_size
    model = FittedModel("srl", network=network, time_integration=shortened[0].simulator.time_integration)
    optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs, eta_min=0.01 * LEARNING_RATE)
    history = [{"epoch": 0, "loss": math.nan, "validation_mm": 1e3 * mean_error(validate, FittedModel("original"))}]
    report(history[-1])
    best = math.inf
    for epoch in range(1, settings.epochs + 1):
        total = 0.0
        for chosen in torch.split(torch.randperm(len(states)), BATCH_STATES):
            optimiser.zero_grad()
            loss = (network(states[chosen]) - targets[chosen]).square().mean()
            loss.backward()
            optimiser.step()
            total += loss.item() * len(chosen) / len(states)
        schedule.step()
        if epoch % VALIDATION_INTERVAL_EPOCHS and epoch < settings.epochs:
            continue
        error = 1e3 * mean_error(validate, model)
        history.append({"epoch": epoch, "loss": total, "validation_mm": error})
        if error < best or not (run / "model.pt").exists():
            best = min(best, error)
            save_model(run, model)
        write_history(run, history)
        report(history[-1])
        # Row 0 is the baseline simulator.
        if has_stalled([row["validation_mm"] for row in history[1:]], PATIENCE_VALIDATIONS):
            break
    return load_model(run)


def shared_vertex_count(datasets: list[Dataset]) -> int:
    """The number of vertices of every dataset's mesh.

    Raises:
        InputError: the numbers differ.
    """
    counts = {len(dataset.simulator.mesh.vertices) for dataset in datasets}
    if len(counts) > 1:
        raise InputError(
            f"srl: expected datasets of one mesh, found {', '.join(str(n) for n in sorted(counts))} vertices; train "
            "one model for each mesh, or use method rafl"
        )
    return counts.pop()


def _training_data(datasets: list[Dataset], run: Path) -> tuple[Tensor, Tensor]:
    """States (S, 6 N) and target forces (S, 3 N), in single precision."""
    states, forces = [], []
    for number, dataset in enumerate(dataset for dataset in datasets if dataset.split("train")):
        q, v, force = training_targets(dataset, run / f"targets-{number}.pt")
        states.append(network_input(q, v, torch.from_numpy(dataset.simulator.mesh.vertices)))
        forces.append(force.flatten(1).float())
    return torch.cat(states), torch.cat(forces)
