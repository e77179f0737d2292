"""What is known of each unit: a small file for each, which the unit's own process writes."""

import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO

from pydantic import AwareDatetime

from rafl.batch.json_files import read_json, write_json
from rafl.batch.unit import Unit, check_units
from rafl.common.errors import InputError
from rafl.common.yaml_files import StrictModel

STATE_FORMAT, LIST_FORMAT = "rafl-unit/1", "rafl-units/1"
UNITS_FOLDER, LIST_FILE = "units", "units.json"  # the folder lies beside the results of a command
MAX_STATE_BYTES, MAX_LIST_BYTES = 10_000_000, 200_000_000  # they have some 1,000 bytes for a unit
LOCK_TRIES, LOCK_PAUSE_S = 5, 0.02


class Status(StrEnum):
    """What happened to a unit.

    `killed` are units that ended without an error of their own: by a signal, an interruption, or with their machine.
    """

    waiting = "waiting"
    blocked = "blocked"
    queued = "queued"
    running = "running"
    done = "done"
    failed = "failed"
    killed = "killed"


class State(StrictModel):
    """The last attempt to run a unit.

    Attributes:
        status: `running`, `done`, `failed` or `killed`.
        command: that was run.
        inputs: size and time of change of the inputs before it was run.
        attempts: number of attempts, this one included.
        host: name of the machine.
        job: of the cluster; empty on this machine.
        started: time at which this attempt began.
        seconds: that this attempt took [s].
        reason: why it failed or was killed.
    """

    status: Status
    command: tuple[str, ...]
    inputs: dict[str, tuple[int, int]]
    attempts: int
    host: str
    job: str
    started: AwareDatetime
    seconds: float = 0.0
    reason: str = ""


class _List(StrictModel):
    """Content of `units.json`."""

    working_folder: str
    units: tuple[Unit, ...]


@dataclass(frozen=True)
class Book:
    """The folder that holds the state and the log of every unit.

    Attributes:
        folder: of the files.
        base: folder in which the commands run, from which relative paths count.
    """

    folder: Path
    base: Path

    def state_path(self, name: str) -> Path:
        """The file with a unit's state."""
        return self.folder / f"{name}.json"

    def log_path(self, name: str) -> Path:
        """The file with what a unit's commands print."""
        return self.folder / f"{name}.log"

    def state(self, name: str) -> State | None:
        """The state of a unit; None if it was never started.

        Raises:
            InputError: the file is damaged or of a newer version.
        """
        path = self.state_path(name)
        if not path.exists():
            return None
        return read_json(path, State, "the state of a unit", STATE_FORMAT, MAX_STATE_BYTES)

    def write_state(self, name: str, state: State) -> None:
        """Write the state of a unit."""
        write_json(self.state_path(name), state, STATE_FORMAT)

    def is_done(self, unit: Unit) -> bool:
        """Whether a unit's command succeeded, and neither it nor its inputs have changed, and its outputs are there."""
        state = self.state(unit.name)
        return (
            state is not None
            and state.status == Status.done
            and state.command == unit.command
            and state.inputs == unit.fingerprint(self.base)
            and all((self.base / path).exists() for path in unit.outputs)
        )

    def is_running(self, name: str) -> bool:
        """Whether a process of a unit lives, on any machine that shares the folder."""
        try:
            with self.log_path(name).open("rb") as log:
                return not _try_lock(log, fcntl.LOCK_SH)
        except FileNotFoundError:
            return False

    @contextmanager
    def locked_log(self, name: str) -> Iterator[BinaryIO | None]:
        """A unit's log, to append to; None if a process of the unit lives.

        The log stays locked as long as any process has it open: also after this one is killed, by the command that
        inherited it.

        Raises:
            InputError: the folder's file system has no locks.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with self.log_path(name).open("ab") as log:
            yield log if _try_lock(log, fcntl.LOCK_EX) else None

    def write_units(self, units: Sequence[Unit]) -> None:
        """Write `units.json`: all units, for those who look at their state without the plan they were made from."""
        write_json(self.folder / LIST_FILE, _List(working_folder=str(self.base), units=tuple(units)), LIST_FORMAT)


def open_book(folder: Path) -> tuple[Book, list[Unit]]:
    """The book in a folder, and its units.

    Raises:
        InputError: `units.json` is missing, damaged or of a newer version.
    """
    found = read_json(folder / LIST_FILE, _List, "a list of units", LIST_FORMAT, MAX_LIST_BYTES)
    check_units(found.units)
    return Book(folder, Path(found.working_folder)), list(found.units)


def _try_lock(file: BinaryIO, kind: int) -> bool:
    """Lock an open file, unless a process has locked it; one that only looks has it for a moment."""
    for _ in range(LOCK_TRIES):
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(LOCK_PAUSE_S)
        except OSError as error:
            raise InputError(
                f"{file.name}: expected a file system with locks, found: {error.strerror}; choose another --out, or "
                "have it mounted with locks (Lustre: -o flock)"
            ) from None
        else:
            return True
    return False
