"""The whole road by its commands: film, calibrate, track, capture, fit, evaluate."""

import re
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
from support import Run


def test_from_a_filmed_specimen_to_a_fitted_model(specimen_file: Path, run: Run, tmp_path: Path) -> None:
    """3-D markers within 0.05 mm of the truth, and a fit that lowers the held-out error."""

    def walk(name: str, *arguments: object) -> str:
        result = run(name, *arguments)
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout

    film = ("--loads-g", "60,90,75", "--frames", "25", "--youngs-modulus", "300000", "--poissons-ratio", "0.47")
    said = walk("rafl-render", specimen_file, "--out", "film", *film)
    assert "next: rafl-calibrate" in said
    said = walk("rafl-calibrate", "film/calibration", "--out", "calib.yaml")
    assert "next: rafl-track" in said
    said = walk("rafl-track", "film/videos", "--calib", "calib.yaml", "--specimen", specimen_file)
    assert "wrote 3 tracks files" in said
    assert said.count("100.0%") == 3

    with h5py.File(tmp_path / "film/truth.h5") as truth:
        names = [name.decode() for name in truth["marker_names"][()]]
        for recording in ("load060g", "load090g", "load075g"):
            with h5py.File(tmp_path / f"tracks/{recording}.h5") as tracks:
                assert list(tracks.attrs["marker_names"]) == names
                error = tracks["position"][()] - truth[recording]["position"][()]
                sigma = tracks["sigma"][()]
            by_axis = np.sqrt((error**2).mean(axis=(0, 1)))
            assert np.sqrt((error**2).mean()) < 5e-5
            # x and z are seen; y is the camera's plane, and said to be uncertain.
            assert by_axis[[0, 2]].max() < 1e-5
            assert np.abs(error[..., 1]).max() < sigma[..., 1].min()

    (tmp_path / "recordings.csv").write_text(
        "recording,load_g,split\nload060g,60,train\nload090g,90,train\nload075g,75,test\n"
    )
    said = walk("rafl-capture", specimen_file, "tracks", "--recordings", "recordings.csv", "--out", "small.h5")
    assert "next: rafl-fit small.h5" in said
    said = walk("rafl-fit", "small.h5", "--out", "run", "--epochs", "10", "--learning-rate", "0.002")
    assert "next: rafl-eval run small.h5" in said
    said = walk("rafl-fit", "small.h5", "--out", "sysid", "--method", "sysid", "--epochs", "4", "--frames", "10")
    assert "identified E" in said
    said = walk("rafl-eval", "run", "sysid", "small.h5", "--out", "result")
    last = r"held-out marker error: original ([\d.]+) mm, rafl ([\d.]+) mm, .*\nreport: result/report.html"
    found = re.search(last, said)
    assert found, said
    assert float(found[2]) < 0.8 * float(found[1])
    errors = pd.read_csv(tmp_path / "result/errors.csv")
    assert list(errors.columns) == ["dataset", "recording", "split", "method", "mean_mm", "std_mm"]
    assert set(errors["method"]) == {"original", "rafl", "sysid"}
    assert len(errors) == 9
    page = (tmp_path / "result/report.html").read_text()
    assert page.count("<img") == 6  # errors, markers, bodies and forces
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", page)  # where it may stand by chance
