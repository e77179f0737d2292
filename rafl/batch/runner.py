"""Run one unit in this process: take its lock, run its command, write down how it ended."""

import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from rafl.batch.state import Book, State, Status
from rafl.batch.unit import Unit
from rafl.common.interruption import interruptible

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
END_WITHIN_S = 30.0  # that a command has to remove its temporary files when it is asked to end
INTERRUPTED_CODES = (128 + signal.SIGINT, 128 + signal.SIGTERM)
REASON_BYTES = 4000  # at the end of a log, among which the reason of a failure is looked for
REASON_CHARACTERS = 300


def run_unit(book: Book, unit: Unit, threads: int = 1, job: str = "") -> None:
    """Run a unit's command, unless it is done or a process of it lives, and write its state.

    Args:
        book: of the unit.
        unit: to run.
        threads: of the command.
        job: of the cluster that runs this process.
    """
    with book.locked_log(unit.name) as log:
        if log is None or book.is_done(unit):
            return
        before = book.state(unit.name)
        state = State(
            status=Status.running,
            command=unit.command,
            inputs=unit.fingerprint(book.base),
            attempts=1 if before is None else before.attempts + 1,
            host=platform.node(),
            job=job,
            started=datetime.now(UTC),
        )
        book.write_state(unit.name, state)
        begin, clock = log.tell(), time.monotonic()
        log.write(f"{state.started:%Y-%m-%d %H:%M:%S} UTC, {state.host}: {unit.line}\n".encode())
        log.flush()

        def ended(status: Status, reason: str = "") -> None:
            changed = {"status": status, "reason": reason, "seconds": round(time.monotonic() - clock, 3)}
            book.write_state(unit.name, state.model_copy(update=changed))

        try:
            code = _run_command(unit, book.base, log, threads)
        except FileNotFoundError:
            ended(Status.failed, f"expected the program {unit.command[0]}, found none; install it, or set PATH")
            return
        except BaseException:
            ended(Status.killed, "interrupted")
            raise
        if code in INTERRUPTED_CODES:
            ended(Status.killed, "interrupted")
        elif code < 0:
            ended(Status.killed, f"killed by signal {-code} ({signal.Signals(-code).name})")
        elif code > 0:
            ended(Status.failed, _last_line(book.log_path(unit.name), begin) or f"exit code {code}")
        elif missing := [path for path in unit.outputs if not (book.base / path).exists()]:
            ended(Status.failed, f"the command succeeded without writing {missing[0]}")
        else:
            ended(Status.done)


def _run_command(unit: Unit, base: Path, log: BinaryIO, threads: int) -> int:
    """Exit code of a unit's command. If this process is interrupted, the command is asked to end before."""
    program = shutil.which(unit.command[0], path=_search_path()) or unit.command[0]
    command = subprocess.Popen(
        [program, *unit.command[1:]],
        cwd=base,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env=_environment(os.environ, threads),
    )
    try:
        with interruptible():
            return command.wait()
    except BaseException:
        command.terminate()
        try:
            command.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            command.kill()
            command.wait()
        raise


def _search_path() -> str:
    """Where programs are looked for: beside this Python first, as in its virtual environment."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])


def _environment(inherited: Mapping[str, str], threads: int) -> dict[str, str]:
    """Environment variables of a command: its threads, its messages at once, and programs of this environment."""
    numbers = dict.fromkeys(THREAD_VARIABLES, str(threads))
    return {**inherited, **numbers, "PYTHONUNBUFFERED": "1", "PATH": _search_path()}


def _last_line(log: Path, begin: int) -> str:
    """The last line that a command printed, in a log from a byte on."""
    with log.open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(begin, size - REASON_BYTES))
        lines = [line.strip() for line in stream.read().decode(errors="replace").splitlines()[1:] if line.strip()]
    return lines[-1].removeprefix("error: ")[:REASON_CHARACTERS] if lines else ""


def main() -> None:
    """Run the unit that the arguments give: folder of the states, folder to run in, threads, and the unit as JSON."""
    folder, base, threads, unit = sys.argv[1:]
    try:
        run_unit(Book(Path(folder), Path(base)), Unit.model_validate_json(unit), int(threads))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED_CODES[-1])


if __name__ == "__main__":
    main()
