"""Run a list of units by an executor, each once, until all have ended."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice

from rafl.batch.executor import Executor
from rafl.batch.state import Book, Status
from rafl.batch.unit import Unit, check_units, producers

RESTARTS = 3  # of a unit that something else has killed
LOST = "killed with its process, or with its machine"


@dataclass
class Progress:
    """How far a list of units is.

    Attributes:
        status: of every unit, by name.
        reasons: why units failed, were killed or cannot run, by name.
    """

    status: dict[str, Status]
    reasons: dict[str, str] = field(default_factory=dict)

    def count(self, *kinds: Status) -> int:
        """Number of units of some status."""
        return sum(status in kinds for status in self.status.values())


def survey(book: Book, units: Sequence[Unit]) -> Progress:
    """The status of every unit, from its files; nothing is run."""
    found = Progress({})
    for unit in units:
        state = book.state(unit.name)
        status = Status.waiting if state is None else state.status
        if status == Status.done and not book.is_done(unit):
            status, state = Status.waiting, None
        elif status != Status.done and book.is_running(unit.name):
            status = Status.running
        elif status == Status.running:
            status = Status.killed
            found.reasons[unit.name] = LOST
        found.status[unit.name] = status
        if state is not None and state.reason and status in (Status.failed, Status.killed):
            found.reasons[unit.name] = state.reason
    _mark_blocked(found, producers(units))
    return found


def _mark_blocked(progress: Progress, needs: dict[str, set[str]]) -> None:
    """Mark units that wait for a unit that failed, was killed for the last time, or is blocked itself."""
    changed = True
    while changed:
        changed = False
        for name, status in progress.status.items():
            if status != Status.waiting:
                continue
            ill = [other for other in needs[name] if progress.status[other] in (Status.failed, Status.blocked)]
            if ill:
                progress.status[name] = Status.blocked
                progress.reasons[name] = f"needs {ill[0]}"
                changed = True


def run_units(
    book: Book,
    units: Sequence[Unit],
    executor: Executor,
    report: Callable[[Progress], None],
) -> Progress:
    """Run all units that are not done; those that failed before are run again.

    A unit that fails is not tried again before the next call. One that something else killed is, some times. A unit
    whose process lives although another program started it is waited for.

    Args:
        book: of the units.
        units: all of them.
        executor: that runs them.
        report: called with the progress whenever it has changed.

    Raises:
        InputError: units that cannot run beside each other, or a damaged state.
    """
    check_units(units)
    book.write_units(units)
    run = _Run(book, units, executor)
    try:
        while not run.has_ended():
            if run.step():
                report(run.progress)
            else:
                time.sleep(executor.pause_s)
    except BaseException:
        executor.stop()
        raise
    report(run.progress)
    return run.progress


class _Run:
    """One call of `run_units`."""

    def __init__(self, book: Book, units: Sequence[Unit], executor: Executor) -> None:
        self.book, self.executor = book, executor
        self.units = {unit.name: unit for unit in units}
        self.needs = producers(units)
        self.restarts = dict.fromkeys(self.units, 0)
        self.attempts = dict.fromkeys(self.units, 0)  # before this call, and since it was last looked at
        self.submitted: set[str] = executor.running() & self.units.keys()
        self.elsewhere: set[str] = set()
        self.progress = Progress(dict.fromkeys(self.units, Status.waiting))
        for name in self.units:
            state = book.state(name)
            self.attempts[name] = state.attempts if state is not None else 0
            if name in self.submitted:
                self.progress.status[name] = Status.queued
            elif book.is_done(self.units[name]):
                self.progress.status[name] = Status.done
            elif book.is_running(name):
                self._wait_for(name)

    def has_ended(self) -> bool:
        """Whether no unit runs or can still run."""
        return self.progress.count(Status.waiting, Status.queued, Status.running) == 0

    def step(self) -> bool:
        """Look at the units that ran, and submit others; returns whether anything changed."""
        running = self.executor.running()
        ended = self.submitted - running
        ended |= {name for name in self.elsewhere if not self.book.is_running(name)}
        self.submitted -= ended
        self.elsewhere -= ended
        for name in ended:
            self._look_at(name)
        if any(self.progress.status[name] == Status.failed for name in ended):
            _mark_blocked(self.progress, self.needs)
        free = self.executor.free()
        ready = list(islice((unit for name, unit in self.units.items() if self._is_ready(name)), max(free, 0)))
        if ready:
            self.executor.submit(ready)
            self.submitted |= {unit.name for unit in ready}
            self.progress.status |= dict.fromkeys((unit.name for unit in ready), self.executor.submitted)
        return bool(ended or ready)

    def _is_ready(self, name: str) -> bool:
        return self.progress.status[name] == Status.waiting and all(
            self.progress.status[other] == Status.done for other in self.needs[name]
        )

    def _look_at(self, name: str) -> None:
        """Enter how a unit ended; one that was killed waits again, unless that happened too often."""
        if self.book.is_done(self.units[name]):
            self.progress.status[name] = Status.done
            return
        if self.book.is_running(name):
            self._wait_for(name)
            return
        state = self.book.state(name)
        tried = state is not None and state.attempts > self.attempts[name]
        self.attempts[name] = state.attempts if state is not None else 0
        if state is not None and tried and state.status == Status.failed:
            self.progress.status[name], self.progress.reasons[name] = Status.failed, state.reason
            return
        self.restarts[name] += 1
        self.progress.status[name] = Status.waiting
        if self.restarts[name] > RESTARTS:
            reason = state.reason if state is not None and tried and state.reason else LOST
            self.progress.status[name] = Status.failed
            self.progress.reasons[name] = f"{reason}, {self.restarts[name]} times"

    def _wait_for(self, name: str) -> None:
        self.elsewhere.add(name)
        self.progress.status[name] = Status.running
