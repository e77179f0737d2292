"""Units are run once, in order, again if they failed or were killed, and never beside themselves."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from counted import Make, runs

from rafl.batch.execute import execute
from rafl.batch.executor import LocalExecutor
from rafl.batch.options import Batch, Where
from rafl.batch.schedule import RESTARTS, Progress, run_units, survey
from rafl.batch.state import Book, Status, open_book
from rafl.batch.table import counts, write_table
from rafl.batch.unit import Unit, create_unit
from rafl.common.errors import InputError

HOSTILE = "; rm -rf $HOME `touch owned` && 'x'"
ONCE = "marker = Path(folder, 'marker'); first = not marker.exists(); marker.touch()\n"
COORDINATOR = """
import sys
from pathlib import Path
from rafl.batch.executor import LocalExecutor
from rafl.batch.schedule import run_units
from rafl.batch.state import Book, open_book
from rafl.common.interruption import interruptible
book, units = open_book(Path("units"))
with interruptible():
    run_units(book, units, LocalExecutor(book, 2), lambda progress: None)
"""


def run(book: Book, units: list[Unit], jobs: int = 2) -> Progress:
    return run_units(book, units, LocalExecutor(book, jobs), lambda progress: None)


def wait_until(condition: object, seconds: float = 60.0) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def test_units_run_once_and_in_order(book: Book, make: Make, tmp_path: Path) -> None:
    units = [make("c", needs=("a", "b")), make("a"), make("b", needs=("a",)), make("d", needs=("absent",))]
    found = run(book, units)
    assert set(found.status.values()) == {Status.done}
    ran = runs(tmp_path)
    assert sorted(ran) == ["a", "b", "c", "d"]
    assert [name for name in ran if name != "d"] == ["a", "b", "c"]
    assert run(book, units).count(Status.done) == 4
    assert len(runs(tmp_path)) == 4
    (tmp_path / "a.out").write_text("changed")  # an input of two others; their outputs do not change
    assert run(book, units).count(Status.done) == 4
    assert Counter(runs(tmp_path)) == {"a": 1, "b": 2, "c": 2, "d": 1}
    (tmp_path / "d.out").unlink()
    run(book, units)
    assert Counter(runs(tmp_path))["d"] == 2


def test_a_failure_is_told_and_run_again_alone(book: Book, make: Make, tmp_path: Path) -> None:
    fail = ONCE + "if first: sys.exit('error: expected more, found less; add some')"
    units = [make("good"), make("bad", fail), make("later", needs=("bad",)), make("last", needs=("later",))]
    found = run(book, units)
    assert [found.status[unit.name] for unit in units] == ["done", "failed", "blocked", "blocked"]
    assert found.reasons["bad"] == "expected more, found less; add some"
    assert (found.reasons["later"], found.reasons["last"]) == ("needs bad", "needs later")
    assert survey(book, units) == found
    assert counts(found) == "1 done, 2 blocked, 1 failed"
    write_table(book, units, found)
    with (book.folder / "units.csv").open(newline="") as stream:
        rows = {row["unit"]: row for row in csv.DictReader(stream)}
    assert rows["bad"]["reason"] == found.reasons["bad"]
    assert rows["bad"]["attempts"] == "1"
    assert found.reasons["bad"] in Path(rows["bad"]["log"]).read_text()
    assert set(run(book, units).status.values()) == {Status.done}
    assert Counter(runs(tmp_path)) == {"good": 1, "bad": 2, "later": 1, "last": 1}


def test_commands_that_cannot_succeed(book: Book) -> None:
    units = [
        create_unit("absent", ["no-such-program"], ["x"]),
        create_unit("silent", [sys.executable, "-c", "raise SystemExit(3)"], ["y"]),
        create_unit("idle", [sys.executable, "-c", ""], ["z.out"]),
    ]
    found = run(book, units)
    assert set(found.status.values()) == {Status.failed}
    assert "expected the program no-such-program" in found.reasons["absent"]
    assert found.reasons["silent"] == "exit code 3"
    assert found.reasons["idle"] == "the command succeeded without writing z.out"


def test_a_killed_command_is_run_again(book: Book, make: Make, tmp_path: Path) -> None:
    units = [make("once", ONCE + "if first: os.kill(os.getpid(), 9)"), make("always", "os.kill(os.getpid(), 9)")]
    found = run(book, units)
    assert found.status == {"once": Status.done, "always": Status.failed}
    assert found.reasons["always"] == f"killed by signal 9 (SIGKILL), {RESTARTS + 1} times"
    assert Counter(runs(tmp_path)) == {"once": 2, "always": RESTARTS + 1}


def test_a_command_that_outlives_its_process_is_waited_for(book: Book, make: Make, tmp_path: Path) -> None:
    """The process that would write the state is killed; the command goes on and must not be started beside itself."""
    action = ONCE + (
        "if first: os.kill(os.getppid(), 9)\n"
        "own = Path(folder, 'alone'); own.touch(exist_ok=False); time.sleep(1.0); own.unlink()"
    )
    found = run(book, [make("orphan", action)])
    assert found.status == {"orphan": Status.done}
    assert runs(tmp_path) == ["orphan"] * 2
    state = book.state("orphan")
    assert state is not None
    assert state.attempts == 2


def test_nothing_runs_twice_if_the_program_is_killed(book: Book, make: Make, tmp_path: Path) -> None:
    units = [make(f"unit {number}", "time.sleep(0.7)") for number in range(6)]
    book.write_units(units)
    program = subprocess.Popen([sys.executable, "-c", COORDINATOR], cwd=tmp_path)
    wait_until(lambda: len(runs(tmp_path)) >= 2)
    program.kill()
    program.wait()
    assert run(book, units).count(Status.done) == 6
    assert Counter(runs(tmp_path)) == {unit.name: 1 for unit in units}


def test_two_programs_share_the_units(book: Book, make: Make, tmp_path: Path) -> None:
    units = [make(f"unit {number}", "time.sleep(0.2)") for number in range(8)]
    book.write_units(units)
    other = subprocess.Popen([sys.executable, "-c", COORDINATOR], cwd=tmp_path)
    assert run(book, units).count(Status.done) == 8
    assert other.wait() == 0
    assert Counter(runs(tmp_path)) == {unit.name: 1 for unit in units}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_ends_the_commands(book: Book, make: Make, tmp_path: Path, number: int) -> None:
    tell = "signal.signal(15, lambda *_: (Path(folder, 'ended').touch(), sys.exit(143))); time.sleep(60)"
    units = [make("long", tell)]
    book.write_units(units)
    program = subprocess.Popen([sys.executable, "-c", COORDINATOR], cwd=tmp_path, stderr=subprocess.DEVNULL)
    wait_until(lambda: runs(tmp_path) and book.state("long") is not None)
    time.sleep(0.3)
    assert survey(book, units).status == {"long": Status.running}
    program.send_signal(number)
    program.wait(30)
    assert (tmp_path / "ended").exists()
    found = survey(book, units)
    assert (found.status["long"], found.reasons["long"]) == (Status.killed, "interrupted")


def test_names_and_paths_are_never_read_by_a_shell(tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "a folder; with $(touch owned) spaces"
    folder.mkdir()
    monkeypatch.chdir(folder)
    book = Book(folder / "units", folder)
    unit = create_unit(HOSTILE, [sys.executable, "-c", "open(__import__('sys').argv[1], 'w')", HOSTILE], [HOSTILE])
    assert run(book, [unit]).status == {HOSTILE: Status.done}
    assert sorted(path.name for path in folder.iterdir()) == [HOSTILE, "units"]
    found = subprocess.run(["sh", "-c", f"printf '%s\\n' {unit.line}"], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == list(unit.command)


@pytest.mark.parametrize("name", ["", "a/b", "..", "x" * 130, "two\nlines", " a"])
def test_names_that_no_file_can_have_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="units are named after"):
        create_unit(name, ["true"], [])


def test_units_that_cannot_run_beside_each_other(book: Book, make: Make) -> None:
    with pytest.raises(InputError, match="more than once"):
        run(book, [make("a"), make("a")])
    with pytest.raises(InputError, match="results of their own"):
        run(book, [create_unit("a", ["true"], ["x"]), create_unit("b", ["true"], ["./x"])])
    with pytest.raises(InputError, match="each reads another's"):
        run(book, [make("a", needs=("b",)), make("b", needs=("a",))])


def test_damaged_states_are_refused(book: Book, make: Make) -> None:
    units = [make("a")]
    run(book, units)
    path = book.state_path("a")
    good = json.loads(path.read_text())
    for content, message in (
        ("{", "not readable as JSON"),
        ("[]", "no keys and values"),
        (json.dumps(good | {"format": "rafl-unit/9"}), "newer than this program's"),
        (json.dumps(good | {"status": "bored"}), "status: .*remove the file"),
        (json.dumps({"format": "rafl-unit/1"}), "status: Field required"),
        ("[" * 100_000, "not readable as JSON"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=message):
            survey(book, units)
        with pytest.raises(InputError, match=r"a\.json"):
            run(book, units)
    path.unlink()
    assert run(book, units).count(Status.done) == 1


def test_a_list_of_units_is_read_back(book: Book, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    units = [make("a"), make("b", needs=("a",))]
    run(book, units)
    monkeypatch.chdir("/")
    again, found = open_book(book.folder)
    assert (again.base, found) == (tmp_path, units)
    assert survey(again, found).count(Status.done) == 2


def test_printed_commands_run_nothing(
    book: Book, make: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    units = [make("a b"), make("c")]
    how = Batch(None, 1, None, print_commands=True, status=False)
    assert execute(units, book.folder, how) is None
    lines = capsys.readouterr().out
    assert not book.folder.exists()
    subprocess.run(["sh", "-e"], input=lines, text=True, check=True, cwd=tmp_path)
    assert runs(tmp_path) == ["a b", "c"]


@pytest.mark.slow
def test_a_thousand_units(book: Book, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A thousand commands of no work, of which one in a hundred fails, and a second look at all of them."""
    units = [
        create_unit(f"unit {number}", ["sh", "-c", f"test {number % 100} != 7 && : > {number}.out"], [f"{number}.out"])
        for number in range(1000)
    ]
    how = Batch(Where.local, os.cpu_count() or 1, None, print_commands=False, status=False)
    begin = time.monotonic()
    found = execute(units, book.folder, how)
    seconds = time.monotonic() - begin
    assert found is not None
    assert (found.count(Status.done), found.count(Status.failed)) == (990, 10)
    assert "1000 units: 990 done, 10 failed" in capsys.readouterr().out
    assert all((tmp_path / f"{number}.out").exists() for number in range(1000) if number % 100 != 7)
    begin = time.monotonic()
    assert survey(book, units).count(Status.done) == 990
    with capsys.disabled():
        print(f"\n1000 units: {seconds:.1f} s; their status: {time.monotonic() - begin:.1f} s")
