"""One table of what is done, running and failed, and why."""

import csv
import io
from collections.abc import Sequence

from rich.console import Console

from rafl.batch.schedule import Progress
from rafl.batch.state import Book, Status
from rafl.batch.unit import Unit
from rafl.common.command_line import create_table, one_line
from rafl.common.files import write_text
from rafl.common.text_tables import spreadsheet_text

TABLE_FILE = "units.csv"
MOST_ROWS = 40  # printed; `units.csv` has all
# In the order in which a reader wants them.
ORDER = (Status.failed, Status.killed, Status.blocked, Status.running, Status.queued, Status.waiting, Status.done)


def counts(progress: Progress) -> str:
    """The number of units of each status that some have, in one line."""
    return ", ".join(f"{number} {status}" for status in reversed(ORDER) if (number := progress.count(status)))


def write_table(book: Book, units: Sequence[Unit], progress: Progress) -> None:
    """Write `units.csv`: status, attempts, time, machine, reason, log and command of every unit."""
    stream = io.StringIO()
    rows = csv.writer(stream, lineterminator="\n")
    rows.writerow(("unit", "status", "attempts", "seconds", "host", "job", "reason", "log", "command"))
    for unit in units:
        state = book.state(unit.name)
        told = ("", "", "", "") if state is None else (state.attempts, state.seconds, state.host, state.job)
        texts = (one_line(progress.reasons.get(unit.name, "")), str(book.log_path(unit.name)), unit.line)
        rows.writerow((spreadsheet_text(unit.name), progress.status[unit.name], *told, *map(spreadsheet_text, texts)))
    write_text(book.folder / TABLE_FILE, stream.getvalue())


def print_table(book: Book, units: Sequence[Unit], progress: Progress) -> None:
    """Print the units that failed, were killed, run or are in a queue, and the number of units of each status."""
    rows = sorted(
        (
            unit.name
            for unit in units
            if progress.status[unit.name] not in (Status.done, Status.waiting, Status.blocked)
        ),
        key=lambda name: ORDER.index(progress.status[name]),
    )
    console = Console(width=120)
    if rows:
        table = create_table("unit", "status", "attempts", "reason")
        for name in rows[:MOST_ROWS]:
            state = book.state(name)
            attempts = "" if state is None else str(state.attempts)
            table.add_row(one_line(name), progress.status[name], attempts, one_line(progress.reasons.get(name, "")))
        console.print(table)
        if len(rows) > MOST_ROWS:
            console.print(f"and {len(rows) - MOST_ROWS} more", highlight=False)
    console.print(f"{len(units)} units: {counts(progress)}", highlight=False)
