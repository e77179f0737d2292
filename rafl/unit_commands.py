"""What `rafl-fit` and `rafl-eval` do with --on: make their units, run them, gather their tables."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from rafl import cli
from rafl.batch.execute import end_of, execute
from rafl.batch.options import Batch
from rafl.batch.plain_command import plain_command
from rafl.batch.state import UNITS_FOLDER, Status
from rafl.batch.unit import create_unit
from rafl.common.errors import InputError
from rafl.common.files import require_file, written_files

TABLES = ("errors.csv", "motions.csv")


def fit(given: Mapping[str, Any], batch: Batch) -> None:
    """Fit one model to all datasets, or one to each, as units.

    Args:
        given: arguments of `rafl.cli.fit`.
        batch: where units run.

    Raises:
        InputError: two datasets share a name.
        typer.Exit: some units failed; code 1.
    """
    datasets, out, start, each = (given[key] for key in ("datasets", "out", "start", "each"))
    folder = Path("runs") if out is None else out if each else out.parent
    units = []
    for paths in [[path] for path in datasets] if each else [datasets]:
        name = f"{paths[0].stem}-{given['method']}"
        run = folder / name if out is None or each else out
        command = plain_command(
            "rafl-fit", cli.fit, {**given, "datasets": paths, "out": run, "resume": True, "each": False}
        )
        started = [] if start is None else [start / "model.pt"]
        units.append(create_unit(name, command, [run / "model.pt"], [*paths, *started]))
    found = execute(units, folder / UNITS_FOLDER, batch)
    if found is not None:
        end_of(found, folder / UNITS_FOLDER)


def evaluate(given: Mapping[str, Any], runs: list[Path], files: list[Path], out: Path, batch: Batch) -> None:
    """Evaluate models on each dataset as a unit, and gather the tables.

    Args:
        given: arguments of `rafl.cli.evaluate`.
        runs: run folders of the models.
        files: dataset files.
        out: folder for the tables.
        batch: where units run.

    Raises:
        InputError: two datasets share a name, or a table is damaged.
        typer.Exit: some units failed; code 1.
    """
    models = [run / "model.pt" for run in runs]
    units = []
    for path in files:
        command = plain_command("rafl-eval", cli.evaluate, {**given, "paths": [*runs, path], "out": out / path.stem})
        units.append(create_unit(path.stem, command, [out / path.stem / name for name in TABLES], [*models, path]))
    found = execute(units, out / UNITS_FOLDER, batch)
    if found is None:
        return
    folders = [out / path.stem for path in files if found.status[path.stem] == Status.done]
    with written_files({out / name: _joined([folder / name for folder in folders]) for name in TABLES if folders}):
        pass
    for folder in folders:
        typer.echo(f"{folder.name}: {_means(folder / TABLES[0])}")
    if folders:
        typer.echo(f"wrote {out}/{', '.join(TABLES)}")
    end_of(found, out / UNITS_FOLDER)


def _joined(paths: list[Path]) -> str:
    """The rows of tables that have the same columns, below each other.

    Raises:
        InputError: a table is missing, or has other columns.
    """
    heads, bodies = zip(*(_text(path).split("\n", 1) for path in paths), strict=True)
    for path, head in zip(paths, heads, strict=True):
        if head != heads[0]:
            raise InputError(
                f"{path}: expected the columns {heads[0]:.120}, found {head:.120}; remove it, and run again"
            )
    return "\n".join([heads[0], "".join(bodies)])


def _text(path: Path) -> str:
    require_file(path, "a table of errors (written by rafl-eval)")
    return path.read_text(encoding="utf-8") + ("" if path.stat().st_size else "\n")


def _means(path: Path) -> str:
    """The mean error of each method over the held-out recordings of a table, or over all if none is held out."""
    rows = list(csv.DictReader(io.StringIO(_text(path))))
    chosen = [row for row in rows if row["split"] == "test"] or rows
    values: dict[str, list[float]] = {}
    for row in chosen:
        values.setdefault(row["method"], []).append(float(row["mean_mm"]))
    return ", ".join(f"{name} {sum(errors) / len(errors):.3f} mm" for name, errors in values.items())
