"""The units of a plan: a capture of every specimen, a fit of every model, an evaluation of every cell of a matrix."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rafl import cli
from rafl.batch.plain_command import plain_command
from rafl.batch.unit import Unit, create_unit
from rafl.capture import cli as capture_cli
from rafl.common.errors import InputError
from rafl.common.names import check_name
from rafl.sweep.files import PARTS, find_datasets, find_specimens
from rafl.sweep.plan import (
    LABEL,
    SEEDED,
    START,
    Plan,
    Value,
    Variant,
    capture_options,
    fit_options,
    training_sets,
    variants,
)


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
        captures: units that build datasets.
        fits: units that fit models.
        cells: evaluations.
    """

    captures: list[Unit]
    fits: list[Unit]
    cells: list[Cell]

    @property
    def units(self) -> list[Unit]:
        """All units: captures, fits, evaluations."""
        return [*self.captures, *self.fits, *(cell.unit for cell in self.cells)]


def sweep_units(plan: Plan, source: Path, out: Path) -> Sweep:
    """The units of a plan.

    Args:
        plan: what to build, to fit and to evaluate.
        source: file of the plan; paths in it are relative to its folder.
        out: folder for datasets, runs and tables.

    Raises:
        InputError: a file is missing, a name is too long for a file or taken, or the number of folds is not possible.
    """
    specimens, datasets = find_specimens(plan, source), find_datasets(plan, source)
    if both := specimens.keys() & datasets.keys():
        raise InputError(
            f"{LABEL} {source}: expected one dataset of each name, found {min(both)!r:.80} twice; rename one"
        )
    captures = [_capture_unit(name, Path(folder), out, plan.capture) for name, folder in specimens.items()]
    built = {name: str(_built_dataset(name, out)) for name in specimens}
    datasets = {**built, **datasets}
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
    return Sweep(captures, fits, cells)


def _built_dataset(name: str, out: Path) -> Path:
    """The dataset of a specimen's folder of this name."""
    return out / "datasets" / f"{name}.h5"


def _capture_unit(name: str, folder: Path, out: Path, options: Mapping[str, Value]) -> Unit:
    known = capture_options()
    path = _built_dataset(name, out)
    specimen, recordings, tracks = (folder / part for part in PARTS)
    values = {known[option][0]: value for option, value in options.items()}
    own = {"specimen": specimen, "tracks": tracks, "recordings": recordings, "out": path}
    command = plain_command("rafl-capture", capture_cli.capture, {**values, **own})
    read = [specimen, recordings, *sorted(item for item in tracks.iterdir() if item.is_file())]
    return create_unit(name, command, [path], read)


def _fit_name(source: Path, trained_on: str, variant: Variant, seed: int | None) -> str:
    parts = [trained_on, variant.label, *([] if seed is None else [str(seed)])]
    return _checked(source, "_".join(parts))


def _checked(source: Path, name: str) -> str:
    try:
        return check_name(name)
    except ValueError as error:
        raise InputError(f"{LABEL} {source}: unit {name!r:.80}: {error}; give methods a shorter `name`") from None


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
