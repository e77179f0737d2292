"""A real silicone cantilever recorded by motion capture: dataset and system identification."""

from pathlib import Path

import pandas as pd
import pytest
from support import ROOT, SHARED, Run

from rafl.data.dataset_file import read_dataset

FOLDER = SHARED / "real" / "clamped_beam"
SPECIMENS = ROOT / "datasets" / "specimens"
pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"real recordings absent at {FOLDER}"),
]


@pytest.mark.slow
def test_identified_material_reduces_the_error_on_the_held_out_recording(run: Run, tmp_path: Path) -> None:
    table = SPECIMENS / "clamped_beam_recordings.csv"
    capture = ("rafl-capture", SPECIMENS / "clamped_beam.yaml", FOLDER, "--recordings", table)
    result = run(*capture, "--out", "beam.h5")
    assert result.returncode == 2
    assert "Tip - 1" in result.stderr
    result = run(*capture, "--out", "beam.h5", "--tolerance-mm", "8")
    assert result.returncode == 0, result.stderr
    dataset = read_dataset(tmp_path / "beam.h5")
    assert dataset.split("test") == ["beam_load101_V2_a"]
    for item in dataset.trajectories.values():
        assert item.valid.all()
        assert item.attributes["registration_residual_mm"] < 1.0
        assert item.attributes["fit_residual_mm"] < 0.5
    result = run("rafl-fit", "beam.h5", "--method", "sysid", "--out", "sysid", "--frames", "60", "--epochs", "6")
    assert result.returncode == 0, result.stderr
    result = run("rafl-eval", "sysid", "beam.h5")
    assert result.returncode == 0, result.stderr
    errors = pd.read_csv(tmp_path / "sysid" / "errors.csv").query("split == 'test'").set_index("method")
    assert errors["mean_mm"]["sysid"] < 0.7 * errors["mean_mm"]["original"]


@pytest.mark.slow
def test_detected_release_agrees_with_the_study(run: Run, tmp_path: Path) -> None:
    """The release is within two frames of the first frame that the original study of the recordings chose by hand."""
    table = pd.read_csv(SPECIMENS / "clamped_beam_recordings.csv")
    table.drop(columns=["first_frame", "last_frame"]).to_csv(tmp_path / "recordings.csv", index=False)
    capture = ("rafl-capture", SPECIMENS / "clamped_beam.yaml", FOLDER, "--recordings", "recordings.csv")
    assert run(*capture, "--out", "beam.h5", "--tolerance-mm", "8", "--initial", "rest").returncode == 0
    trajectories = read_dataset(tmp_path / "beam.h5").trajectories
    for name, first in zip(table["recording"], table["first_frame"], strict=True):
        assert abs(int(str(trajectories[name].attributes["first_frame"])) - first) <= 2
        assert int(str(trajectories[name].attributes["still_frames"])) > 10
