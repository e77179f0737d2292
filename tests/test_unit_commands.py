"""Commands with --on: the files of the plain commands, made by one process for each unit."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from laboratory import make_laboratory
from support import Run, assert_refused, folder_content

PLAN = """format: rafl-sweep/1
specimens: ["specimens/*"]
methods: [sysid-e, {method: rafl, name: field, options: {epochs: 1, frames: 4, warm-start: 0, from: sysid-e}}]
seeds: [0, 1]
"""


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab") / "lab"
    make_laboratory(folder)
    return folder


def test_track_makes_the_files_of_the_plain_command(laboratory: Path, run: Run, tmp_path: Path) -> None:
    videos = tmp_path / "videos; touch owned"
    videos.mkdir()
    film = (laboratory / "videos" / "take1.mp4").read_bytes()
    for name in ("take 1", "take 2"):
        (videos / f"{name}.mp4").write_bytes(film)
    (videos / "broken.mp4").write_bytes(film[:100])
    command = ("rafl-track", videos, "--calib", laboratory / "calib.yaml", "--export", "csv,npy", "--fill", "3")
    printed = run(*command, "--print-commands").stdout.splitlines()
    assert [line.rpartition("--recording ")[2] for line in printed] == ["broken", "'take 1'", "'take 2'"]
    assert not (tmp_path / "tracks").exists()
    result = run(*command, "--on", "local", "--jobs", "2")
    assert result.returncode == 1
    assert "3 units: 2 done, 1 failed" in result.stdout
    assert "error: unit broken: " in result.stderr
    assert "failed" in run(*command, "--status").stdout
    plain = run(*command, "--out", "plain")
    assert plain.returncode == 1
    made = {path.name: path.read_bytes() for path in (tmp_path / "tracks").iterdir() if path.is_file()}
    for path in (tmp_path / "plain").iterdir():
        if path.name != "report.html":
            assert made.pop(path.name) == path.read_bytes(), path.name
    assert list(made) == ["report.html"]
    again = run(*command, "--on", "local")
    assert "3 units: 2 done, 1 failed" in again.stdout
    (videos / "broken.mp4").unlink()
    assert run(*command, "--on", "local").returncode == 0
    assert "owned" not in folder_content(tmp_path)
    one = run(*command, "--recording", "take 2", "--out", "one")
    assert one.returncode == 0, one.stderr
    assert {path.name for path in (tmp_path / "one").iterdir()} == {"take 2.h5", "take 2.csv", "q1.npy"}
    assert_refused(run(*command, "--recording", "take 3"), "--recording", "take 1, take 2", "'take 3'")


@pytest.mark.slow
def test_capture_fit_and_eval_as_units(laboratory: Path, run: Run, tmp_path: Path) -> None:
    table = laboratory / "recordings.csv"
    built = run(
        "rafl-capture", laboratory / "small.yaml", laboratory / "tracks", "--recordings", table, "--out", "a.h5",
        "--on", "local",
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    (tmp_path / "b.h5").write_bytes((laboratory / "data.h5").read_bytes())
    (tmp_path / "bad.h5").write_bytes(b"no dataset")
    fits = ("rafl-fit", "a.h5", "b.h5", "bad.h5", "--method", "sysid-e", "--each", "--epochs", "2")
    result = run(*fits)
    assert result.returncode == 1
    assert "error: unit bad-sysid-e: " in result.stderr
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"a-sysid-e", "b-sysid-e", "units"}
    runs = ("runs/a-sysid-e", "runs/b-sysid-e")
    result = run("rafl-eval", *runs, "a.h5", "b.h5", "--out", "errors", "--on", "local", "--no-report")
    assert result.returncode == 0, result.stderr
    assert {path.name for path in (tmp_path / "errors").iterdir()} == {"a", "b", "errors.csv", "motions.csv", "units"}
    joined = pd.read_csv(tmp_path / "errors" / "errors.csv")
    parts = pd.concat(pd.read_csv(tmp_path / "errors" / name / "errors.csv") for name in "ab")
    assert joined.to_numpy().tolist() == parts.to_numpy().tolist()
    assert not list((tmp_path / "errors").rglob("report.html"))


@pytest.mark.slow
def test_a_sweep_from_plan_to_table(laboratory: Path, run: Run, tmp_path: Path) -> None:
    own = tmp_path / "specimens" / "one"
    shutil.copytree(laboratory / "tracks", own / "tracks")
    shutil.copy(laboratory / "small.yaml", own / "specimen.yaml")
    (own / "recordings.csv").write_text("recording,load_g,split\ntake1,40,train\ntake2,60,val\ntake3,80,test\n")
    before = folder_content(tmp_path)
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN.replace("seeds", "sedes"))
    assert_refused(run("rafl-sweep", "plan.yaml"), "plan.yaml", "sedes")
    plan.write_text(PLAN)
    assert_refused(run("rafl-sweep", "plan.yaml", "--status", "--print-commands"), "leave one out")
    assert_refused(run("rafl-sweep", "plan.yaml", "--cluster", "plan.yaml"), "--cluster", "--on slurm")
    assert_refused(run("rafl-sweep", ".", "--status"), "units.json", "found nothing")
    assert "7 units: 7 waiting" in run("rafl-sweep", "plan.yaml", "--status").stdout
    assert folder_content(tmp_path) == before | {"plan.yaml"}
    result = run("rafl-sweep", "plan.yaml", "--jobs", "2", "--out", "a sweep")
    assert result.returncode == 0, result.stderr
    assert "7 units: 7 done" in result.stdout
    assert "7 units: 7 done" in run("rafl-sweep", "a sweep", "--status").stdout
    errors = pd.read_csv(tmp_path / "a sweep" / "results.csv", keep_default_na=False)
    assert errors["method"].value_counts().to_dict() == {"original": 3, "sysid-e": 3, "field": 6}
    summary = pd.read_csv(tmp_path / "a sweep" / "summary.csv", keep_default_na=False)
    field = errors[(errors["method"] == "field") & (errors["split"] == "test")]
    mean = summary[(summary["method"] == "field") & (summary["split"] == "test")]
    np.testing.assert_allclose(mean["mean_mm"], field["error_mm"].mean(), atol=1e-6)
    assert mean["seeds"].tolist() == [2]
    states = {path: path.stat().st_mtime_ns for path in (tmp_path / "a sweep" / "units").glob("one*.json")}
    assert run("rafl-sweep", "plan.yaml", "--out", "a sweep").returncode == 0
    assert {path: path.stat().st_mtime_ns for path in states} == states
