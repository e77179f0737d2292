"""Many trials, of which a seed repeats each: `python tests/fuzz/fuzz.py --trials 1000 --jobs 2`.

Workers run the trials in turn. One that ends, or takes too long or too much memory, has failed its trial.
"""

import argparse
import faulthandler
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict
from multiprocessing.connection import Connection, wait
from pathlib import Path

from laboratory import make_laboratory
from trials import TARGETS, run_line, trial

TIME_LIMIT_S = 30.0  # of a processor's time, and four times as much by the clock
MEMORY_LIMIT_BYTES = 3_000_000_000
FRESH_WORKER = 500  # trials after which a worker is replaced: libraries keep some memory of each


def prepare(folder: Path) -> Path:
    """A laboratory with a run and a dataset that was built, by the commands."""
    laboratory = folder / "laboratory"
    make_laboratory(laboratory)
    before = Path.cwd()
    os.chdir(laboratory)
    try:
        fit = ("rafl-fit", "data.h5", *TARGETS["settings"][1][2:-2], "run")
        for line in (TARGETS["specimen"][1], fit, ("rafl-eval", "run", "data.h5")):
            code, stderr, error = run_line(line)
            if code:
                raise RuntimeError(f"{line}: exit code {code}: {stderr}") from error
        (laboratory / "run" / "report.html").unlink(missing_ok=True)
    finally:
        os.chdir(before)
    return laboratory


def run_copy(line: tuple[str, ...], laboratory: Path, folder: Path) -> None:
    """Run a command in a copy of the laboratory."""
    shutil.copytree(laboratory, folder)
    os.chdir(folder)
    run_line(line)
    os.chdir(laboratory)
    shutil.rmtree(folder)


def work(connection: Connection, laboratory: Path, folder: Path) -> None:
    """Run the trials whose seeds come through the connection."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_LIMIT_BYTES,) * 2)
    faulthandler.register(signal.SIGUSR1, (folder / f"stack-{os.getpid()}").open("w"))
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)  # what HDF5 and FFmpeg print by themselves
    for target in ("specimen", "dataset, fit", "dataset, evaluate", "calibration"):  # loads the kernels
        run_copy(TARGETS[target][1], laboratory, folder / f"first-{os.getpid()}")
    connection.send("ready")
    while (seed := connection.recv()) is not None:
        connection.send(asdict(trial(seed, laboratory, folder / str(seed))))


class Worker:
    """A process and the trial that it runs."""

    def __init__(self, laboratory: Path, folder: Path) -> None:
        self.connection, other = multiprocessing.Pipe()
        self.process = multiprocessing.Process(target=work, args=(other, laboratory, folder), daemon=True)
        self.process.start()
        other.close()
        self.connection.recv()  # that it is ready
        self.seed, self.started, self.seconds_before, self.trials = -1, 0.0, 0.0, 0

    def begin(self, seed: int) -> None:
        """Start a trial."""
        self.seed, self.started = seed, time.monotonic()
        self.seconds_before += self.seconds()
        self.trials += 1
        self.connection.send(seed)

    def seconds(self) -> float:
        """Processor time of the process, and of its own that have ended, since the last trial began [s]."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            return 0.0
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK") - self.seconds_before

    def stack(self, folder: Path) -> str:
        """Where the process is, in all its threads."""
        os.kill(self.process.pid or 0, signal.SIGUSR1)
        time.sleep(1.0)
        return (folder / f"stack-{self.process.pid}").read_text()

    def end(self) -> None:
        """Stop the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run_trials(seeds: list[int], jobs: int, minutes: float, laboratory: Path, folder: Path) -> list[dict[str, object]]:
    """The outcomes of the trials, by `trials.Outcome`, with seed and seconds."""
    waiting, outcomes, end = list(reversed(seeds)), [], time.monotonic() + 60.0 * minutes
    workers = [Worker(laboratory, folder) for _ in range(min(jobs, len(seeds)))]
    for worker in workers:
        worker.begin(waiting.pop())
    while workers:
        if time.monotonic() > end:
            waiting.clear()
        ready = wait([worker.connection for worker in workers], 1.0)
        for worker in list(workers):
            seconds = time.monotonic() - worker.started
            found = None
            if worker.connection in ready:
                try:
                    found = worker.connection.recv()
                except EOFError:
                    worker.process.join()
                    found = {"wrong": f"the process ended with {worker.process.exitcode}"}
            elif worker.seconds() > TIME_LIMIT_S or seconds > 4.0 * TIME_LIMIT_S:
                found = {"wrong": f"no end within {TIME_LIMIT_S:g} s:\n{worker.stack(folder)}"}
            if found is None:
                continue
            outcomes.append({"target": "?", "kind": "?", "code": None, "message": "", **found})
            outcomes[-1] |= {"seed": worker.seed, "seconds": seconds}
            if found["wrong"]:
                print(_description(outcomes[-1]), flush=True)
            alive = worker.process.is_alive() and "target" in found
            if not alive or worker.trials >= FRESH_WORKER or not waiting:
                worker.end()
                shutil.rmtree(folder / str(worker.seed), ignore_errors=True)
                workers.remove(worker)
                if waiting:
                    workers.append(worker := Worker(laboratory, folder))
            if waiting and worker in workers:
                worker.begin(waiting.pop())
    return outcomes


def _description(item: dict[str, object]) -> str:
    return f"seed {item['seed']}, {item['target']}, {item['kind']}, {item['seconds']:.1f} s: {item['wrong']}\n"


def print_counts(outcomes: list[dict[str, object]]) -> None:
    """One line for each kind of file and its exit codes, and one for the kinds of changes."""
    counts = Counter((str(item["target"]), str(item["code"])) for item in outcomes)
    for target in sorted({target for target, _ in counts}):
        codes = ", ".join(f"{count} x {code}" for (name, code), count in sorted(counts.items()) if name == target)
        print(f"{target:22} exit codes: {codes}")
    kinds = Counter(str(item["kind"]).rstrip(" 0123456789") for item in outcomes)
    print("changes:", ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items())))


def main() -> None:
    """Run trials and end with code 1 if one was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial; each has the next number")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no trial begins")
    parser.add_argument("--log", type=Path, help="write every outcome to this file, one JSON object a line")
    options = parser.parse_args()
    start = time.monotonic()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends the workers too
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # In a process of its own: OpenMP ends workers that are forked from a process that has used it.
        first = multiprocessing.Process(target=prepare, args=(folder,))
        first.start()
        first.join()
        laboratory = folder / "laboratory"
        seeds = list(range(options.seed, options.seed + options.trials))
        outcomes = run_trials(seeds, options.jobs, options.minutes, laboratory, folder)
    if options.log:
        options.log.write_text("".join(json.dumps(item) + "\n" for item in outcomes))
    print_counts(outcomes)
    wrong = sum(bool(item["wrong"]) for item in outcomes)
    print(f"\n{len(outcomes)} trials in {time.monotonic() - start:.0f} s, {wrong} of them wrong")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
