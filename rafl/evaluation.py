"""The paper's error of original and fitted simulators on recorded shapes."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from rafl.dataset import SPLITS, Dataset
from rafl.objective import Recordings, frame_errors
from rafl.run import FittedModel

ORIGINAL = "original"


@dataclass(frozen=True)
class Comparison:
    """One recording simulated by every method.

    Attributes:
        dataset, recording, split: which.
        time: [s], (T).
        recorded: markers [m], (T, M, 3), NaN where not seen.
        simulated: by method, markers [m], (T, M, 3).
        errors: by method, mean marker distance of each frame with a marker seen [m], (T').
        error_time: the times of those frames [s], (T').
        marker_names: (M).
    """

    dataset: str
    recording: str
    split: str
    time: NDArray[np.float64]
    recorded: NDArray[np.float64]
    simulated: dict[str, NDArray[np.float64]]
    errors: dict[str, NDArray[np.float64]]
    error_time: NDArray[np.float64]
    marker_names: tuple[str, ...]


def compare(dataset: Dataset, models: dict[str, FittedModel]) -> list[Comparison]:
    """Simulate every recording of a dataset untouched and with each model.

    Raises:
        SimulationError: a rollout failed; names recording and step.
    """
    names = list(dataset.trajectories)
    recordings = Recordings.of(dataset, names)
    simulated, errors = {}, {}
    with torch.no_grad():
        for method, model in {ORIGINAL: FittedModel(ORIGINAL), **models}.items():
            markers, _ = recordings.simulate(model.residual(dataset.simulator), model.parameters(dataset.simulator))
            simulated[method] = markers.numpy()
            errors[method] = frame_errors(recordings, markers)
    result = []
    for b, name in enumerate(names):
        item = dataset.trajectories[name]
        seen = item.valid.any(axis=1)
        result.append(
            Comparison(
                dataset.name,
                name,
                item.split,
                item.time,
                np.where(item.valid[..., None], item.markers, np.nan),
                {method: markers[: len(item.time), b] for method, markers in simulated.items()},
                {method: values[b] for method, values in errors.items()},
                item.time[seen],
                dataset.markers.names,
            )
        )
    return result


def error_table(comparisons: list[Comparison]) -> pd.DataFrame:
    """A row a recording and method: dataset, recording, split, method, mean_mm, std_mm."""
    return pd.DataFrame(
        [
            {
                "dataset": item.dataset,
                "recording": item.recording,
                "split": item.split,
                "method": method,
                "mean_mm": 1e3 * errors.mean(),
                "std_mm": 1e3 * errors.std(),
            }
            for item in comparisons
            for method, errors in item.errors.items()
        ]
    )


def split_table(comparisons: list[Comparison]) -> pd.DataFrame:
    """A row a dataset, split and method, over all its recordings and frames.

    +- is the paper's: the standard deviation over all (recording, frame) of the frame's mean.
    """
    rows = []
    datasets = dict.fromkeys(item.dataset for item in comparisons)
    for dataset in datasets:
        for split in SPLITS:
            chosen = [item for item in comparisons if (item.dataset, item.split) == (dataset, split)]
            for method in chosen[0].errors if chosen else ():
                errors = 1e3 * np.concatenate([item.errors[method] for item in chosen])
                rows.append(
                    {
                        "dataset": dataset,
                        "split": split,
                        "recordings": len(chosen),
                        "method": method,
                        "mean_mm": errors.mean(),
                        "std_mm": errors.std(),
                    }
                )
    return pd.DataFrame(rows)


def held_out_errors(comparisons: list[Comparison]) -> dict[str, float]:
    """Mean error [m] by method over the test recordings of all datasets; empty without any."""
    chosen = [item for item in comparisons if item.split == "test"]
    if not chosen:
        return {}
    return {
        method: float(np.concatenate([item.errors[method] for item in chosen]).mean()) for method in chosen[0].errors
    }
