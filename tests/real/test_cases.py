"""Inputs that went wrong in laboratories: each gives the right values, or one line that says what is wrong."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import ROOT, SHARED, Run, assert_refused, error_lines

CASES = SHARED / "cases"
SEED, CALIB = CASES / "seed", CASES / "calib.yaml"
SPECIMEN = ROOT / "datasets" / "specimens" / "canonical.yaml"
pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not CASES.is_dir(), reason=f"inputs that went wrong are absent at {CASES}"),
]


def capture(run: Run, folder: Path, table: Path, *options: object) -> list[str]:
    """Build `out.h5` and return the lines on standard error."""
    result = run("rafl-capture", SPECIMEN, folder, "--recordings", table, "--out", "out.h5", *options)
    assert result.returncode == 0, result.stderr
    return error_lines(result.stderr)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("c3d-cut-short/t0.02", "c3d-cut-short/r.csv"), ("q0.c3d",)),
        (("c3d-cut-short/t0.7", "c3d-cut-short/r.csv"), ("q0.c3d",)),
        (("c3d-cut-short/thead2", "c3d-cut-short/r.csv"), ("q0.c3d",)),
        (("c3d-metres-called-mm/in", "c3d-metres-called-mm/recordings.csv"), ("unit",)),
        (("recording-with-folder/tracks", "recording-with-folder/r.csv"), ("day1/load060g", "without slashes")),
    ],
)
def test_recordings_that_are_refused(
    run: Run, tmp_path: Path, arguments: tuple[str, str], parts: tuple[str, ...]
) -> None:
    folder, table = (CASES / part for part in arguments)
    assert_refused(run("rafl-capture", SPECIMEN, folder, "--recordings", table, "--out", "out.h5"), *parts)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_more_than_255_points(run: Run, tmp_path: Path) -> None:
    folder = CASES / "c3d-more-than-255-points"
    capture(run, folder / "in", folder / "recordings.csv")
    with h5py.File(tmp_path / "out.h5") as file:
        assert np.mean([item["valid"][()].mean() for item in file["trajectories"].values()]) > 0.99


def test_a_gap_after_the_release_is_no_rest(run: Run, tmp_path: Path) -> None:
    folder = CASES / "c3d-gap-after-release"
    capture(run, folder / "in", folder / "recordings.csv")
    with h5py.File(tmp_path / "out.h5") as file:
        assert {int(item.attrs["first_frame"]) for item in file["trajectories"].values()} == {0}


@pytest.mark.slow
def test_no_interval_where_the_frame_was_found_through_the_model(run: Run, tmp_path: Path) -> None:
    """The table of the recordings has a first line that names the separator."""
    told = capture(run, CASES / "c3d-frame-through-model" / "in", CASES / "csv-sep-line" / "recordings.csv")
    (line,) = [line for line in told if "their frame" in line]
    assert "found together with E" in line
    assert "--rest" in line
    with h5py.File(tmp_path / "out.h5") as file:
        assert {float(item.attrs["load_g"]) for item in file["trajectories"].values()} == {60.0, 70.0, 90.0, 120.0}
    result = run("rafl-fit", "out.h5", "--method", "sysid-e", "--epochs", 2, "--out", "run")
    assert result.returncode == 0, result.stderr
    assert "no 95 % intervals: the frame of the recordings" in result.stdout
    assert "95 %:" not in result.stdout


def test_two_bodies(run: Run) -> None:
    specimen = CASES / "stl-two-bodies" / "specimen.yaml"
    arguments = (specimen, SEED / "tracks", "--recordings", SEED / "recordings.csv", "--out", "out.h5")
    assert_refused(run("rafl-capture", *arguments), "body.stl", "two")


@pytest.mark.parametrize("name", sorted(path.name for path in CASES.glob("typed-files-nan/*.yaml")))
def test_typed_files(run: Run, tmp_path: Path, name: str) -> None:
    """Each is either a specimen or a calibration; none is read."""
    path = CASES / "typed-files-nan" / name
    if "geometry" in path.read_text(encoding="utf-8"):
        arguments = ("rafl-capture", path, SEED / "tracks", "--recordings", SEED / "recordings.csv", "--out", "out.h5")
    else:
        arguments = ("rafl-track", CASES / "video-frozen-frames" / "videos", "--calib", path, "--out", "tracks")
    assert_refused(run(*arguments), name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("folder", "part"), [("yaml-aliases", "aliases"), ("camera-name-escapes", "without slashes")])
def test_calibrations_that_are_refused(run: Run, tmp_path: Path, folder: str, part: str) -> None:
    videos = CASES / "camera-name-escapes" / "v"
    result = run("rafl-track", videos, "--calib", CASES / folder / "calib.yaml", "--out", "a/b/c", "--overlay")
    assert_refused(result, part)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", sorted(path.name for path in CASES.glob("datasets-damaged/*.h5")))
def test_damaged_datasets(run: Run, tmp_path: Path, name: str) -> None:
    path = CASES / "datasets-damaged" / name
    assert_refused(run("rafl-fit", path, "--out", "run", "--method", "sysid-e"))
    assert list(tmp_path.iterdir()) == []


def test_slow_motion(run: Run, tmp_path: Path) -> None:
    videos = CASES / "video-capture-rate-tag" / "videos"
    result = run("rafl-track", videos, "--calib", CALIB, "--specimen", SPECIMEN, "--out", "tracks")
    assert result.returncode == 0, result.stderr
    assert "was recorded at 100" in result.stdout
    with h5py.File(tmp_path / "tracks" / "load060g.h5") as file:
        assert file.attrs["fps"] == pytest.approx(100.0)


def test_a_marker_that_is_never_found_is_named(run: Run, tmp_path: Path) -> None:
    text = SPECIMEN.read_text(encoding="utf-8") + "  - {name: absent, at_mm: [50, 0, 27]}\n"
    (tmp_path / "specimen.yaml").write_text(text, encoding="utf-8")
    videos = CASES / "video-capture-rate-tag" / "videos"
    result = run("rafl-track", videos, "--calib", CALIB, "--specimen", "specimen.yaml", "--out", "tracks")
    assert result.returncode == 0, result.stderr
    assert "markers absent of the specimen were never found" in result.stdout


def test_a_camera_that_began_later(run: Run) -> None:
    videos = CASES / "video-late-camera" / "videos"
    result = run("rafl-track", videos, "--calib", CALIB, "--specimen", SPECIMEN, "--out", "tracks")
    assert result.returncode == 0, result.stderr
    assert "right began 5.0 frames (0.050 s) later" in result.stdout


def test_frames_that_a_camera_showed_again(run: Run) -> None:
    videos = CASES / "video-frozen-frames" / "videos"
    result = run("rafl-track", videos, "--calib", CALIB, "--specimen", SPECIMEN, "--out", "tracks")
    assert result.returncode == 0, result.stderr
    assert "left.mp4: frames 6 to 13 show the frame before again while the body moves" in result.stdout


def test_one_unreadable_video(run: Run, tmp_path: Path) -> None:
    shutil.copytree(CASES / "one-unreadable-video" / "v", tmp_path / "v")
    result = run("rafl-track", "v", "--calib", SEED / "calib.yaml", "--out", "tracks")
    assert result.returncode == 1, result.stderr
    assert len(error_lines(result.stderr)) == 1
    assert len(list((tmp_path / "tracks").glob("rec*.h5"))) == 2
    assert (tmp_path / "tracks" / "report.html").is_file()


def test_names_in_markup(run: Run) -> None:
    dataset = CASES / "names-in-markup" / "d.h5"
    for line in (
        ("rafl-fit", dataset, "--method", "sysid-e", "--epochs", 1, "--out", "run"),
        ("rafl-eval", "run", dataset, "--out", "report"),
    ):
        result = run(*line)
        assert result.returncode == 0, result.stderr
    assert "[" in result.stdout


@pytest.mark.parametrize("loads", ["60,nan", "-60"])
def test_loads_that_cannot_be_rendered(run: Run, tmp_path: Path, loads: str) -> None:
    assert_refused(run("rafl-render", SPECIMEN, "--out", "o", "--frames", 4, f"--loads-g={loads}"), "--loads-g")
    assert list(tmp_path.iterdir()) == []
