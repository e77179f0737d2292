"""Marker errors of the baseline simulator and of fitted models on recordings, as the paper defines them."""

from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from rafl.common.errors import SimulationError
from rafl.data.dataset import SPLITS, Dataset
from rafl.data.objective import Recordings, marker_distances
from rafl.data.strain_range import StrainRange
from rafl.evaluation.oscillation import fit_oscillation, most_active_coordinate
from rafl.evaluation.rest_position import rest_distances
from rafl.evaluation.surface import Surface, SurfaceMotion
from rafl.fitting.run_folder import FittedModel

BASELINE = "original"  # name of the baseline simulator in tables and files


@dataclass(frozen=True)
class Comparison:
    """One recording and its simulation by every method.

    Attributes:
        dataset, recording, split: names of the dataset, the recording and its split.
        time: [s], (T).
        recorded: marker positions [m], (T, M, 3), NaN where not seen.
        simulated: by method, marker positions [m], (T, M, 3).
        distances: by method, distances of the markers from what was seen of them [m], (T, M), NaN where nothing was;
            see `rafl.data.objective.marker_distances`.
        rest_distances: by method, distances between simulated and recorded rest positions [m], (M), NaN for markers not
            seen at the end; see `rafl.evaluation.rest_position`.
        marker_names: (M).
        surface: boundary of the specimen's mesh.
        motions: by method, the motion of that boundary; empty where it was not kept.
        strains: by method, strain and strain rate [1/s] that the body reaches, see `rafl.data.strain_range`.
    """

    dataset: str
    recording: str
    split: str
    time: NDArray[np.float64]
    recorded: NDArray[np.float64]
    simulated: dict[str, NDArray[np.float64]]
    distances: dict[str, NDArray[np.float64]]
    rest_distances: dict[str, NDArray[np.float64]]
    marker_names: tuple[str, ...]
    surface: Surface
    motions: dict[str, SurfaceMotion]
    strains: dict[str, StrainRange]

    @cached_property
    def _seen(self) -> NDArray[np.bool_]:
        """Frames in which a marker was seen, (T)."""
        distances = next(iter(self.distances.values()), np.full(self.recorded.shape[:2], np.nan))
        return np.asarray(np.isfinite(distances).any(axis=1))

    @cached_property
    def errors(self) -> dict[str, NDArray[np.float64]]:
        """By method, mean distance of the seen markers [m] in each frame that has any, (T')."""
        return {method: np.nanmean(distance[self._seen], axis=1) for method, distance in self.distances.items()}

    @property
    def error_time(self) -> NDArray[np.float64]:
        """The times of those frames [s], (T')."""
        return self.time[self._seen]


def compare(dataset: Dataset, models: dict[str, FittedModel]) -> list[Comparison]:
    """Simulate every recording of a dataset with the baseline simulator and with each model.

    Raises:
        SimulationError: a rollout failed; the message names recording and step.
        InputError: a model is not applicable to this mesh, or nothing was measured of a recording after its first
            frame.
    """
    names = list(dataset.trajectories)
    recordings = Recordings.of(dataset, names)
    recordings.require_measurements()
    mesh, lengths = dataset.simulator.mesh, [len(dataset.trajectories[name].time) for name in names]
    simulated, distances, at_rest, motions, strains = {}, {}, {}, {}, {}
    with torch.no_grad():
        for method, model in {BASELINE: FittedModel(BASELINE), **models}.items():
            simulator = model.simulator(dataset.simulator)
            simulate = recordings.in_simulator(simulator).simulate_vertices
            q, force = simulate(model.residual(simulator), model.parameters(simulator))
            markers = dataset.markers.positions(q)
            simulated[method] = markers.numpy()
            forces = force.numpy() if force.numel() else None
            motions[method] = [
                SurfaceMotion.of(mesh, q[:frames, b].numpy(), None if forces is None else forces[: frames - 1, b])
                for b, frames in enumerate(lengths)
            ]
            strains[method] = [
                StrainRange.of(simulator.mesh, q[:, b : b + 1], simulator.time_step) for b in range(len(names))
            ]
            distances[method] = marker_distances(recordings, markers).numpy()
            at_rest[method] = rest_distances(recordings, markers)
    result, surface = [], Surface.of(mesh)
    for b, name in enumerate(names):
        item = dataset.trajectories[name]
        result.append(
            Comparison(
                dataset.name,
                name,
                item.split,
                item.time,
                np.where(item.valid[..., None], item.markers, np.nan),
                {method: markers[: len(item.time), b] for method, markers in simulated.items()},
                {method: values[: len(item.time), b] for method, values in distances.items()},
                {method: values[b] for method, values in at_rest.items()},
                dataset.markers.names,
                surface,
                {method: values[b] for method, values in motions.items()},
                {method: values[b] for method, values in strains.items()},
            )
        )
    return result


def compare_skipping_failures(
    dataset: Dataset, models: dict[str, FittedModel]
) -> tuple[list[Comparison], dict[str, SimulationError]]:
    """`compare` without the models whose simulation fails.

    Returns:
        The comparisons, and by name of each model left out the error of its simulation.

    Raises:
        SimulationError: a rollout of the baseline simulator failed.
        InputError: a model is not applicable to this mesh.
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


def beyond_training(comparisons: list[Comparison], models: dict[str, FittedModel]) -> list[str]:
    """One sentence for every model and dataset with motions beyond the strain or the rate of the model's training."""
    sentences = []
    for name, model in models.items():
        for dataset in dict.fromkeys(item.dataset for item in comparisons):
            own = [item.strains[name] for item in comparisons if item.dataset == dataset and name in item.strains]
            if model.seen is None or not own:
                continue
            seen = StrainRange(*model.seen)
            found = reduce(StrainRange.united, own)
            if found.exceeds(seen):
                sentences.append(
                    f"{dataset}: strains up to {100 * found.strain:.2g} % and {found.rate:.2g} 1/s, where the training "
                    f"of {name} reached {100 * seen.strain:.2g} % and {seen.rate:.2g} 1/s: its errors there may grow"
                )
    return sentences


def error_table(comparisons: list[Comparison]) -> pd.DataFrame:
    """One row per recording and method, with columns dataset, recording, split, method, mean_mm, std_mm."""
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
    """One row per dataset, split and method, over all recordings and frames of the split.

    As in the paper, std_mm is the standard deviation over all (recording, frame) of the mean error of the frame.
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
    """Oscillation of the most active marker and error of the rest positions, for the recording and every method.

    Columns dataset, recording, split, method (`recorded` first), frequency_hz, damping_ratio, final_error_mm.
    """
    rows = []
    for item in comparisons:
        marker, axis = most_active_coordinate(item.recorded)
        for method, markers in {"recorded": item.recorded, **item.simulated}.items():
            fitted = fit_oscillation(item.time, markers[:, marker, axis])
            final = item.rest_distances.get(method, np.zeros(1))  # of the recording itself
            rows.append(
                {
                    "dataset": item.dataset,
                    "recording": item.recording,
                    "split": item.split,
                    "method": method,
                    "frequency_hz": fitted.frequency,
                    "damping_ratio": fitted.damping,
                    "final_error_mm": 1e3 * final[seen].mean() if (seen := np.isfinite(final)).any() else np.nan,
                }
            )
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class Transfer:
    """Errors of each model on each dataset.

    Attributes:
        errors: mean errors [mm] of the test recordings (of all, if a dataset has none), one row per method.
        negative_transfers: by fitted method, the number of datasets on which it is worse than the baseline simulator.
        datasets_simulated: by fitted method, the number of datasets that it simulates.
    """

    errors: pd.DataFrame
    negative_transfers: dict[str, int]
    datasets_simulated: dict[str, int]

    @classmethod
    def of(cls, splits: pd.DataFrame) -> "Transfer":
        """Collect the errors from a `split_table`."""
        test = splits[splits["split"] == "test"]
        other = splits[~splits["dataset"].isin(test["dataset"])]
        sums = other.assign(total=other["mean_mm"] * other["recordings"]).groupby(["dataset", "method"], sort=False)
        pooled = (sums["total"].sum() / sums["recordings"].sum()).rename("mean_mm").reset_index()
        means = pd.concat([test[["dataset", "method", "mean_mm"]], pooled]) if len(pooled) else test
        errors = means.pivot(index="method", columns="dataset", values="mean_mm")
        errors = errors.loc[list(dict.fromkeys(splits["method"])), list(dict.fromkeys(splits["dataset"]))]
        fitted = errors.drop(index=BASELINE)
        worse = fitted.gt(errors.loc[BASELINE], axis="columns").sum(axis=1)
        simulated = fitted.notna().sum(axis=1)
        negative, applied = ({str(method): int(n) for method, n in counts.items()} for counts in (worse, simulated))
        return cls(errors, negative, applied)


def latex_table(splits: pd.DataFrame) -> str:
    """The test errors as a LaTeX tabular. Underlined: better than the baseline simulator. Bold: best of the row."""
    test = splits[splits["split"] == "test"]
    test = test if len(test) else splits
    methods = list(dict.fromkeys(test["method"]))
    lines = [r"\begin{tabular}{l" + "c" * len(methods) + "}", r"\toprule"]
    lines += ["Dataset & " + " & ".join(map(_latex_text, methods)) + r" \\", r"\midrule"]
    for dataset, group in test.groupby("dataset", sort=False):
        means, stds = (dict(zip(group["method"], group[key], strict=True)) for key in ("mean_mm", "std_mm"))
        cells = []
        for method in methods:
            if method not in means:
                cells.append("N/A")
                continue
            cell = rf"{means[method]:.3f} \pm {stds[method]:.3f}"
            cell = rf"\mathbf{{{cell}}}" if means[method] == min(means.values()) else cell
            cell = rf"\underline{{{cell}}}" if means[method] < means[BASELINE] else cell
            cells.append(f"${cell}$")
        lines.append(f"{_latex_text(str(dataset))} & " + " & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


LATEX_CHARACTERS = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


def _latex_text(text: str) -> str:
    """A name as LaTeX prints it: characters with a meaning of their own are escaped."""
    return "".join(LATEX_CHARACTERS.get(character, character) for character in text)


def held_out_errors(comparisons: list[Comparison]) -> dict[str, float]:
    """Mean error [m] over the test recordings of all datasets, by method that simulates them all.

    Empty if no recording has split `test`.
    """
    chosen = [item for item in comparisons if item.split == "test"]
    methods = dict.fromkeys(method for item in chosen for method in item.errors)
    return {
        method: float(np.concatenate([item.errors[method] for item in chosen]).mean())
        for method in methods
        if all(method in item.errors for item in chosen)
    }
