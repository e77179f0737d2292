"""The units of a plan: a fit for every model, and an evaluation for every model and dataset, a cell of a matrix."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rafl import cli
from rafl.batch.plain_command import plain_command
from rafl.batch.unit import Unit, create_unit
from rafl.common.errors import InputError
from rafl.common.names import check_name
from rafl.sweep.plan import SEEDED, START, Plan, Variant, fit_options, training_sets, variants


@dataclass(frozen=True)
class Cell:
    """A model and a dataset on which it is evaluated.

    Attributes:
        unit: that evaluates it.
        folder: of its tables.
        trained_on: label of the set that the model was trained on.
        method: label of its method.
        seed: of the model; None for a method without one.
        dataset: name of the dataset's file.
    """

    unit: Unit
    folder: Path
    trained_on: str
    method: str
    seed: int | None
    dataset: str


@dataclass(frozen=True)
class Sweep:
    """The units of a plan.

    Attributes:
        fits: units that fit models.
        cells: evaluations.
    """

    fits: list[Unit]
    cells: list[Cell]

    @property
    def units(self) -> list[Unit]:
        """All units, fits first."""
        return [*self.fits, *(cell.unit for cell in self.cells)]


def sweep_units(plan: Plan, source: Path, datasets: Mapping[str, str], out: Path) -> Sweep:
    """The units of a plan.

    Args:
        plan: what to fit and to evaluate.
        source: file of the plan; paths in it are relative to its folder.
        datasets: files by name.
        out: folder for runs and tables.

    Raises:
        InputError: a name is too long for a file, or the number of folds is not possible.
    """
    fits, cells = [], []
    chosen = variants(plan)
    labels = {variant.label: variant for variant in chosen}
    for trained_on, own in training_sets(plan, list(datasets)):
        for variant in chosen:
            for seed in plan.seeds if variant.method in SEEDED else (None,):
                name = _fit_name(source, trained_on, variant, seed)
                run = out / "runs" / name
                start = _start(variant, source, labels, trained_on, seed, out)
                fits.append(_fit_unit(name, run, [datasets[key] for key in own], variant, seed, start))
                evaluated = {"own": own, "all": list(datasets)}.get(
                    plan.evaluate, [k for k in datasets if k not in own]
                )
                for key in evaluated:
                    folder = out / "cells" / name / key
                    unit = _cell_unit(_checked(source, f"{name}_on_{key}"), folder, run, datasets[key])
                    cells.append(Cell(unit, folder, trained_on, variant.label, seed, key))
    return Sweep(fits, cells)


def _fit_name(source: Path, trained_on: str, variant: Variant, seed: int | None) -> str:
    parts = [trained_on, variant.label, *([] if seed is None else [str(seed)])]
    return _checked(source, "_".join(parts))


def _checked(source: Path, name: str) -> str:
    try:
        return check_name(name)
    except ValueError as error:
        raise InputError(
            f"a plan of a sweep {source}: unit {name!r:.80}: {error}; give methods a shorter `name`"
        ) from None


def _start(
    variant: Variant, source: Path, labels: Mapping[str, Variant], trained_on: str, seed: int | None, out: Path
) -> str | None:
    """The run that a fit starts from: that of another method of the plan, of the same training set, or a folder."""
    given = variant.options.get(START)
    if given is None:
        return None
    other = labels.get(str(given))
    if other is None:
        return str(source.parent / str(given))
    return str(out / "runs" / _fit_name(source, trained_on, other, seed if other.method in SEEDED else None))


def _fit_unit(name: str, run: Path, datasets: list[str], variant: Variant, seed: int | None, start: str | None) -> Unit:
    known = fit_options()
    values = {known[option][0]: value for option, value in variant.options.items()}
    own = {"datasets": datasets, "method": variant.method, "seed": seed, "start": start, "out": run, "resume": True}
    command = plain_command("rafl-fit", cli.fit, {**values, **own})
    return create_unit(
        name, command, [run / "model.pt"], [*datasets, *([] if start is None else [f"{start}/model.pt"])]
    )


def _cell_unit(name: str, folder: Path, run: Path, dataset: str) -> Unit:
    command = plain_command("rafl-eval", cli.evaluate, {"paths": [run, dataset], "out": folder, "report": False})
    return create_unit(name, command, [folder / "errors.csv"], [run / "model.pt", dataset])
