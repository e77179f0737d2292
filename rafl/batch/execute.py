"""What a command does with its units: print their commands or their status, or run them."""

from collections.abc import Callable, Sequence
from pathlib import Path

import typer
from rich.progress import Progress as Display

from rafl.batch.executor import Executor, LocalExecutor
from rafl.batch.options import Batch, Where
from rafl.batch.schedule import Progress, run_units, survey
from rafl.batch.state import Book, Status
from rafl.batch.table import counts, print_table, write_table
from rafl.batch.unit import Unit, check_units
from rafl.common.command_line import one_line, progress
from rafl.common.files import require_writable


def execute(units: Sequence[Unit], folder: Path, batch: Batch) -> Progress | None:
    """Print the commands or the status of units, or run them and print the table.

    Args:
        units: of the command.
        folder: for their states and logs.
        batch: what to do.

    Returns:
        How they ended; None if they were not run.

    Raises:
        InputError: units that cannot run beside each other, a damaged state, or no cluster.
    """
    check_units(units)
    if batch.print_commands:
        for unit in units:
            typer.echo(unit.line)
        return None
    book = Book(folder, Path.cwd())
    if batch.status:
        show_status(book, units)
        return None
    require_writable(folder)
    executor = _executor(book, batch)
    with progress() as bar:
        found = run_units(book, units, executor, _report(bar, len(units)))
    write_table(book, units, found)
    print_table(book, units, found)
    if batch.on == Where.slurm and found.count(Status.done) == len(units):
        from rafl.batch.cluster import remove_job_files

        remove_job_files(book)
    return found


def end_of(found: Progress, folder: Path) -> None:
    """End a command whose units have ended.

    Raises:
        typer.Exit: some of them failed; code 1.
    """
    if found.count(Status.done) < len(found.status):
        typer.echo(f"logs are {folder}/UNIT.log; the same command runs what failed again, and only that", err=True)
        raise typer.Exit(1)


def _report(bar: Display, total: int) -> Callable[[Progress], None]:
    """A function that shows the progress of units, and prints a line for each that fails."""
    task = bar.add_task("", total=total)
    told: set[str] = set()

    def report(found: Progress) -> None:
        ended = found.count(Status.done, Status.failed, Status.blocked)
        bar.update(task, completed=ended, description=counts(found))
        for name in sorted(found.reasons.keys() - told):
            if found.status[name] == Status.failed:
                typer.echo(one_line(f"error: unit {name}: {found.reasons[name]}"), err=True)
                told.add(name)

    return report


def show_status(book: Book, units: Sequence[Unit]) -> None:
    """Print the table of some units as they are now."""
    print_table(book, units, survey(book, units))


def _executor(book: Book, batch: Batch) -> Executor:
    if batch.on == Where.slurm:
        from rafl.batch.cluster import ClusterExecutor, read_cluster

        return ClusterExecutor(book, read_cluster(batch.cluster))
    return LocalExecutor(book, batch.jobs)
