"""The command `rafl-track`: what it finds, keeps and refuses. No file is written after a wrong input."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from support import Run, assert_refused, draw_frame, folder_content

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig, write_calibration


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    """Folder with one recording of one camera: images of a 4 x 3 marker grid that moves by 1 px per frame."""
    folder = tmp_path / "videos" / "swing"
    folder.mkdir(parents=True)
    for frame in range(6):
        dots = [(40 + 36 * i + frame, 40 + 36 * j, 6.0, 6.0, 0.0) for i in range(4) for j in range(3)]
        cv2.imwrite(str(folder / f"{frame:03d}.png"), draw_frame(dots, noise=1.0, seed=frame))
    write_calibration(tmp_path / "calib.yaml", Rig({"front": camera()}))
    return tmp_path / "videos"


def camera(size: tuple[int, int] = (200, 160)) -> OrthographicCamera:
    return OrthographicCamera(
        image_size=size, scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0), plane=Plane((0.0, 0.0, 1.0), 0.0, 5e-4)
    )


def test_track_a_folder_of_images(videos: Path, run: Run, tmp_path: Path) -> None:
    result = run("rafl-track", videos, "--calib", "calib.yaml", "--fps", "50", "--overlay")
    assert result.returncode == 0, result.stderr
    with h5py.File(tmp_path / "tracks/swing.h5") as file:
        assert list(file.attrs["marker_names"]) == [f"r{j}c{i}" for j in (1, 2, 3) for i in (1, 2, 3, 4)]
        np.testing.assert_allclose(file["time"][()], np.arange(6) / 50)
        moved = file["position"][5] - file["position"][0]
        np.testing.assert_allclose(moved, np.broadcast_to([5e-4, 0, 0], moved.shape), atol=5e-6)
        assert (file["state"][()] == 1).all()
    assert (tmp_path / "tracks/swing_front_overlay.mp4").stat().st_size > 1000


def test_tracks_name_the_video_as_it_was_given(videos: Path, run: Run, tmp_path: Path) -> None:
    """Also where a link leads to it: its own name may be another."""
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "take1").symlink_to(videos / "swing")
    result = run("rafl-track", tmp_path / "linked", "--calib", "calib.yaml", "--fps", "50", "--out", "a/tracks")
    assert result.returncode == 0, result.stderr
    (path,) = (tmp_path / "a/tracks").glob("*.h5")
    with h5py.File(path) as file:
        assert file["cameras/front"].attrs["video"] == "../../linked/take1"
        assert [line.split("  ")[1] for line in file.attrs["sources"]] == ["take1"]


def test_track_refuses_wrong_input(videos: Path, run: Run, tmp_path: Path) -> None:
    before = folder_content(tmp_path)

    def refused(*parts: str, calib: str = "calib.yaml", path: Path = videos, more: tuple[str, ...] = ()) -> None:
        result = run("rafl-track", path, "--calib", calib, *(more or ("--fps", "50")))
        assert_refused(result, *parts)
        assert folder_content(tmp_path) - set(extra) == before

    extra = {"other.yaml", "videos/swing/broken.png"}
    refused("nowhere.yaml", "check the path", calib="nowhere.yaml")
    refused("nothing", path=tmp_path / "nothing")
    refused(".mp4", "calib.yaml, found another file type", path=tmp_path / "calib.yaml")
    write_calibration(tmp_path / "other.yaml", Rig({"front": camera((640, 480))}))
    refused("swing", "expected 640 x 480", "found 200 x 160", calib="other.yaml")
    write_calibration(tmp_path / "other.yaml", Rig({"left": camera(), "right": camera()}))
    refused("other.yaml (left, right)", "'swing'", calib="other.yaml")
    (tmp_path / "other.yaml").write_text("cameras: []")
    refused("other.yaml", calib="other.yaml")
    refused("--fps", more=("--fill", "3"))
    refused("--export", "'xlsx'", more=("--fps", "50", "--export", "csv,xlsx"))


def test_damaged_image_is_reported_and_its_markers_are_missing(videos: Path, run: Run, tmp_path: Path) -> None:
    (videos / "swing" / "003.png").write_bytes(b"not an image")
    result = run("rafl-track", videos, "--calib", "calib.yaml", "--fps", "50", "--fill", "0")
    assert result.returncode == 0, result.stderr
    assert "frames 3 are damaged" in result.stdout
    with h5py.File(tmp_path / "tracks/swing.h5") as file:
        assert (file["state"][()] == 1).all(axis=1).tolist() == [True, True, True, False, True, True]
        assert (file["state"][3] == 0).all()


def test_recordings_are_tracked_again_only_if_something_changed(videos: Path, run: Run, tmp_path: Path) -> None:
    command = ("rafl-track", videos, "--calib", "calib.yaml", "--fps", "50", "--export", "csv,c3d,trc,npy")
    assert run(*command).returncode == 0
    path = tmp_path / "tracks/swing.h5"
    first, time = path.read_bytes(), path.stat().st_mtime_ns
    again = run(*command)
    assert "kept the tracks of 1 recordings" in again.stdout
    assert path.stat().st_mtime_ns == time
    # A damaged tracks file, or one with other settings, is not kept.
    path.write_bytes(first[: len(first) // 2])
    assert "kept" not in run(*command).stdout
    assert path.read_bytes() == first
    assert "kept" not in run(*command, "--fill", "1").stdout
    exports = {"report.html", "swing.h5", "swing.csv", "swing.c3d", "swing.trc", "q0.npy"}
    assert {item.name for item in (tmp_path / "tracks").iterdir()} == exports


def test_corrections_are_applied_again_whenever_tracks_are_made(videos: Path, run: Run, tmp_path: Path) -> None:
    """They are in exports and notes, and the tracks file is as tracked; one that does not fit is named."""
    command = ("rafl-track", videos, "--calib", "calib.yaml", "--fps", "50", "--export", "csv")
    assert run(*command).returncode == 0
    raw = (tmp_path / "tracks/swing.h5").read_bytes()
    beside = tmp_path / "tracks/swing.corrections.yaml"
    entry = "{kind: rename, by: Ann, at: 2026-01-02T03:04:05+00:00, camera: front, marker: %s, to: Tip}"
    lines = "".join(f"- {entry % marker}\n" for marker in ("r1c1", "r9c9"))
    beside.write_text(f"format: rafl-corrections/1\ncorrections:\n{lines}")
    for again in (command, (*command, "--fill", "2")):
        result = run(*again)
        assert result.returncode == 0, result.stderr
        text = " ".join(result.stdout.split())
        assert "1 correction of swing.corrections.yaml applied" in text
        assert "correction 2 (rename, by Ann) is left out: the tracks have no marker r9c9" in text
        assert ",Tip," in (tmp_path / "tracks/swing.csv").read_text()
        if again == command:
            assert (tmp_path / "tracks/swing.h5").read_bytes() == raw
        with h5py.File(tmp_path / "tracks/swing.h5") as file:
            assert "r1c1" in list(file.attrs["marker_names"])
    beside.write_text("format: rafl-corrections/2\n")
    assert_refused(run(*command), "swing.corrections.yaml", "newer")


def test_track_refuses_too_few_markers(videos: Path, run: Run, tmp_path: Path) -> None:
    for path in (videos / "swing").iterdir():
        cv2.imwrite(str(path), draw_frame([(60.0, 60.0, 6.0, 6.0, 0.0), (120.0, 60.0, 6.0, 6.0, 0.0)], noise=1.0))
    result = run("rafl-track", videos, "--calib", "calib.yaml", "--fps", "50")
    assert_refused(result, "swing", "at least 3 dots", "found 2")
    assert not (tmp_path / "tracks").exists()


def test_other_recordings_are_tracked_after_a_failure(videos: Path, run: Run, tmp_path: Path) -> None:
    blank = videos / "blank"
    blank.mkdir()
    for frame in range(3):
        cv2.imwrite(str(blank / f"{frame}.png"), np.full((160, 200), 90, np.uint8))
    result = run("rafl-track", videos, "--calib", "calib.yaml", "--fps", "50")
    assert result.returncode == 1
    assert "error: recording blank" in result.stderr
    assert {path.name for path in (tmp_path / "tracks").iterdir()} == {"report.html", "swing.h5"}
