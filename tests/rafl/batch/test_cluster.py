"""Units as array jobs: by submitit on this machine, and by SLURM where it is installed."""

import json
import os
import re
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from counted import Make, runs
from slurm import loopback_slurm, missing

from rafl.batch.cluster import Cluster, ClusterExecutor, read_cluster
from rafl.batch.execute import execute
from rafl.batch.options import Batch, Where
from rafl.batch.schedule import run_units
from rafl.batch.state import Book, Status
from rafl.batch.unit import Unit
from rafl.common.errors import InputError

SETTINGS = "format: rafl-cluster/1\n"
KILLED_ONCE = "marker = Path(folder, name + '.marker'); first = not marker.exists(); marker.touch()\n"


def write_settings(path: Path, text: str) -> Path:
    path.write_text(SETTINGS + text)
    return path


def test_settings_are_read(tmp_path: Path) -> None:
    text = "partition: short\nminutes: 30\ncpus: 2\nmemory_gb: 1.5\nsetup: [module load python]\noptions: {nice: 10}\n"
    found = read_cluster(write_settings(tmp_path / "cluster.yaml", text))
    assert (found.partition, found.minutes, found.cpus, found.memory_gb) == ("short", 30, 2, 1.5)
    assert (found.setup, found.options) == (("module load python",), {"nice": 10})
    assert read_cluster(None).minutes == 60


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("partion: short\n", "partion: .*not permitted"),
        ("minutes: 0\n", "minutes: .*greater than or equal to 1"),
        ("minutes: soon\n", "minutes: .*integer.*found 'soon'"),
        ("setup: module load python\n", "setup: "),
        ("partition: \"a\\nb\"\n", "partition: expected a name of visible characters"),
        ("options: {\"x\\n#SBATCH --y\": 1}\n", "(?s)options.*expected a name of visible characters"),
    ],
)  # fmt: skip
def test_mistakes_in_settings_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_cluster(write_settings(tmp_path / "cluster.yaml", text))
    assert "cluster.yaml" in str(error.value)


def test_no_slurm_is_told(book: Book, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(InputError, match="expected SLURM's program sbatch"):
        ClusterExecutor(book, Cluster())


def test_tasks_of_submitit_run_units(book: Book, make: Make, tmp_path: Path) -> None:
    """Submitit's executor of this machine: several units for each task, one that fails and one that is killed."""
    units = [make(f"unit {number}") for number in range(5)]
    units += [make("bad", "sys.exit('error: no')"), make("shot", KILLED_ONCE + "if first: os.kill(os.getpid(), 9)")]
    units += [make("last", needs=("unit 0", "shot"))]
    executor = ClusterExecutor(book, Cluster(units_per_task=3), "local")
    found = run_units(book, units, executor, lambda progress: None)
    assert found.status["bad"] == Status.failed
    assert found.count(Status.done) == 7
    assert Counter(runs(tmp_path)) == {unit.name: 2 if unit.name == "shot" else 1 for unit in units}
    state = book.state("unit 0")
    assert state is not None
    assert state.job


def test_a_full_queue_is_filled_again_once_half_of_it_has_ended(book: Book) -> None:
    executor = ClusterExecutor(book, Cluster(array_size=8, queued=10, units_per_task=3), "local")
    assert executor.free() == 8 * 3
    for tasks, free in ((2, 8 * 3), (4, 6 * 3), (5, 5 * 3), (6, 0), (10, 0)):
        executor.jobs = {f"unit {number}": str(number // 3) for number in range(3 * tasks)}
        assert executor.free() == free


needs_slurm = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing()) or os.geteuid() != 0, reason="no SLURM, or not root"),
]


@pytest.fixture
def slurm(tmp_path: Path) -> Iterator[Path]:
    with loopback_slurm(tmp_path / "slurm"):
        yield tmp_path


class TestSlurm:
    """Real SLURM with two nodes of one processor."""

    pytestmark = needs_slurm

    def run(self, book: Book, units: list[Unit]) -> None:
        settings = write_settings(book.base / "cluster.yaml", "memory_gb: 0.5\narray_size: 7\n")
        found = execute(units, book.folder, Batch(Where.slurm, 1, settings, print_commands=False, status=False))
        assert found is not None
        assert set(found.status.values()) == {Status.done}

    def test_arrays_and_order(self, slurm: Path, book: Book, make: Make) -> None:
        units = [make(f"; touch owned {number}") for number in range(9)]
        units.append(make("last", needs=tuple(unit.name for unit in units)))
        self.run(book, units)
        assert Counter(runs(slurm)) == {unit.name: 1 for unit in units}
        jobs = {state.job for unit in units if (state := book.state(unit.name)) is not None}
        assert len(jobs) == 10
        assert sum(re.fullmatch(r"\d+_\d+", job) is not None for job in jobs) >= 7
        assert not (book.folder / "jobs").exists()

    def test_a_preempted_job_goes_on(self, slurm: Path, book: Book, make: Make) -> None:
        """SLURM puts a job back into its queue, as after a preemption or the failure of a node."""
        unit = make("long", KILLED_ONCE + "if first: time.sleep(600)")
        book.write_units([unit])
        requeue = "while ! squeue --noheader --states R --format %i | grep . ; do sleep 0.5; done; sleep 3; "
        requeue += "scontrol requeue $(squeue --noheader --states R --format %i)"
        helper = subprocess.Popen(["sh", "-c", requeue], stdout=subprocess.DEVNULL)
        self.run(book, [unit])
        assert helper.wait() == 0
        assert runs(slurm) == ["long"] * 2

    def test_jobs_are_found_again(self, slurm: Path, book: Book, make: Make) -> None:
        """A program that is killed leaves its jobs in the queue; the next one does not submit them again."""
        units = [make(f"unit {number}", "time.sleep(1)") for number in range(6)]
        executor = ClusterExecutor(book, Cluster(memory_gb=0.5))
        executor.submit(units)
        time.sleep(2.0)
        self.run(book, units)
        assert Counter(runs(slurm)) == {unit.name: 1 for unit in units}
        assert len({state.job.split("_")[0] for unit in units if (state := book.state(unit.name)) is not None}) == 1

    def test_a_refused_submission_is_told(self, slurm: Path, book: Book, make: Make) -> None:
        executor = ClusterExecutor(book, Cluster(partition="absent"))
        with pytest.raises(InputError, match=r"expected sbatch to take 1 tasks, found: .*partition"):
            executor.submit([make("a")])
        assert json.dumps(executor.jobs) == "{}"
