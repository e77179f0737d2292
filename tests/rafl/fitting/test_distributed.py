"""Training in two processes gives the result of one process."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import write_dataset
from rafl.fitting.fit import fit
from rafl.fitting.run_folder import load_model

PROGRAM = Path(sys.executable).parent


def weights(run: Path) -> torch.Tensor:
    field = load_model(run).field
    assert field is not None
    return torch.cat([value.reshape(-1) for value in field.state_dict().values()])


@pytest.mark.slow
@pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no distributed training")
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
    torch.testing.assert_close(weights(tmp_path / "two"), weights(tmp_path / "one"), rtol=1e-4, atol=1e-6)
    one, two = (pd.read_csv(tmp_path / name / "history.csv") for name in ("one", "two"))
    assert two["epoch"].tolist() == [0, 1, 2]
    assert two["loss"][2] == pytest.approx(one["loss"][2], rel=1e-5)


def test_methods_of_one_process_are_refused(dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(tmp_path / "a.h5", dataset)
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="torchrun: expected method rafl"):
        fit(tmp_path / "a.h5", tmp_path / "run", "auto")
    assert not (tmp_path / "run").exists()
