"""What `rafl-sweep` does once its options are checked: make the units of a plan, run them, print the results."""

from pathlib import Path

import pandas as pd
import typer
from rich.console import Console
from rich.table import Table

from rafl.batch.execute import end_of, execute, show_status
from rafl.batch.options import Batch
from rafl.batch.state import UNITS_FOLDER, Status, open_book
from rafl.common.command_line import create_table, one_line
from rafl.common.files import written_files
from rafl.common.text_tables import spreadsheet_csv
from rafl.sweep.cells import sweep_units
from rafl.sweep.plan import read_plan
from rafl.sweep.results import by_method, gather, summarise

RESULTS_FILE, SUMMARY_FILE = "results.csv", "summary.csv"
MOST_ROWS = 60  # printed; summary.csv has all


def sweep(source: Path, out: Path, batch: Batch) -> None:
    """Run the units of a plan, and gather the errors of all models that were evaluated.

    Args:
        source: plan.yaml.
        out: folder for runs, tables, states and logs.
        batch: where units run, or what is printed instead.

    Raises:
        InputError: the plan or a file that it names is wrong.
        typer.Exit: some units failed; code 1.
    """
    plan = read_plan(source)
    made = sweep_units(plan, source, out)
    found = execute(made.units, out / UNITS_FOLDER, batch)
    if found is None:
        return
    errors = gather(cell for cell in made.cells if found.status[cell.unit.name] == Status.done)
    summary = summarise(errors)
    tables = {RESULTS_FILE: errors, SUMMARY_FILE: summary}
    with written_files({out / name: spreadsheet_csv(table) for name, table in tables.items()}):
        pass
    if len(summary):
        Console(width=120).print(_printed(summary))
    typer.echo(f"wrote {out / RESULTS_FILE} and {out / SUMMARY_FILE}")
    end_of(found, out / UNITS_FOLDER)


def _printed(summary: pd.DataFrame) -> Table:
    """The summary, or its means over datasets if it is long."""
    if len(summary) > MOST_ROWS:
        table = create_table("method", "split", "cells", "mean error [mm]")
        for row in by_method(summary).itertuples():
            table.add_row(one_line(row.method), one_line(row.split), str(row.cells), f"{row.mean_mm:.3f}")
        return table
    table = create_table("trained on", "method", "dataset", "split", "recordings", "seeds", "error [mm]")
    for row in summary.itertuples():
        spread = f" +- {row.std_mm:.3f}" if row.std_mm == row.std_mm else ""
        names = (one_line(part) for part in (row.trained_on, row.method, row.dataset, row.split))
        table.add_row(*names, str(row.recordings), str(row.seeds), f"{row.mean_mm:.3f}{spread}")
    return table


def show_folder(folder: Path) -> None:
    """Print the status of the units in a folder, whatever command they belong to.

    Raises:
        InputError: there are none, or a damaged state.
    """
    inside = folder / UNITS_FOLDER
    book, units = open_book(inside if inside.is_dir() else folder)
    show_status(book, units)
