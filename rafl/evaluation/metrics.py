"""The paper's error of original and fitted simulators on recorded shapes."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from rafl.common.errors import SimulationError
from rafl.data.dataset import SPLITS, Dataset
from rafl.data.objective import Recordings, frame_errors
from rafl.evaluation.oscillation import liveliest, oscillation, resting_error
from rafl.fem.mesh import HexMesh
from rafl.fitting.run_folder import FittedModel

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
        mesh: of the specimen.
        shapes: by method, vertices in the first and last frame [m], (2, N, 3).
        force: by method that has a residual force, its mean size at every vertex [N], (N).
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
    mesh: HexMesh
    shapes: dict[str, NDArray[np.float64]]
    force: dict[str, NDArray[np.float64]]


def compare(dataset: Dataset, models: dict[str, FittedModel]) -> list[Comparison]:
    """Simulate every recording of a dataset untouched and with each model.

    Raises:
        SimulationError: a rollout failed; names recording and step.
        InputError: a model that does not act on this mesh.
    """
    names = list(dataset.trajectories)
    recordings = Recordings.of(dataset, names)
    simulated, errors, shapes, sizes = {}, {}, {}, {}
    with torch.no_grad():
        for method, model in {ORIGINAL: FittedModel(ORIGINAL), **models}.items():
            simulator = model.simulator(dataset.simulator)
            motion = recordings.in_simulator(simulator).motion
            q, force = motion(model.residual(simulator), model.parameters(simulator))
            markers = dataset.markers.positions(q)
            simulated[method] = markers.numpy()
            shapes[method] = q.numpy()
            if force.numel():
                sizes[method] = torch.linalg.norm(force, dim=-1).numpy()
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
                dataset.simulator.mesh,
                {method: q[[0, len(item.time) - 1], b] for method, q in shapes.items()},
                {method: size[: len(item.time) - 1, b].mean(0) for method, size in sizes.items()},
            )
        )
    return result


def compare_those_that_simulate(
    dataset: Dataset, models: dict[str, FittedModel]
) -> tuple[list[Comparison], dict[str, SimulationError]]:
    """`compare`, and by model why a simulation with it fails, where one does.

    Raises:
        SimulationError: a rollout of the untouched simulator failed.
        InputError: a model that does not act on this mesh.
    """
    try:
        return compare(dataset, models), {}
    except SimulationError:
        failures: dict[str, SimulationError] = {}
        for name, model in models.items():
            try:
                compare(dataset, {name: model})
            except SimulationError as error:
                failures[name] = error
    return compare(dataset, {name: models[name] for name in models if name not in failures}), failures


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


def motion_table(comparisons: list[Comparison]) -> pd.DataFrame:
    """Frequency, damping and final equilibrium of the marker that moves most, recorded and by method.

    Columns dataset, recording, split, method (`recorded` first), frequency_hz, damping_ratio, final_error_mm.
    """
    rows = []
    for item in comparisons:
        marker, axis = liveliest(item.recorded)
        for method, markers in {"recorded": item.recorded, **item.simulated}.items():
            swing = oscillation(item.time, markers[:, marker, axis])
            rows.append(
                {
                    "dataset": item.dataset,
                    "recording": item.recording,
                    "split": item.split,
                    "method": method,
                    "frequency_hz": swing.frequency,
                    "damping_ratio": swing.damping,
                    "final_error_mm": 1e3 * resting_error(item.recorded, markers),
                }
            )
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class Transfer:
    """Each model on each dataset.

    Attributes:
        errors: mean errors [mm] of the test recordings (of all, where a dataset has none), a row a method.
        negative: by fitted method, on how many datasets it is worse than the untouched simulator.
        tried: by fitted method, on how many datasets it acts.
    """

    errors: pd.DataFrame
    negative: dict[str, int]
    tried: dict[str, int]

    @classmethod
    def of(cls, splits: pd.DataFrame) -> "Transfer":
        """From `split_table`."""
        test = splits[splits["split"] == "test"]
        rest = splits[~splits["dataset"].isin(test["dataset"])]
        pooled = rest.assign(total=rest["mean_mm"] * rest["recordings"]).groupby(["dataset", "method"], sort=False)
        others = (pooled["total"].sum() / pooled["recordings"].sum()).rename("mean_mm").reset_index()
        every = pd.concat([test[["dataset", "method", "mean_mm"]], others]) if len(others) else test
        errors = every.pivot(index="method", columns="dataset", values="mean_mm")
        errors = errors.loc[list(dict.fromkeys(splits["method"])), list(dict.fromkeys(splits["dataset"]))]
        fitted = errors.drop(index=ORIGINAL)
        worse = fitted.gt(errors.loc[ORIGINAL], axis="columns").sum(axis=1)
        tried = fitted.notna().sum(axis=1)
        negative, acting = ({str(method): int(n) for method, n in counts.items()} for counts in (worse, tried))
        return cls(errors, negative, acting)


def latex_table(splits: pd.DataFrame) -> str:
    """The test errors as a LaTeX tabular: better than the original underlined, the best of a row bold."""
    test = splits[splits["split"] == "test"]
    test = test if len(test) else splits
    methods = list(dict.fromkeys(test["method"]))
    lines = [r"\begin{tabular}{l" + "c" * len(methods) + "}", r"\toprule"]
    lines += ["Dataset & " + " & ".join(methods) + r" \\", r"\midrule"]
    for dataset, group in test.groupby("dataset", sort=False):
        means, stds = (dict(zip(group["method"], group[key], strict=True)) for key in ("mean_mm", "std_mm"))
        cells = []
        for method in methods:
            if method not in means:
                cells.append("N/A")
                continue
            cell = rf"{means[method]:.3f} \pm {stds[method]:.3f}"
            cell = rf"\mathbf{{{cell}}}" if means[method] == min(means.values()) else cell
            cell = rf"\underline{{{cell}}}" if means[method] < means[ORIGINAL] else cell
            cells.append(f"${cell}$")
        lines.append(f"{dataset} & " + " & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def held_out_errors(comparisons: list[Comparison]) -> dict[str, float]:
    """Mean error [m] over the test recordings of all datasets, by method that acts on them all; empty without any."""
    chosen = [item for item in comparisons if item.split == "test"]
    methods = dict.fromkeys(method for item in chosen for method in item.errors)
    return {
        method: float(np.concatenate([item.errors[method] for item in chosen]).mean())
        for method in methods
        if all(method in item.errors for item in chosen)
    }
