"""System identification by exact gradients (paper, SysID baseline), and the constitutive residual on top of it."""

import itertools
from pathlib import Path

import numpy as np
import pandas as pd

from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.fitting.gauss_newton import Minimum, Prior
from rafl.fitting.material_search import History, MaterialSearch
from rafl.fitting.quantities import METHOD_QUANTITIES
from rafl.fitting.run_folder import FittedModel, Settings, save_model
from rafl.fitting.train_field import Report

MIN_REPORTED_CORRELATION = 0.9
MATERIAL_BELOW = "sysid-branches"  # the material that a constitutive residual begins from
# Standard deviations of the material's variables around the material found, where a constitutive residual is added: of
# log E, of the others.
KEPT_DEVIATIONS = 0.05, 1.0


def identify_material(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Fit material parameters to the training recordings by least squares within bounds, from several starting points.

    Gradients are exact; the Gauss-Newton matrix is from differences of simulations that run as one batch.

    The search starts from the datasets' assumed material and from a softer and a stiffer one, on the first frames of
    the recordings. The best result continues with more frames, and finally with all. `parameters.csv` in the run
    holds the values, their 95 % intervals and their correlations. A resumed run reads earlier simulations from its
    checkpoint and does not repeat them.

    Raises:
        InputError: no training recordings.
        SimulationError: the assumed material itself cannot be simulated.
    """
    history = History(run, report)
    quantities = METHOD_QUANTITIES[settings.method]
    search = MaterialSearch(datasets, settings, quantities, history, run / "checkpoint.pt")
    return _save(search, search.solve(), run)


def fit_constitutive(datasets: list[Dataset], settings: Settings, run: Path, report: Report) -> FittedModel:
    """Fit a learned strain energy and a learned viscosity together with the material, after the material alone.

    The files in the run are those of `identify_material`.

    Raises:
        InputError: no training recordings.
        SimulationError: the assumed material itself cannot be simulated.
    """
    history = History(run, report)
    below = MaterialSearch(
        datasets, settings, METHOD_QUANTITIES[MATERIAL_BELOW], history, run / "checkpoint-material.pt"
    )
    minimum = below.solve()
    search = add_constitutive_residual(below, minimum, datasets, run / "checkpoint.pt")
    return _save(search, search.descend(search.prior.mean, settings.epochs), run)


def add_constitutive_residual(
    below: MaterialSearch, minimum: Minimum, datasets: list[Dataset], checkpoint: Path
) -> MaterialSearch:
    """A search for a constitutive residual too, after a search for the material that ended at a minimum.

    It should start at its prior: the material found, and no residual.
    """
    quantities = METHOD_QUANTITIES["constitutive"]
    learned = np.array([quantity.learned for quantity in quantities])
    mean = np.concatenate([minimum.x, np.zeros(learned.sum())])
    deviation = np.where(learned, [quantity.deviation for quantity in quantities], KEPT_DEVIATIONS[1])
    deviation[0] = KEPT_DEVIATIONS[0]
    prior = Prior(mean, deviation)
    search = MaterialSearch(datasets, below.settings, quantities, below.history, checkpoint, prior)
    search.use_frames(1.0)
    return search


def _save(search: MaterialSearch, minimum: Minimum, run: Path) -> FittedModel:
    model = search.model(minimum.x)
    save_model(run, model)
    write_text(run / "parameters.csv", search.parameter_table(minimum))
    return model


def parameter_sentences(table: pd.DataFrame) -> list[str]:
    """Sentences about the identified parameters, learned weights left out; `table` is `parameters.csv` as read."""
    learned = [quantity.name for quantity in METHOD_QUANTITIES["constitutive"] if quantity.learned]
    table = table[~table["name"].isin(learned)].reset_index(drop=True)
    lines = []
    for row in table.to_dict("records"):
        unit = f" {row['unit']}" if isinstance(row["unit"], str) else ""
        interval = f"95 % interval {row['low_95']:.5g} to {row['high_95']:.5g}"
        if not np.isfinite(row["low_95"]):
            interval = "no interval: the value is at its bound, or the search ended before a minimum"
        lines.append(f"{row['name']} = {row['value']:.5g}{unit} ({interval})")
    for a, b in itertools.combinations(range(len(table)), 2):
        c = float(table[f"correlation_{table['name'][b]}"][a])
        if abs(c) > MIN_REPORTED_CORRELATION:
            lines.append(
                f"{table['name'][a]} and {table['name'][b]} are correlated ({c:+.3f}): the recordings hardly "
                "distinguish them"
            )
    return lines
