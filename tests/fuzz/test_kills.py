"""`rafl-capture` and `rafl-fit` on pixels, killed at any time: no file is damaged, and the next run completes it."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from fuzz import prepare
from support import folder_content
from trials import TARGETS

from rafl.data.dataset_file import damaged_parts, read_dataset
from rafl.fitting.run_folder import load_tensors

pytestmark = pytest.mark.slow
KILLS = 3
FITS = {
    "sysid": ("--method", "sysid", "--epochs", "3"),
    "rafl": ("--method", "rafl", "--epochs", "4", "--frames", "4"),
}


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("kills"))


def start(folder: Path, *line: str) -> subprocess.Popen[bytes]:
    """A command in its own process: kernels compiled in this process round differently from cached kernels."""
    program = Path(sys.executable).parent / line[0]
    return subprocess.Popen([program, *line[1:]], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()


def test_killed_capture_leaves_the_dataset_intact(laboratory: Path, tmp_path: Path) -> None:
    """It rewrites a dataset with pixels; each kill leaves the one before or the new one, as a whole."""
    folder, line = tmp_path / "laboratory", TARGETS["update"][1]
    shutil.copytree(laboratory, folder)
    path, before, began = folder / "out" / "data.h5", folder_content(folder), time.monotonic()
    assert start(folder, *line).wait() == 0
    whole, took = read_dataset(path), time.monotonic() - began
    for share in (0.5, 0.8, 0.9, 0.95, 1.0):
        process = start(folder, *line)
        time.sleep(share * took)
        kill(process)
        assert damaged_parts(path) == []
    assert start(folder, *line).wait() == 0
    assert folder_content(folder) == before
    again = read_dataset(path)
    for name, item in whole.trajectories.items():
        own = again.trajectories[name]
        np.testing.assert_array_equal(own.q, item.q)
        for camera, view in item.views.items():
            np.testing.assert_array_equal(own.views[camera].pixel, view.pixel)
            np.testing.assert_array_equal(own.views[camera].covariance, view.covariance)


@pytest.mark.parametrize("method", FITS)
def test_killed_fit_of_pixels_ends_like_an_undisturbed_one(laboratory: Path, tmp_path: Path, method: str) -> None:
    line = ("rafl-fit", "data.h5", *FITS[method], "--objective", "image", "--resume", "--out")
    shutil.copy(laboratory / "data.h5", tmp_path)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert start(tmp_path, *line, "whole").wait() == 0
    random = np.random.default_rng(0)
    checkpoint, seen = broken / "checkpoint.pt", 0
    for _ in range(KILLS):
        process = start(tmp_path, *line, "broken")
        while process.poll() is None and (not checkpoint.exists() or checkpoint.stat().st_mtime_ns == seen):
            time.sleep(0.001)
        time.sleep(random.uniform(0.0, 0.1))
        assert process.poll() is None
        kill(process)
        seen = checkpoint.stat().st_mtime_ns
    assert start(tmp_path, *line, "broken").wait() == 0
    assert (broken / "history.csv").read_text() == (whole / "history.csv").read_text()
    contents = [load_tensors(run / "model.pt", "a model") for run in (whole, broken)]
    assert contents[0].keys() == contents[1].keys()
    assert contents[0].get("material") == contents[1].get("material")
    for key, weights in contents[0].get("field", {}).items():
        assert torch.equal(weights, contents[1]["field"][key])
