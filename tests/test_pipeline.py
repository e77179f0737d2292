"""The complete pipeline by its commands: render, calibrate, track, capture, fit, evaluate."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from support import Run

from rafl.evaluation.evaluation_file import read_evaluation


def test_rendered_videos_to_fitted_model(specimen_file: Path, run: Run, tmp_path: Path) -> None:
    """The RMS error of the 3-D markers is below 0.05 mm, and the fit lowers the held-out error."""

    def output(name: str, *arguments: object) -> str:
        result = run(name, *arguments)
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout

    options = ("--loads-g", "60,90,75", "--frames", "12", "--youngs-modulus", "300000", "--poissons-ratio", "0.47")
    text = output("rafl-render", specimen_file, "--out", "film", *options)
    assert "next: rafl-calibrate" in text
    text = output("rafl-calibrate", "film/calibration", "--out", "calib.yaml")
    assert "next: rafl-track" in text
    text = output("rafl-track", "film/videos", "--calib", "calib.yaml", "--specimen", specimen_file)
    assert "wrote 3 tracks files" in text
    assert text.count("100.0%") == 3

    with h5py.File(tmp_path / "film/truth.h5") as truth:
        names = [name.decode() for name in truth["marker_names"][()]]
        for recording in ("load060g", "load090g", "load075g"):
            with h5py.File(tmp_path / f"tracks/{recording}.h5") as tracks:
                assert list(tracks.attrs["marker_names"]) == names
                error = tracks["position"][()] - truth[recording]["position"][()]
                sigma = tracks["sigma"][()]
            by_axis = np.sqrt((error**2).mean(axis=(0, 1)))
            assert np.sqrt((error**2).mean()) < 5e-5
            # The camera measures x and z. y follows from the plane of the markers, with a large sigma.
            assert by_axis[[0, 2]].max() < 1e-5
            assert np.abs(error[..., 1]).max() < sigma[..., 1].min()

    (tmp_path / "recordings.csv").write_text(
        "recording,load_g,split\nload060g,60,train\nload090g,90,train\nload075g,75,test\n"
    )
    text = output("rafl-capture", specimen_file, "tracks", "--recordings", "recordings.csv", "--out", "small.h5")
    assert "next: rafl-fit small.h5" in text
    text = output(
        "rafl-fit", "small.h5", "--out", "run", "--method", "rafl", "--epochs", "10", "--learning-rate", "0.002"
    )
    assert "next: rafl-eval run small.h5" in text
    text = output("rafl-fit", "small.h5", "--out", "sysid", "--method", "sysid", "--epochs", "4", "--frames", "10")
    assert "identified E" in text
    text = output("rafl-eval", "run", "sysid", "small.h5", "--out", "result")
    last = r"held-out marker error: original ([\d.]+) mm, rafl ([\d.]+) mm, .*\nreport: result/report.html"
    errors_mm = re.search(last, text)
    assert errors_mm, text
    assert float(errors_mm[2]) < 0.8 * float(errors_mm[1])
    errors = pd.read_csv(tmp_path / "result/errors.csv")
    assert list(errors.columns) == ["dataset", "recording", "split", "method", "mean_mm", "std_mm"]
    assert set(errors["method"]) == {"original", "rafl", "sysid"}
    assert len(errors) == 9
    page = (tmp_path / "result/report.html").read_text()
    (summary,) = re.findall(r'<script type="application/json" id="summary">([^<]*)</script>', page)
    assert json.loads(summary)["methods"] == ["original", "rafl", "sysid"]
    assert len(re.findall(r'<script type="text/plain" id="motion-\d">', page)) == 3
    compared = read_evaluation(tmp_path / "result/evaluation.h5").comparisons
    found = {(item.recording, name): 1e3 * own.mean() for item in compared for name, own in item.errors.items()}
    expected = errors.set_index(["recording", "method"])["mean_mm"].to_dict()
    assert found == pytest.approx(expected, abs=1e-6)
    forces = [{name: own.force is not None for name, own in item.motions.items()} for item in compared]
    assert forces == [{"original": False, "rafl": True, "sysid": False}] * 3
