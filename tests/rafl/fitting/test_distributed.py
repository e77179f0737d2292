"""Training in several processes gives the result of one process, and ends in all where it ends in one."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from support import assert_refused, error_lines
from together import LONGEST, run_together

from rafl.data.dataset import Dataset
from rafl.data.dataset_file import write_dataset
from rafl.fitting.fit import fit
from rafl.fitting.material_search import MaterialSearch
from rafl.fitting.run_folder import load_tensors

PROGRAM = Path(sys.executable).parent
SAME = 1e-9  # relative difference that rounding may cause

pytestmark = pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no distributed training")


def numbers(content: Any) -> np.ndarray:
    """All numbers of a model file, in order."""
    if isinstance(content, torch.Tensor):
        return content.double().reshape(-1).numpy()
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, (list, tuple)):
        return np.concatenate([np.empty(0), *map(numbers, content)])
    return np.array([content], float) if isinstance(content, (int, float)) else np.empty(0)


def assert_same_run(one: Path, other: Path, tolerance: float = SAME) -> None:
    """Both runs have the same model, and tables of the same numbers."""
    models = [numbers(load_tensors(run / "model.pt", "a model")) for run in (one, other)]
    assert len(models[0]) > 1
    np.testing.assert_allclose(models[1], models[0], rtol=tolerance)
    tables = {path.name for path in one.glob("*.csv")}
    assert tables == {path.name for path in other.glob("*.csv")}
    assert "history.csv" in tables
    for name in tables:
        pd.testing.assert_frame_equal(pd.read_csv(other / name), pd.read_csv(one / name), rtol=tolerance)


@pytest.fixture(scope="module")
def folder(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a dataset file, `a.h5`, with two training recordings of different lengths."""
    folder = tmp_path_factory.mktemp("distributed")
    shorter = {**dataset.trajectories, "b": dataset.trajectories["b"].first_frames(20)}
    write_dataset(folder / "a.h5", replace(dataset, trajectories=shorter))
    return folder


def fit_together(count: int, folder: Path, *options: object) -> subprocess.CompletedProcess[str]:
    """Run rafl-fit in several processes: all succeed, and only the first prints something."""
    first, *others = run_together(count, folder, "rafl-fit", "a.h5", *options)
    assert first.returncode == 0, first.stderr
    assert "wrote" in first.stdout
    for other in others:
        assert (other.returncode, other.stdout, error_lines(other.stderr)) == (0, "", [])
    return first


@pytest.mark.parametrize(
    ("method", "count", "options", "tolerance"),
    [
        ("sysid", 3, {"epochs": 2}, SAME),  # the third process has no recording
        pytest.param("constitutive", 2, {"epochs": 2}, SAME, marks=pytest.mark.slow),
        pytest.param("auto", 2, {"epochs": 1}, SAME, marks=pytest.mark.slow),
        ("srl", 2, {"epochs": 2}, SAME),
        ("rafl", 2, {"epochs": 1, "batch": 2, "warm-start": 1}, 1e-5),  # gradients in single precision
    ],
)
def test_several_processes_give_the_result_of_one(
    method: str, count: int, options: dict[str, int], tolerance: float, folder: Path
) -> None:
    one, several = folder / f"{method}-one", folder / f"{method}-several"
    own = {key.replace("-", "_"): value for key, value in options.items()}
    fit(folder / "a.h5", one, method, frames=8, **own)
    given = [word for key, value in options.items() for word in (f"--{key}", value)]
    first = fit_together(count, folder, "--method", method, "--frames", 8, "--out", several, *given)
    assert ("3 processes share 2 training recordings" in first.stderr) == (count == 3)
    assert_same_run(one, several, tolerance)


def test_fit_is_resumed_by_another_number_of_processes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What two processes resume ends like an uninterrupted fit. One process repeats no simulation."""
    whole, broken = folder / "whole", folder / "broken"
    fit(folder / "a.h5", whole, "sysid-e", frames=8, epochs=2)

    def stop(row: dict[str, float]) -> None:
        if row["epoch"] == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(folder / "a.h5", broken, "sysid-e", frames=8, epochs=2, report=stop)
    fit_together(2, folder, "--method", "sysid-e", "--frames", 8, "--epochs", 2, "--out", broken, "--resume")
    assert_same_run(whole, broken)
    for name in ("model.pt", "history.csv", "parameters.csv"):
        (broken / name).unlink()
    monkeypatch.setattr(MaterialSearch, "_simulate", None)
    fit(folder / "a.h5", broken, "sysid-e", frames=8, epochs=2, resume=True)
    assert_same_run(whole, broken)


def test_simulation_that_fails_in_one_process_ends_all(dataset: Dataset, tmp_path: Path) -> None:
    """The process of the other recording raises the same error; it is printed once, and no run remains."""
    torn = replace(dataset.trajectories["b"], load=np.full_like(dataset.trajectories["b"].load, 1e4))
    write_dataset(tmp_path / "a.h5", replace(dataset, trajectories={**dataset.trajectories, "b": torn}))
    first, second = run_together(2, tmp_path, "rafl-fit", "a.h5", "--method", "sysid", "--out", "run")
    assert first.returncode == 1
    assert second.returncode != 0
    (line,) = error_lines(first.stderr)
    assert line.startswith("error: step 1: trajectory 0 did not converge")
    assert line.endswith("[trajectories: b]")
    assert error_lines(second.stderr) == []
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (("--method", "none"), "--method: expected"),
        (("--each",), "torchrun: expected one fit"),
        (("--method", "sysid", "--out", "taken"), "already holds a run"),
    ],
)
def test_error_of_the_user_is_printed_once(options: tuple[str, ...], part: str, folder: Path) -> None:
    """Errors of the options, which all processes find, and one of the run folder, which only the first sees."""
    (folder / "taken").mkdir(exist_ok=True)
    (folder / "taken" / "config.yaml").write_text("format: rafl-run/1\n")
    first, second = run_together(2, folder, "rafl-fit", "a.h5", *options)
    assert_refused(first, part)
    assert second.returncode != 0
    assert error_lines(second.stderr) == []


def test_option_that_cannot_be_read_is_reported_once(folder: Path) -> None:
    first, second = run_together(2, folder, "rafl-fit", "a.h5", "--epochs", "many")
    assert first.returncode == 2
    assert "Invalid value for '--epochs'" in first.stderr
    assert second.returncode != 0
    assert error_lines(second.stderr) == []


def test_interruption_ends_all_processes(folder: Path) -> None:
    """As torchrun does after Ctrl-C, all get a signal, wherever they are."""
    run = folder / "interrupted"

    def interrupt(processes: list[BaseProcess]) -> None:
        limit = time.monotonic() + LONGEST
        while not (run / "checkpoint-start.pt").exists() and time.monotonic() < limit:
            time.sleep(0.02)
        for process in processes:
            os.kill(process.pid or 0, signal.SIGINT)

    first, second = run_together(
        2, folder, "rafl-fit", "a.h5", "--method", "sysid-branches", "--out", run, during=interrupt
    )
    assert (first.returncode, second.returncode) == (130, 130)
    assert error_lines(first.stderr)[-1] == "interrupted; no incomplete file was left"
    assert error_lines(second.stderr) == []
    assert not list(run.glob(".*"))


@pytest.mark.slow
def test_torchrun_equals_one_process(dataset: Dataset, tmp_path: Path) -> None:
    write_dataset(tmp_path / "a.h5", dataset)
    fit = ["a.h5", "--method", "rafl", "--epochs", "2", "--frames", "8", "--batch", "2", "--seed", "4"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def run(*command: object) -> None:
        result = subprocess.run([*map(str, command)], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert result.returncode == 0, result.stdout + result.stderr

    run(PROGRAM / "rafl-fit", *fit, "--out", "one")
    torchrun = [PROGRAM / "torchrun", "--standalone", "--nproc-per-node", 2, PROGRAM / "rafl-fit"]
    run(*torchrun, *fit, "--out", "two")
    assert_same_run(tmp_path / "one", tmp_path / "two", 1e-4)
