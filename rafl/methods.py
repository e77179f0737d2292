"""The methods that fit a model, all called alike."""

from collections.abc import Callable
from pathlib import Path

from groundwork import InputError
from rafl.dataset import Dataset
from rafl.fit import Report, fit_residual_field, model_to_go_on_from, training_items
from rafl.run import FittedModel, Settings
from rafl.supervised import fit_supervised, one_mesh
from rafl.sysid import SOUGHT, identify_material

Trainer = Callable[[list[Dataset], Settings, Path, Report], FittedModel]

METHODS: dict[str, Trainer] = {
    "rafl": fit_residual_field,
    "srl": fit_supervised,
    **dict.fromkeys(SOUGHT, identify_material),
}
EPOCHS = {"rafl": 30, "srl": 1000, **dict.fromkeys(SOUGHT, 40)}  # at most, where the user does not say


def check_inputs(method: str, datasets: list[Dataset], start: Path | None) -> None:
    """Refuses what a method cannot be fitted to, before anything is written.

    Args:
        method: to be.
        datasets: to train on.
        start: run to go on from.

    Raises:
        InputError: an unknown method, no training recordings, several meshes for srl, nothing to go on from.
    """
    if method not in METHODS:
        raise InputError(f"--method: expected {', '.join(METHODS)}, found {method!r}")
    training_items(datasets)
    if method == "srl":
        one_mesh(datasets)
    if start is not None:
        if method != "rafl":
            raise InputError(f"--from: expected method rafl, found {method}; leave it out")
        model_to_go_on_from(start)
