"""System identification by exact gradients (paper, SysID baseline), and the constitutive residual on top of it."""

import itertools
from pathlib import Path

import numpy as np
import pandas as pd

from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.fitting.distributed import ALONE, ProcessGroup
from rafl.fitting.gauss_newton import Array, Minimum, Prior
from rafl.fitting.material_search import MaterialSearch
from rafl.fitting.quantities import LOSS_FACTOR, METHOD_QUANTITIES, Quantity, material_values
from rafl.fitting.run_folder import FittedModel, History, Report, Settings, save_model

MIN_REPORTED_CORRELATION = 0.9
BRANCHES = "sysid-branches"
# Standard deviations of the material's variables around the material found, where a constitutive residual is added: of
# log E, of the others.
KEPT_DEVIATIONS = 0.05, 1.0


def identify_material(
    datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: ProcessGroup = ALONE
) -> FittedModel:
    """Fit material parameters to the training recordings by least squares within bounds, from several starting points.

    Gradients are exact; the Gauss-Newton matrix is from differences of simulations that run as one batch.

    The search starts on the first frames of the recordings, from the datasets' assumed material or a softer or stiffer
    one, and likewise from one that is nearly incompressible. The best result continues with all frames.
    `parameters.csv` in the run holds the values, their 95 % intervals and their correlations. A resumed run reads
    earlier simulations from its checkpoint and does not repeat them.

    Raises:
        InputError: no training recordings.
        SimulationError: the assumed material itself cannot be simulated.
    """
    history, checkpoint = History(run, report, group), run / "checkpoint.pt"
    if settings.method == BRANCHES:
        search, start = branches_search(datasets, settings, history, checkpoint)
        return _save(search, search.descend(start, settings.epochs), run)
    search = MaterialSearch(datasets, settings, METHOD_QUANTITIES[settings.method], history, checkpoint)
    return _save(search, search.solve(), run)


def fit_constitutive(
    datasets: list[Dataset], settings: Settings, run: Path, report: Report, group: ProcessGroup = ALONE
) -> FittedModel:
    """Fit a learned strain energy and a learned viscosity together with the material, after the material alone.

    The files in the run are those of `identify_material`.

    Raises:
        InputError: no training recordings.
        SimulationError: the assumed material itself cannot be simulated.
    """
    history = History(run, report, group)
    below, start = branches_search(datasets, settings, history, run / f"checkpoint-{BRANCHES}.pt")
    minimum = below.descend(start, settings.epochs)
    search = add_constitutive_residual(below, minimum, datasets, run / "checkpoint.pt")
    return _save(search, search.descend(search.prior.mean, settings.epochs), run)


def branches_search(
    datasets: list[Dataset], settings: Settings, history: History, checkpoint: Path, with_prior: bool = False
) -> tuple[MaterialSearch, Array]:
    """A search for E, nu and Maxwell branches by all frames, and the variables that it should start at.

    They are those of a constant loss factor, found by the leading frames: these do not tell several branches apart.

    Args:
        datasets: with the training recordings.
        settings: of the fit.
        history: of the run.
        checkpoint: file of earlier evaluations; those of the loss factor are in `checkpoint-start.pt` beside it.
        with_prior: whether values near the assumed material are more likely.
    """
    first = checkpoint.with_name("checkpoint-start.pt")
    loss = MaterialSearch(datasets, settings, METHOD_QUANTITIES["sysid-loss"], history, first)
    identified = loss.identified(loss.solve_leading_frames())
    shares = material_values({LOSS_FACTOR.name: identified.pop(LOSS_FACTOR.name)})["branch_shares"]
    quantities = METHOD_QUANTITIES[BRANCHES]
    prior = None
    if with_prior:
        material = loss.simulator.material
        assumed = [float(getattr(material, quantity.name, quantity.low)) for quantity in quantities]
        prior = Prior(_variables(quantities, assumed), np.array([quantity.deviation for quantity in quantities]))
    search = MaterialSearch(datasets, settings, quantities, history, checkpoint, prior)
    search.use_frames(1.0)
    return search, _variables(quantities, [*identified.values(), *shares.tolist()])


def _variables(quantities: tuple[Quantity, ...], values: list[float]) -> Array:
    """Variables of values, within the bounds."""
    pairs = zip(quantities, values, strict=True)
    return np.array([np.clip(quantity.variable(value), *quantity.bounds) for quantity, value in pairs])


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
    model, table = search.model(minimum.x), search.parameter_table(minimum)
    if search.group.is_main:
        save_model(run, model)
        write_text(run / "parameters.csv", table)
    return model


def parameter_sentences(table: pd.DataFrame, through_model: bool = False) -> list[str]:
    """Sentences about the identified parameters and their bounds, learned weights left out.

    Args:
        table: `parameters.csv` as read.
        through_model: whether the frame of some recordings was found through the assumed material.
    """
    quantities = {quantity.name: quantity for own in METHOD_QUANTITIES.values() for quantity in own}
    table = table[[not quantities[name].learned for name in table["name"]]].reset_index(drop=True)
    lines = []
    found = np.isfinite(table["low_95"]).any()
    pairs = [(quantities[name], value) for name, value in zip(table["name"], table["value"], strict=True)]
    at_bound = [quantity.at_bound(value) for quantity, value in pairs]
    for row in table.to_dict("records") if found else []:
        unit = f" {row['unit']}" if isinstance(row["unit"], str) else ""
        interval = f"95 % interval {row['low_95']:.5g} to {row['high_95']:.5g}"
        if not np.isfinite(row["low_95"]):
            interval = "no interval: the value is at its bound"
        lines.append(f"{row['name']} = {row['value']:.5g}{unit} ({interval})")
    if through_model:
        lines.append(
            "no 95 % intervals: the frame of the recordings was found through the assumed material, and E follows it; "
            "film the undeformed specimen (rafl-capture --rest), or put three markers on the clamp"
        )
    elif not found and not all(at_bound):
        lines.append(
            "no 95 % intervals: the search ended before a minimum, as that of the default does once the error hardly "
            "falls; --method sysid-branches searches on"
        )
    lines += [sentence for quantity, value in pairs if (sentence := quantity.bound_sentence(value))]
    for a, b in itertools.combinations(range(len(table)), 2):
        c = float(table[f"correlation_{table['name'][b]}"][a])
        if abs(c) > MIN_REPORTED_CORRELATION:
            lines.append(
                f"{table['name'][a]} and {table['name'][b]} are correlated ({c:+.3f}): the recordings hardly "
                "distinguish them"
            )
    return lines
