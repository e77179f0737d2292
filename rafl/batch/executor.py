"""Executors: what runs units, on this machine or elsewhere."""

import subprocess
import sys
from collections.abc import Sequence
from typing import Protocol

from rafl.batch.state import Book, Status
from rafl.batch.unit import Unit

END_WITHIN_S = 60.0  # that a unit's process has to end its command when it is asked to


class Executor(Protocol):
    """Runs units by `rafl.batch.runner.run_unit`, in processes that outlive this one.

    Attributes:
        submitted: status of a unit after `submit`.
        pause_s: between two looks at the units that run [s].
    """

    submitted: Status
    pause_s: float

    def free(self) -> int:
        """Number of units that can be submitted now."""

    def running(self) -> set[str]:
        """Names of the submitted units that have not ended."""

    def submit(self, units: Sequence[Unit]) -> None:
        """Start units, or put them into a queue."""

    def stop(self) -> None:
        """Called when the program is interrupted."""


class LocalExecutor:
    """Runs units in processes of this machine.

    Each has a session of its own, so that Ctrl-C reaches this program alone, which then asks them to end.
    """

    submitted = Status.running
    pause_s = 0.02

    def __init__(self, book: Book, jobs: int) -> None:
        self.book, self.jobs = book, jobs
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def free(self) -> int:
        """Number of units that can be started now."""
        return self.jobs - len(self.processes)

    def running(self) -> set[str]:
        """Names of the started units that have not ended."""
        self.processes = {name: process for name, process in self.processes.items() if process.poll() is None}
        return set(self.processes)

    def submit(self, units: Sequence[Unit]) -> None:
        """Start units."""
        for unit in units:
            where = [str(self.book.folder.absolute()), str(self.book.base), "1"]
            line = [sys.executable, "-m", "rafl.batch.runner", *where, unit.model_dump_json()]
            self.processes[unit.name] = subprocess.Popen(line, stdin=subprocess.DEVNULL, start_new_session=True)

    def stop(self) -> None:
        """Ask all commands to end, and wait until they have removed their temporary files."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(END_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
