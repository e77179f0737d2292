"""Supervised residual learning (paper, SRL baseline, after Gao et al.): a network is trained on residual targets."""

import math
from pathlib import Path

import torch
from torch import Tensor

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.fitting.residual_targets import compute_targets, read_targets
from rafl.fitting.run_folder import FittedModel, Report, Settings, has_stalled, load_model, save_model, write_history
from rafl.fitting.train_field import mean_error, prepare_datasets, training_items, validation_batches
from rafl.residual.global_residual import GlobalResidual, network_input

BATCH_STATES = 256  # states per update
LEARNING_RATE = 1e-3  # initial learning rate of Adam; it decays as a cosine
VALIDATION_INTERVAL_EPOCHS = 25  # epochs between simulations of the validation recordings
PATIENCE_VALIDATIONS = 8  # validations without a better error before training stops


def fit_supervised(
    datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: ProcessGroup = ALONE
) -> FittedModel:
    """Compute the residual targets of all steps, then train a `GlobalResidual` to predict them.

    The targets are saved in the run's `targets-<number>.pt` and are not computed again. The network is validated by
    simulation every 25 epochs, and the best one is kept.

    Several processes share the recordings, for the targets and for the validation. Process 0 alone updates the weights:
    gradients in single precision, summed in another order, would make them depend on the number of processes.

    Raises:
        InputError: no training recordings, or datasets of different meshes.
        SimulationError: the targets cannot be computed.
    """
    shortened = prepare_datasets(datasets, settings)
    nodes = shared_vertex_count(shortened)
    training_items(shortened)
    validate = validation_batches(shortened)
    with_targets = [dataset for dataset in shortened if dataset.split("train")]
    files = [run / f"targets-{number}.pt" for number in range(len(with_targets))]
    for dataset, path in zip(with_targets, files, strict=True):
        compute_targets(dataset, path, group=group)
    torch.manual_seed(settings.seed)
    network = GlobalResidual(nodes)
    states = targets = torch.zeros(0)
    with group.fail_together():
        if group.is_main:
            states, forces = _training_data(with_targets, files)
            network.set_normalisation(states, forces)
            targets = (forces - network.force_mean) / network.force_size
    model = FittedModel("srl", network=network, time_integration=shortened[0].simulator.time_integration)
    optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs, eta_min=0.01 * LEARNING_RATE)
    history = [
        {"epoch": 0, "loss": math.nan, "validation_mm": 1e3 * mean_error(validate, FittedModel("original"), group)}
    ]
    report(history[-1])
    best = math.inf
    for epoch in range(1, settings.epochs + 1):
        loss = math.nan
        if group.is_main:
            loss = _update(network, optimiser, states, targets)
            schedule.step()
        if epoch % VALIDATION_INTERVAL_EPOCHS and epoch < settings.epochs:
            continue
        group.copy_from_main(list(network.state_dict().values()))
        error = 1e3 * mean_error(validate, model, group)
        history.append({"epoch": epoch, "loss": loss, "validation_mm": error})
        if group.is_main:
            if error < best or not (run / "model.pt").exists():
                best = min(best, error)
                save_model(run, model)
            write_history(run, history)
        report(history[-1])
        # Row 0 is the baseline simulator.
        if has_stalled([row["validation_mm"] for row in history[1:]], PATIENCE_VALIDATIONS):
            break
    group.wait()  # until process 0 has written the model
    return load_model(run)


def _update(network: GlobalResidual, optimiser: torch.optim.Optimizer, states: Tensor, targets: Tensor) -> float:
    """Mean loss of one pass over the states, which updates the weights."""
    total = 0.0
    for chosen in torch.split(torch.randperm(len(states)), BATCH_STATES):
        optimiser.zero_grad()
        loss = (network(states[chosen]) - targets[chosen]).square().mean()
        torch.autograd.backward(loss)
        optimiser.step()
        total += loss.item() * len(chosen) / len(states)
    return total


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


def _training_data(datasets: list[Dataset], files: list[Path]) -> tuple[Tensor, Tensor]:
    """States (S, 6 N) and target forces (S, 3 N), in single precision, from the files of the datasets' targets."""
    states, forces = [], []
    for dataset, path in zip(datasets, files, strict=True):
        q, v, force = read_targets(dataset, path)
        states.append(network_input(q, v, torch.from_numpy(dataset.simulator.mesh.vertices)))
        forces.append(force.flatten(1).float())
    return torch.cat(states), torch.cat(forces)
