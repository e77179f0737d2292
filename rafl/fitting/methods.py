"""The methods that fit a model, behind one interface."""

from collections.abc import Callable
from pathlib import Path

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.fitting.auto import fit_auto
from rafl.fitting.distributed import ProcessGroup
from rafl.fitting.quantities import METHOD_QUANTITIES
from rafl.fitting.run_folder import FittedModel, Report, Settings
from rafl.fitting.supervised import fit_supervised, shared_vertex_count
from rafl.fitting.sysid import fit_constitutive, identify_material
from rafl.fitting.train_field import (
    batches_by_dataset,
    fit_residual_field,
    load_start_model,
    prepare_datasets,
    training_items,
    validation_batches,
)
from rafl.simulation.time_integration import INTEGRATORS

FitFunction = Callable[[list[Dataset], Settings, Path, Report, ProcessGroup], FittedModel]

METHODS: dict[str, FitFunction] = {
    "auto": fit_auto,
    "rafl": fit_residual_field,
    "srl": fit_supervised,
    **dict.fromkeys(METHOD_QUANTITIES, identify_material),
    "constitutive": fit_constitutive,
}
# Default maximum number of passes over the recordings (iterations of sysid).
DEFAULT_EPOCHS = {"rafl": 30, "srl": 1000, **dict.fromkeys(METHOD_QUANTITIES, 40), "constitutive": 12, "auto": 12}


def check_inputs(method: str, datasets: list[Dataset], start: Path | None, integrator: str) -> None:
    """Check that a method can be fitted to datasets, before anything is written.

    Args:
        method: one of `METHODS`.
        datasets: to train on.
        start: run that training starts from.
        integrator: to train with; empty for that of the start run or else of the datasets.

    Raises:
        InputError: an unknown method or integrator, datasets that differ in time integration, no training recordings,
            several meshes for srl, or a run that training cannot start from.
    """
    if method not in METHODS:
        raise InputError(f"--method: expected {', '.join(METHODS)}, found {method!r}")
    if integrator and integrator not in INTEGRATORS:
        raise InputError(f"--integrator: expected {' or '.join(INTEGRATORS)}, found {integrator!r}")
    if start is not None and method != "rafl":
        raise InputError(f"--from: expected method rafl, found {method}; add --method rafl, or leave it out")
    before = FittedModel(method) if start is None else load_start_model(start)
    _check_time_integration(datasets, before, integrator)
    training_items(datasets)
    if method == "srl":
        shared_vertex_count(datasets)


def check_measurements(datasets: list[Dataset], settings: Settings) -> None:
    """Check that there is something to fit to in every training recording, and to judge by in every validation one.

    Raises:
        InputError: nothing that the settings compare was measured of one after its first frame.
    """
    used = prepare_datasets(datasets, settings)
    for recordings in (*batches_by_dataset(training_items(used), settings), *validation_batches(used)):
        recordings.require_measurements()


def _check_time_integration(datasets: list[Dataset], before: FittedModel, integrator: str) -> None:
    """Check that all simulators integrate time alike, because a model belongs to one time integration.

    Raises:
        InputError: they differ in integrator or substeps.
    """
    integrations = {}
    for dataset in datasets:
        simulator = dataset.simulator if integrator else before.simulator(dataset.simulator)
        integrations[dataset.name] = (integrator or simulator.integrator, simulator.substeps)
    if len(set(integrations.values())) > 1:
        found = ", ".join(f"{name}: {scheme}, {substeps} substeps" for name, (scheme, substeps) in integrations.items())
        raise InputError(
            f"expected datasets with the same time integration, found {found}; set `simulation` in the specimen files "
            "and run rafl-capture again"
        )
