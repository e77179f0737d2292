"""Units as array jobs of a cluster, submitted by submitit."""

import getpass
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import submitit
from pydantic import AfterValidator, Field

from rafl.batch.json_files import read_json, write_json
from rafl.batch.runner import run_unit
from rafl.batch.state import Book, Status
from rafl.batch.unit import Unit
from rafl.common.errors import InputError
from rafl.common.names import check_visible
from rafl.common.yaml_files import StrictModel, read_yaml

FORMAT = "rafl-cluster/1"
JOBS_FORMAT = "rafl-jobs/1"
JOBS_FILE, JOBS_FOLDER = "jobs.json", "jobs"
MAX_JOBS_BYTES = 100_000_000
SQUEUE_TIMEOUT_S = 60.0
PATIENCE_S = 600.0  # for a controller that does not answer
JOB_NAME = "rafl"
COMPLETING = "CG"  # a job whose processes have ended, or whose node does not answer; a unit's lock tells which

Positive = Annotated[int, Field(ge=1)]
Line = Annotated[str, AfterValidator(check_visible)]
OptionalLine = Annotated[str, AfterValidator(lambda text: text and check_visible(text))]


class Cluster(StrictModel):
    """Content of `cluster.yaml`.

    Attributes:
        partition, account, qos, constraint: as sbatch takes them; those of the cluster if empty.
        minutes: time limit of a task.
        cpus: of a task; its commands have as many threads.
        memory_gb: of a task.
        at_once: tasks of an array that run at the same time.
        array_size: largest array that the cluster takes (MaxArraySize).
        queued: tasks that are in the queue of the cluster at the same time.
        units_per_task: units that a task runs one after another.
        setup: lines of shell before each task, such as `module load python`.
        options: further options of sbatch, by name.
    """

    partition: OptionalLine = ""
    account: OptionalLine = ""
    qos: OptionalLine = ""
    constraint: OptionalLine = ""
    minutes: Positive = 60
    cpus: Positive = 1
    memory_gb: Annotated[float, Field(gt=0.0)] = 4.0
    at_once: Positive = 256
    array_size: Positive = 1000
    queued: Positive = 1000
    units_per_task: Positive = 1
    setup: tuple[Line, ...] = ()
    options: dict[Line, OptionalLine | int | bool] = Field(default_factory=dict)


class _ClusterFile(Cluster):
    """`cluster.yaml` with its format."""

    format: str


class _Jobs(StrictModel):
    """Content of `jobs.json`: the job of every submitted unit."""

    jobs: dict[str, str]


def read_cluster(path: Path | None) -> Cluster:
    """Read `cluster.yaml`; without a path, the defaults.

    Raises:
        InputError: as `rafl.common.yaml_files.read_yaml` says.
    """
    if path is None:
        return Cluster()
    return read_yaml(path, _ClusterFile, "the settings of a cluster", FORMAT)


def remove_job_files(book: Book) -> None:
    """Remove what submitit has written, once nothing has to be looked up in it any more."""
    shutil.rmtree(book.folder / JOBS_FOLDER, ignore_errors=True)
    (book.folder / JOBS_FILE).unlink(missing_ok=True)


class ArrayTask:
    """What one task of an array does. submitit calls it, and submits it again if the cluster preempts it."""

    def __init__(self, folder: str, base: str, units: Sequence[Unit], threads: int) -> None:
        self.folder, self.base, self.threads = folder, base, threads
        self.units = [unit.model_dump_json() for unit in units]

    def __call__(self) -> None:
        """Run the units, one after another. Those that are done are left out."""
        job = submitit.JobEnvironment().job_id
        for unit in self.units:
            run_unit(Book(Path(self.folder), Path(self.base)), Unit.model_validate_json(unit), self.threads, job)

    def checkpoint(self) -> submitit.helpers.DelayedSubmission:
        """What is submitted after a preemption: the same, because units are resumed from their own files."""
        return submitit.helpers.DelayedSubmission(self)


class ClusterExecutor:
    """Runs units as array jobs. They go on if this program ends; the next one finds them in the queue.

    Args:
        book: of the units.
        settings: of the cluster.
        kind: of submitit's executor; `local` runs tasks in processes of this machine.

    Raises:
        InputError: no SLURM on this machine, or settings that it does not take.
    """

    submitted = Status.queued

    def __init__(self, book: Book, settings: Cluster, kind: Literal["slurm", "local"] = "slurm") -> None:
        self.book, self.settings, self.kind = book, settings, kind
        self.pause_s = 5.0 if kind == "slurm" else 0.2
        if kind == "slurm" and shutil.which("sbatch") is None:
            raise InputError("--on slurm: expected SLURM's program sbatch, found none; run it on the login node")
        self.jobs: dict[str, str] = {}
        path = book.folder / JOBS_FILE
        if kind == "slurm" and path.exists():
            self.jobs = read_json(path, _Jobs, "the jobs of units", JOBS_FORMAT, MAX_JOBS_BYTES).jobs
        self.handles: dict[str, submitit.Job[None]] = {}
        self.alive: set[str] = set()
        self.answered = time.monotonic()

    def free(self) -> int:
        """Number of units that can be submitted now: none until half of a full queue has ended."""
        own = self.settings
        room = own.queued - len(set(self.jobs.values()))
        return min(room, own.array_size) * own.units_per_task if 2 * room >= own.queued else 0

    def running(self) -> set[str]:
        """Names of the submitted units whose job is in the queue or runs."""
        if self.kind == "local":
            self.alive = {job for job, handle in self.handles.items() if not handle.done()}
        elif self.jobs:
            self.alive = self._queue()
        self.jobs = {name: job for name, job in self.jobs.items() if job in self.alive}
        return set(self.jobs)

    def _queue(self) -> set[str]:
        """Numbers of this user's jobs that the controller has; the last ones as long as it does not answer.

        Raises:
            InputError: it has not answered for long.
        """
        line = ["squeue", "--noheader", "--array", "--user", getpass.getuser(), "--format", "%i %t"]
        try:
            found = subprocess.run(line, capture_output=True, text=True, timeout=SQUEUE_TIMEOUT_S, check=True)
        except (OSError, subprocess.SubprocessError) as error:
            if time.monotonic() - self.answered > PATIENCE_S:
                raise InputError(
                    f"--on slurm: expected an answer of squeue, found none for {PATIENCE_S / 60:.0f} minutes "
                    f"({error!s:.80}); the jobs go on, and the same command follows them later"
                ) from None
            return self.alive or set(self.jobs.values())
        self.answered = time.monotonic()
        pairs = [line.split() for line in found.stdout.splitlines()]
        return {job for job, state in pairs if state != COMPLETING}

    def submit(self, units: Sequence[Unit]) -> None:
        """Submit units as one array.

        Raises:
            InputError: the cluster refuses it.
        """
        size = self.settings.units_per_task
        folder, base = str(self.book.folder.absolute()), str(self.book.base)
        parts = [units[first : first + size] for first in range(0, len(units), size)]
        tasks = [ArrayTask(folder, base, part, self.settings.cpus) for part in parts]
        try:
            executor = submitit.AutoExecutor(self.book.folder / JOBS_FOLDER, cluster=self.kind)
            executor.update_parameters(**self._parameters())
            with executor.batch():
                handles = [executor.submit(task) for task in tasks]
        except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError) as error:
            raise InputError(f"--on slurm: expected sbatch to take {len(tasks)} tasks, found: {error!s:.300}") from None
        for part, handle in zip(parts, handles, strict=True):
            self.handles[handle.job_id] = handle
            self.jobs |= dict.fromkeys((unit.name for unit in part), handle.job_id)
        if self.kind == "slurm":
            write_json(self.book.folder / JOBS_FILE, _Jobs(jobs=self.jobs), JOBS_FORMAT)

    def _parameters(self) -> dict[str, Any]:
        """The settings as submitit takes them."""
        own = self.settings
        named = {key: getattr(own, key) for key in ("partition", "account", "qos", "constraint") if getattr(own, key)}
        return {
            "name": JOB_NAME,
            "timeout_min": own.minutes,
            "cpus_per_task": own.cpus,
            "mem_gb": own.memory_gb,
            "slurm_array_parallelism": own.at_once,
            "slurm_setup": list(own.setup),
            "slurm_additional_parameters": dict(own.options),
            **{f"slurm_{key}": value for key, value in named.items()},
        }

    def stop(self) -> None:
        """The jobs of a cluster go on; those of this machine are ended."""
        if self.kind == "local":
            for handle in self.handles.values():
                handle.cancel()
