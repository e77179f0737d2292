"""Recordings are added to a dataset file without a loss, whoever else changes it and whatever ends the program."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from filmed_markers import filmed, side_camera

from rafl.common.errors import InputError
from rafl.data import dataset_file
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import damaged_parts, read_dataset, update_dataset, write_dataset


def content(path: Path, name: str) -> dict[str, bytes]:
    """All arrays and attributes of a recording in a file."""
    found = {}
    with h5py.File(path) as file:
        group = file[f"trajectories/{name}"]
        group.visititems(lambda key, item: found.update({key: item[()].tobytes()} if hasattr(item, "dtype") else {}))
        found.update({f"attribute {key}": np.asarray(value).tobytes() for key, value in group.attrs.items()})
    return found


def test_update_replaces_or_adds_recordings_and_keeps_the_others(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    before = {name: content(path, name) for name in dataset.trajectories}
    changed = replace(dataset.trajectories["b"], split="test")
    update_dataset(path, replace(dataset, trajectories={"b": changed, "e": dataset.trajectories["a"]}, recipe="more"))
    assert sorted(read_dataset(path).trajectories) == ["a", "b", "c", "d", "e"]
    for name in ("a", "c", "d"):
        assert content(path, name) == before[name]
    assert read_dataset(path).trajectories["b"].split == "test"
    assert read_dataset(path).recipe == f"{dataset.recipe}\n# then\nmore"
    assert damaged_parts(path) == []
    other = replace(dataset, simulator=replace(dataset.simulator, mesh=dataset.simulator.mesh.scaled((1.1, 1, 1))))
    twice = replace(dataset, simulator=replace(dataset.simulator, substeps=2))
    for wrong, message in (
        (other, "another mesh"),
        (with_time_step(dataset, 0.0102), "frames/s"),
        (twice, "substeps 1"),
    ):
        with pytest.raises(InputError, match=message):
            update_dataset(path, wrong)
    assert content(path, "a") == before["a"]
    with pytest.raises(InputError, match=r"none\.h5"):
        update_dataset(tmp_path / "none.h5", dataset)


def test_two_updates_at_once_lose_nothing(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While one command has read the file and writes its own, another one has replaced it."""
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    write = dataset_file._write
    e, f = (replace(dataset, trajectories={name: dataset.trajectories["a"]}) for name in "ef")

    def interrupted(file: h5py.File, own: Dataset, recipe: str) -> None:
        monkeypatch.setattr(dataset_file, "_write", write)
        update_dataset(path, f)
        write(file, own, recipe)

    monkeypatch.setattr(dataset_file, "_write", interrupted)
    with pytest.raises(InputError, match=r"a\.h5 as this command has read it, found that another one has changed it"):
        update_dataset(path, e)
    assert sorted(read_dataset(path).trajectories) == ["a", "b", "c", "d", "f"]
    update_dataset(path, e)
    assert sorted(read_dataset(path).trajectories) == ["a", "b", "c", "d", "e", "f"]


def with_time_step(dataset: Dataset, step: float) -> Dataset:
    return replace(dataset, simulator=replace(dataset.simulator, time_step=step))


def test_update_tolerates_a_slightly_different_frame_rate(dataset: Dataset, tmp_path: Path) -> None:
    """The time step of the file does not change."""
    path = tmp_path / "a.h5"
    write_dataset(path, dataset)
    update_dataset(path, replace(with_time_step(dataset, 0.01002), trajectories={"e": dataset.trajectories["a"]}))
    assert read_dataset(path).simulator.time_step == dataset.simulator.time_step
    assert "e" in read_dataset(path).trajectories


KILL_WRITERS = """
import os, random, signal, sys, time
from dataclasses import replace
from pathlib import Path
from rafl.data.dataset_file import damaged_parts, read_dataset, update_dataset
path, random = Path(sys.argv[1]), random.Random(8)
dataset = read_dataset(path)
for _ in range(50):
    writer = os.fork()
    while not writer:
        update_dataset(path, dataset)
    time.sleep(random.uniform(0.005, 0.1))
    os.kill(writer, signal.SIGKILL)
    os.waitpid(writer, 0)
    print(damaged_parts(path))
"""


def test_killed_writers_leave_the_file_intact(dataset: Dataset, tmp_path: Path) -> None:
    """A process that rewrites the file repeatedly is killed at random times; the file is intact each time."""
    path = tmp_path / "a.h5"
    with_views = filmed(dataset, {"left": side_camera(0.0)}, moving=True)
    trajectories = {f"r{k}": with_views.trajectories["a"] for k in range(3)}
    write_dataset(path, replace(dataset, trajectories=trajectories))
    result = subprocess.run([sys.executable, "-c", KILL_WRITERS, str(path)], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == ["[]"] * 50
    assert sorted(read_dataset(path).trajectories) == sorted(trajectories)
    write_dataset(path, dataset)
    assert [item.name for item in tmp_path.iterdir()] == ["a.h5"]  # no temporary file is left
