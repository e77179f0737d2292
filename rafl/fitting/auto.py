"""The default fit: several models from simple to complex, judged on recordings that each of them has not seen."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from rafl.common.errors import SimulationError
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.data.strain_range import StrainRange
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.fitting.gauss_newton import GOOD, Minimum
from rafl.fitting.material_search import MaterialSearch
from rafl.fitting.run_folder import FittedModel, History, Report, Settings, save_model
from rafl.fitting.sysid import BRANCHES, add_constitutive_residual, branches_search
from rafl.fitting.train_field import prepare_datasets, recording_errors, training_items
from rafl.simulation.rollout import rollout

SELECTION_FILE = "selection.csv"
ASSUMED = "original"
FREE_RUN = 3.0  # [s] for which the recording of the largest motion is simulated
# Without a second recording to judge by, a model must lower the error by this much to be kept.
MIN_GAIN = 0.1


@dataclass(frozen=True)
class Candidate:
    """A model and its errors on recordings that it has not seen.

    Attributes:
        name: `original` for the assumed material, or a method.
        model: the model, fitted to all training recordings.
        errors: mean marker error of each recording or dataset that was left out [m], (G); infinite if a simulation
            fails or gains energy.
    """

    name: str
    model: FittedModel
    errors: NDArray[np.float64]


def fit_auto(
    datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: ProcessGroup = ALONE
) -> FittedModel:
    """Identify the material, fit a constitutive residual on top, and keep the simplest model that predicts as well.

    The candidates are the assumed material; E, nu and Maxwell branches; and these with a learned strain energy and
    viscosity. Each is judged by its error on the validation recordings and on every training recording as predicted
    from the others; with several datasets, on every dataset as predicted from the others. A candidate is kept if no
    later one has a smaller error by more than the standard error of the difference. One that cannot simulate what it is
    judged by, or whose free run of some seconds gains energy, is not kept.

    `selection.csv` in the run holds the errors of all candidates.

    Raises:
        InputError: no training recordings.
        SimulationError: the assumed material itself cannot be simulated.
    """
    training_items(datasets)
    history = History(run, report, group)
    judge = _Judge(prepare_datasets(datasets, settings), group)
    model = FittedModel(ASSUMED)
    candidates = [Candidate(ASSUMED, model, judge.assumed_errors(model))]
    tables: dict[str, str] = {}

    def consider(name: str, search: MaterialSearch, minimum: Minimum) -> None:
        fitted = replace(search.model(minimum.x), method=name)
        candidates.append(Candidate(name, fitted, judge.errors(fitted, search, minimum)))
        tables[name] = search.parameter_table(minimum)
        if group.is_main:
            write_text(run / f"parameters-{name}.csv", tables[name])

    branches, start = branches_search(datasets, settings, history, run / f"checkpoint-{BRANCHES}.pt", with_prior=True)
    minimum = branches.descend(start, settings.epochs, GOOD)
    consider(BRANCHES, branches, minimum)
    learned = add_constitutive_residual(branches, minimum, datasets, run / "checkpoint-constitutive.pt")
    minimum = learned.descend(learned.prior.mean, settings.epochs, GOOD)
    consider("constitutive", learned, minimum)

    chosen = choose(candidates, judge.groups)
    kept = replace(chosen.model, seen=judge.seen(chosen.model))
    if group.is_main:
        write_text(run / SELECTION_FILE, _table(candidates, chosen).to_csv(index=False, float_format="%.6g"))
        save_model(run, kept)
        if chosen.name in tables:
            write_text(run / "parameters.csv", tables[chosen.name])
    return kept


def choose(candidates: list[Candidate], groups: int) -> Candidate:
    """The first candidate that no later one beats by more than the standard error of the mean difference.

    groups: number of recordings or datasets that were left out; without any, the identified material of fewest
    parameters is kept.
    """
    usable = [each for each in candidates if np.isfinite(each.errors).all()]
    if groups == 0:
        return usable[min(1, len(usable) - 1)]
    for k, simple in enumerate(usable):
        gains = [simple.errors - other.errors for other in usable[k + 1 :]]
        if not any(gain.mean() > _uncertainty(gain, simple.errors) for gain in gains):
            break
    return simple


def _uncertainty(gain: NDArray[np.float64], error: NDArray[np.float64]) -> float:
    """Standard error of a mean gain; of a single one, the gain that counts."""
    if len(gain) == 1:
        return MIN_GAIN * float(error[0])
    return _standard_error(gain)


def _standard_error(values: NDArray[np.float64]) -> float:
    """Standard error of the mean of values (G); NaN for fewer than two, or if some are infinite."""
    if len(values) < 2 or not np.isfinite(values).all():
        return np.nan
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def _table(candidates: list[Candidate], chosen: Candidate) -> pd.DataFrame:
    rows = []
    for item in candidates:
        count = len(item.errors)
        rows.append(
            {
                "model": item.name,
                "left_out_mm": 1e3 * item.errors.mean() if count else np.nan,
                "standard_error_mm": 1e3 * _standard_error(item.errors),
                "left_out": count,
                "kept": item is chosen,
            }
        )
    return pd.DataFrame(rows)


def selection_sentences(table: pd.DataFrame, model: FittedModel) -> list[str]:
    """Two sentences: what was kept and how sure it is, and where it is a guess; `table` is `selection.csv`."""
    kept = table[table["kept"]].iloc[0]
    others = ", ".join(_judged(row.model, row.left_out_mm) for row in table.itertuples() if not row.kept)
    if kept["left_out"] == 0:
        first = f"kept {kept['model']}, of few parameters, because no second recording was there to judge by."
    else:
        spread = f" +- {kept['standard_error_mm']:.2g}" if np.isfinite(kept["standard_error_mm"]) else ""
        first = (
            f"kept {kept['model']}: on what was left out ({kept['left_out']:.0f} in turn) its error is "
            f"{kept['left_out_mm']:.3g}{spread} mm ({others})."
        )
    if model.seen is None:
        return [first]
    strain, rate = model.seen
    second = (
        f"It has seen strains up to {100 * strain:.2g} % and {rate:.2g} 1/s: for shapes or loads that strain the body "
        "more, such as thinner or longer ones, it is a guess."
    )
    return [first, second]


def _judged(name: str, error: float) -> str:
    return f"{name} {error:.3g} mm" if np.isfinite(error) else f"{name} cannot be simulated"


class _Judge:
    """What candidates are judged by: recordings left out of the training, and free runs."""

    def __init__(self, datasets: list[Dataset], group: ProcessGroup) -> None:
        self.group = group
        self.training = [Recordings.of(d, d.split("train")) for d in datasets if d.split("train")]
        self.validation = [Recordings.of(d, d.split("val")) for d in datasets if d.split("val")]
        counts = [len(recordings.names) for recordings in self.training]
        indices = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
        by_dataset = len(counts) > 1
        chosen = indices if by_dataset else [np.array([k]) for k in indices[0]]
        self.left_out: list[list[int]] = [each.tolist() for each in chosen] if len(chosen) > 1 else []
        self.groups = len(self.left_out) + sum(len(recordings.names) for recordings in self.validation)

    def assumed_errors(self, model: FittedModel) -> NDArray[np.float64]:
        """Errors [m] of a model that was not fitted, on the same groups as those of the others, (G)."""
        own = self._simulated_errors(self.training, model)
        grouped = [own[group].mean() for group in self.left_out]
        return np.concatenate([grouped, self._simulated_errors(self.validation, model)])

    def errors(self, model: FittedModel, search: MaterialSearch, minimum: Minimum) -> NDArray[np.float64]:
        """Errors [m] of a model where a search ended, on what was left out, (G); infinite if it must not be kept."""
        try:
            grouped = search.left_out_errors(minimum, self.left_out) if self.left_out else []
            errors = np.concatenate([grouped, self._simulated_errors(self.validation, model)])
        except SimulationError:
            return np.full(max(self.groups, 1), np.inf)
        return errors if self._stays_calm(model) else np.full(max(self.groups, 1), np.inf)

    def _simulated_errors(self, batches: list[Recordings], model: FittedModel) -> NDArray[np.float64]:
        """Mean error of every recording [m], (R)."""
        sums, frames = recording_errors(batches, model, self.group)
        return sums / frames

    def _stays_calm(self, model: FittedModel) -> bool:
        """Whether a free run of the recording of the largest motion ends, and ends slower than it began."""
        recordings = max(self.training, key=lambda each: float(each.square_motion.max()))
        own = int(np.argmax(recordings.square_motion))
        simulator = model.simulator(recordings.dataset.simulator)
        start = recordings.dataset.start([recordings.names[own]])
        steps = round(FREE_RUN / simulator.time_step)

        def compute() -> bool:
            try:
                with torch.no_grad():
                    positions, _ = rollout(simulator, start, steps, parameters=model.parameters(simulator))
            except SimulationError:
                return False
            speed = torch.diff(positions, dim=0).square().sum((1, 2, 3))
            quarter = max(steps // 4, 1)
            return bool(speed[-quarter:].mean() <= speed[:quarter].mean())

        return self.group.on_main(compute)

    def seen(self, model: FittedModel) -> tuple[float, float]:
        """Strain and strain rate [1/s] that the training recordings reach, as the model simulates them."""

        def compute() -> list[float]:  # by one process, for the range is that of all recordings together
            found = StrainRange(0.0, 0.0)
            for recordings in self.training:
                simulator = model.simulator(recordings.dataset.simulator)
                with torch.no_grad():
                    positions, _ = recordings.in_simulator(simulator).simulate_vertices(
                        parameters=model.parameters(simulator)
                    )
                found = found.united(StrainRange.of(simulator.mesh, positions, simulator.time_step))
            return [found.strain, found.rate]

        strain, rate = self.group.on_main(compute)
        return strain, rate
