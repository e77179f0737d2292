"""Recordings of strangers: arrays and times that make no recording are refused in one line."""

import io
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from filmed import make_film, with_swapped

from rafl.capture.dataset.sources import find_sources, read_recording
from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.tracking.reconstruction.corrections import Delete, Swap, corrections_path, write_corrections
from rafl.tracking.reconstruction.tracks import write_tracks

GOOD = np.random.default_rng(0).normal(0.0, 30.0, (6, 4, 3))  # [mm]


def saved(array: np.ndarray, **options: bool) -> bytes:
    content = io.BytesIO()
    np.save(content, array, **options)
    return content.getvalue()


def archive() -> bytes:
    content = io.BytesIO()
    np.savez(content, GOOD)
    return content.getvalue()


NPY = {
    "objects": saved(np.array([GOOD, "x"], dtype=object), allow_pickle=True),
    "archive": archive(),
    "longer than the file": saved(GOOD).replace(b"(6, 4, 3)", b"(600000000000, 4, 3)"),
    "broken header": saved(GOOD).replace(b"(6, 4, 3)", b"((6, 4, 3"),
    "cut": saved(GOOD)[:-1],
    "empty": b"",
    "text": saved(GOOD.astype("S8")),
    "complex": saved(GOOD.astype(complex)),
    "flat": saved(GOOD.ravel()),
    "in a plane": saved(GOOD[..., :2]),
    "no markers": saved(GOOD[:, :0]),
    "one frame": saved(GOOD[:2]),
    "infinite": saved(np.where(GOOD > 20.0, np.inf, GOOD)),
    "nothing seen": saved(np.full_like(GOOD, np.nan)),
    "huge": saved(GOOD * 1e300),
    "micrometres": saved(1e3 * GOOD),
}


@pytest.mark.parametrize("name", NPY)
def test_array_that_is_no_recording_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "take.npy"
    path.write_bytes(NPY[name])
    with pytest.raises(InputError, match=r"take\.npy") as error:
        read_recording(path, 100.0)
    assert str(error.value).isprintable()


def test_array_is_read(tmp_path: Path) -> None:
    path = tmp_path / "take.npy"
    for array in (GOOD, GOOD.astype(np.float32), np.rint(GOOD).astype(int)):
        np.save(path, array)
        np.testing.assert_allclose(read_recording(path, 100.0).position, 1e-3 * array[1:].astype(float), rtol=1e-12)


TABLE = "frame,time_s,marker,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm,state\n"
TIMES = {
    "backwards": ((0.0, 0.02, 0.01), "expected times that ascend, found 0.01 s after 0.02 s"),
    "endless": ((0.0, 0.01, 0.02, 1e9), "expected frames at an even rate, found 4 of them over 1e"),
    "not finite": ((0.0, float("inf"), 0.02), "expected"),
    "single": ((0.0,), "expected 2 frames or more"),
}


@pytest.mark.parametrize("name", TIMES)
def test_times_that_no_camera_has_are_refused(tmp_path: Path, name: str) -> None:
    times, message = TIMES[name]
    path = tmp_path / "take.csv"
    path.write_text(TABLE + "".join(f"{k},{time},L1,1,2,3,0.1,0.1,0.1,measured\n" for k, time in enumerate(times)))
    with pytest.raises(InputError, match=message):
        read_recording(path, 100.0)


@pytest.mark.parametrize("recording", ["../take", "/etc/passwd", "", "a\0b", ".."])
def test_recording_is_looked_for_in_its_folder_only(tmp_path: Path, recording: str) -> None:
    (tmp_path / "take.npy").write_bytes(saved(GOOD))
    (tmp_path / "tracks").mkdir()
    with pytest.raises(InputError, match="recording: expected a name"):
        find_sources(tmp_path / "tracks", recording)


def test_tracks_are_read_with_their_corrections(tmp_path: Path) -> None:
    film = make_film(tmp_path, frames=30)
    write_tracks(film.path, with_swapped(film.tracks, "A1", "B1", 20))
    who = {"by": "Ann", "at": datetime(2026, 1, 2, tzinfo=UTC), "camera": "left"}
    beside = corrections_path(film.path)
    write_corrections(beside, (Swap(**who, markers=("A1", "B1"), first=20), Delete(**who, marker="Z", first=1, last=2)))
    found = read_recording(film.path, 100.0)
    np.testing.assert_allclose(found.position, film.tracks.position, atol=1e-9)
    assert found.corrections == f"1 of swing.corrections.yaml {sha256(beside)}"
    assert "correction 2 (delete, by Ann) is left out: the tracks have no marker Z" in found.unfit_corrections
    beside.unlink()
    assert read_recording(film.path, 100.0).corrections == ""
