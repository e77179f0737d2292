"""The methods that fit a model, all called alike."""

from collections.abc import Callable
from pathlib import Path

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.fitting.run_folder import FittedModel, Settings
from rafl.fitting.supervised import fit_supervised, one_mesh
from rafl.fitting.sysid import SOUGHT, identify_material
from rafl.fitting.train_field import Report, fit_residual_field, model_to_go_on_from, training_items
from rafl.simulation.time_integration import INTEGRATORS

Trainer = Callable[[list[Dataset], Settings, Path, Report], FittedModel]

METHODS: dict[str, Trainer] = {
    "rafl": fit_residual_field,
    "srl": fit_supervised,
    **dict.fromkeys(SOUGHT, identify_material),
}
EPOCHS = {"rafl": 30, "srl": 1000, **dict.fromkeys(SOUGHT, 40)}  # at most, where the user does not say


def check_inputs(method: str, datasets: list[Dataset], start: Path | None, integrator: str) -> None:
    """Refuses what a method cannot be fitted to, before anything is written.

    Args:
        method: to be.
        datasets: to train on.
        start: run to go on from.
        integrator: to train with; the run's or the datasets' own where empty.

    Raises:
        InputError: an unknown method or integrator, datasets that step differently, no training recordings, several
            meshes for srl, nothing to go on from.
    """
    if method not in METHODS:
        raise InputError(f"--method: expected {', '.join(METHODS)}, found {method!r}")
    if integrator and integrator not in INTEGRATORS:
        raise InputError(f"--integrator: expected {' or '.join(INTEGRATORS)}, found {integrator!r}")
    if start is not None and method != "rafl":
        raise InputError(f"--from: expected method rafl, found {method}; leave it out")
    before = FittedModel(method) if start is None else model_to_go_on_from(start)
    _one_stepping(datasets, before, integrator)
    training_items(datasets)
    if method == "srl":
        one_mesh(datasets)


def _one_stepping(datasets: list[Dataset], before: FittedModel, integrator: str) -> None:
    """Refuses datasets whose simulators would step differently: a model is of one way to step."""
    ways = {}
    for dataset in datasets:
        simulator = dataset.simulator if integrator else before.simulator(dataset.simulator)
        ways[dataset.name] = (integrator or simulator.integrator, simulator.substeps)
    if len(set(ways.values())) > 1:
        found = ", ".join(f"{name}: {way}, {substeps} substeps" for name, (way, substeps) in ways.items())
        raise InputError(
            f"expected datasets whose simulators step alike, found {found}; set `simulation` in the specimen files and "
            "run rafl-capture again"
        )
