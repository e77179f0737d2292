"""The methods that fit a model, all called alike."""

from collections.abc import Callable
from pathlib import Path

from rafl.dataset import Dataset
from rafl.fit import Report, fit_residual_field
from rafl.run import FittedModel, Settings
from rafl.supervised import fit_supervised
from rafl.sysid import SOUGHT, identify_material

Trainer = Callable[[list[Dataset], Settings, Path, Report], FittedModel]

METHODS: dict[str, Trainer] = {
    "rafl": fit_residual_field,
    "srl": fit_supervised,
    **dict.fromkeys(SOUGHT, identify_material),
}
EPOCHS = {"rafl": 60, "srl": 1000, **dict.fromkeys(SOUGHT, 40)}  # at most, where the user does not say
