"""From videos of a dotted soft specimen to a physics model that predicts shapes never filmed.

The names below are the public interface. Each is imported when it is first used, so `import rafl` is quick.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

from rafl.common.version import VERSION

if TYPE_CHECKING:
    from rafl.api import (
        CaptureSettings,
        CorrectedTracks,
        Dataset,
        FittedModel,
        HexMesh,
        InputError,
        Markers,
        Material,
        Parameters,
        ResidualField,
        ResidualForce,
        ResidualModel,
        Rig,
        Simulation,
        SimulationError,
        Simulator,
        Specimen,
        Start,
        Tracks,
        Trajectory,
        View,
        build_dataset,
        calibrate,
        equilibrium,
        evaluate,
        fit,
        load_model,
        predict,
        read_calibration,
        read_corrected_tracks,
        read_dataset,
        read_specimen,
        read_tracks,
        register_law,
        rollout,
        simulate,
        track,
        write_calibration,
        write_dataset,
        write_tracks,
    )

__all__ = [
    "CaptureSettings",
    "CorrectedTracks",
    "Dataset",
    "FittedModel",
    "HexMesh",
    "InputError",
    "Markers",
    "Material",
    "Parameters",
    "ResidualField",
    "ResidualForce",
    "ResidualModel",
    "Rig",
    "Simulation",
    "SimulationError",
    "Simulator",
    "Specimen",
    "Start",
    "Tracks",
    "Trajectory",
    "View",
    "__version__",
    "build_dataset",
    "calibrate",
    "equilibrium",
    "evaluate",
    "fit",
    "load_model",
    "predict",
    "read_calibration",
    "read_corrected_tracks",
    "read_dataset",
    "read_specimen",
    "read_tracks",
    "register_law",
    "rollout",
    "simulate",
    "track",
    "write_calibration",
    "write_dataset",
    "write_tracks",
]

__version__ = VERSION

# A waiting kernel thread spins only briefly: on a busy machine the thread that it waits for may not be running.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'rafl' has no attribute {name!r}")
    return getattr(importlib.import_module("rafl.api"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
