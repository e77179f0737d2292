"""Corrections of tracks: what they change, what they leave alone, and what does not fit."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from filmed import Film, make_film, positions, with_swapped

from rafl.common.errors import InputError
from rafl.tracking.reconstruction.corrected_tracks import apply_corrections, read_corrected_tracks
from rafl.tracking.reconstruction.corrections import (
    Accept,
    Delete,
    Place,
    Rename,
    Swap,
    corrections_path,
    path_text,
    read_corrections,
    write_corrections,
)
from rafl.tracking.reconstruction.gap_filling import FILLED, MEASURED, MISSING
from rafl.tracking.reconstruction.tracks import read_tracks, write_tracks

WHO = {"by": "Ann", "at": datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC), "camera": "left"}


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Film:
    return make_film(tmp_path_factory.mktemp("film"))


def test_tracks_know_their_videos(film: Film) -> None:
    found = read_tracks(film.path)
    assert found.videos == {name: str(film.folder / f"videos/swing/{name}.mp4") for name in ("left", "right")}
    assert found.longest_gap == 5
    assert all(np.abs(lag).max() < 1e-9 for lag in found.lag.values())


def test_corrections_of_the_same_pixels_change_nothing(film: Film) -> None:
    """Positions computed anew from the pixels in the file are those in the file."""
    tracks = read_tracks(film.path)
    column = tracks.names.index("B3")
    frames = np.arange(5, 20)
    path = path_text(frames, tracks.pixel["left"][5:20, column], tracks.pixel_sigma["left"][5:20, column])
    found = apply_corrections(tracks, (Place(**WHO, marker="B3", how="fit", path=path),), film.path)
    assert found.changed.sum() == 15
    np.testing.assert_allclose(found.tracks.position, tracks.position, atol=2e-8)
    np.testing.assert_allclose(found.tracks.sigma, tracks.sigma, rtol=5e-2)
    assert (found.tracks.state == tracks.state).all()


def test_swap_back(film: Film) -> None:
    wrong = with_swapped(film.tracks, "A1", "B1", 30)
    assert (wrong.state[30:, [film.tracks.names.index(name) for name in ("A1", "B1")]] == MISSING).all()
    found = apply_corrections(wrong, (Swap(**WHO, markers=("A1", "B1"), first=30),), film.path).tracks
    np.testing.assert_allclose(found.position, film.tracks.position, atol=1e-9)
    truth = np.array([positions(frame) for frame in range(60)])
    assert np.sqrt(np.nanmean((found.position - truth) ** 2)) < 5e-5


def test_delete_fills_short_gaps_and_leaves_long_ones(film: Film) -> None:
    tracks, column = film.tracks, film.tracks.names.index("C5")
    both = [
        Delete(**WHO | {"camera": camera}, marker="C5", first=first, last=last)
        for first, last in ((10, 13), (30, 45))
        for camera in ("left", "right")
    ]
    found = apply_corrections(tracks, tuple(both), film.path).tracks
    state = found.state[:, column]
    assert (state[10:14] == FILLED).all()
    assert (state[30:46] == MISSING).all()
    assert (np.delete(state, [*range(10, 14), *range(30, 46)]) == MEASURED).all()
    truth = np.array([positions(frame) for frame in range(60)])
    assert np.abs(found.position[10:14, column] - truth[10:14, column]).max() < 5e-4
    others = np.delete(np.arange(15), column)
    np.testing.assert_array_equal(found.position[:, others], tracks.position[:, others])
    # A filled gap that is deleted again is missing.
    emptied = Delete(**WHO, marker="C5", first=10, last=13)
    assert (apply_corrections(tracks, (*both, emptied), film.path).tracks.state[10:14, column] == MISSING).all()


def test_new_marker_and_rename(film: Film) -> None:
    path = path_text(np.arange(3, 9), np.full((6, 2), 50.0), np.full((6, 2), 0.1))
    entries = (
        Place(**WHO, marker="X9", new=True, how="followed", path=path),
        Place(**WHO | {"camera": "right"}, marker="X9", how="hand", path=path),
        Rename(**WHO, marker="A1", to="Ä 1"),
    )
    found = apply_corrections(film.tracks, entries, film.path)
    assert found.unfit == ()
    assert found.tracks.names[-1] == "X9"
    assert found.tracks.names[0] == "Ä 1"
    assert (found.tracks.state[:, -1] > 0).sum() in (0, 6)  # none if the cameras contradict each other
    np.testing.assert_array_equal(found.tracks.pixel["left"][3:9, -1], np.full((6, 2), 50.0))


def test_what_does_not_fit_is_named_and_left_out(film: Film) -> None:
    entries = (
        Swap(**WHO, markers=("A1", "Z9"), first=3),
        Delete(**WHO, marker="A1", first=3, last=600),
        Delete(**WHO | {"camera": "top"}, marker="A1", first=3, last=6),
        Place(**WHO, marker="A1", how="hand", path="77 1 1 1 1\n"),
        Rename(**WHO, marker="A1", to="B1"),
        Accept(**WHO, marker="A2", first=3, last=6),
    )
    found = apply_corrections(film.tracks, entries, film.path)
    assert [line.split(": ")[1] for line in found.unfit] == [
        "the tracks have no marker Z9",
        "camera left has frames up to 59, not 3 to 600",
        "the tracks have no camera top",
        "no row of the tracks shows frame 77 of camera left",
        "there is a marker B1 already",
    ]
    assert found.accepted.sum() == 4
    assert not found.changed.any()


def test_file_round_trip(film: Film, tmp_path: Path) -> None:
    entries = (
        Place(**WHO, marker="<b>", new=True, how="hand", path="3 1.5 2.25 1 1\n4 1 2 1 1\n"),
        Delete(**WHO, marker="yes", first=3, last=60),
        Accept(**WHO, marker="Ä 1", first=3, last=6),
        Swap(**WHO, markers=("A1", "1"), first=3),
        Rename(**WHO, marker="A1", to="null"),
    )
    path = tmp_path / "a.corrections.yaml"
    write_corrections(path, entries)
    assert read_corrections(path) == entries
    assert "    3 1.5 2.25 1 1\n" in path.read_text()
    write_corrections(path, ())
    assert read_corrections(path) == ()


def test_reading_applies_the_file_beside_the_tracks(film: Film, tmp_path: Path) -> None:
    path = tmp_path / "swing.h5"
    write_tracks(path, with_swapped(film.tracks, "A1", "B1", 30))
    raw = path.read_bytes()
    entries = (Swap(**WHO, markers=("A1", "B1"), first=30), Delete(**WHO, marker="Z", first=1, last=2))
    write_corrections(corrections_path(path), entries)
    found = read_corrected_tracks(path)
    np.testing.assert_allclose(found.tracks.position, film.tracks.position, atol=1e-9)
    assert found.tracks.notes[-2:] == ("1 correction of swing.corrections.yaml applied", found.unfit[0])
    assert path.read_bytes() == raw
    corrections_path(path).write_text("format: rafl-corrections/1\ncorrections: [{kind: swap}]\n")
    with pytest.raises(InputError, match=r"swing.corrections.yaml: corrections.0"):
        read_corrected_tracks(path)
    write_corrections(corrections_path(path), entries)
    write_tracks(path, replace(film.tracks, calibration=""))
    with pytest.raises(InputError, match="expected the calibration"):
        read_corrected_tracks(path)


def test_positions_in_a_camera_with_a_late_clock_are_moved_to_the_times_of_the_rows(film: Film) -> None:
    """The right camera is 0.4 frames late: a dot seen in its frame n was where the marker is 0.4 frames after row n."""
    lag = 0.4 / film.tracks.fps
    tracks = replace(film.tracks, lag={"left": np.zeros(60), "right": np.full(60, lag)})
    column = tracks.names.index("B5")
    path = tracks.pixel["right"][:, column]
    in_frame = 0.6 * path[20] + 0.4 * path[21]
    text = path_text(np.array([20]), in_frame[None], np.full((1, 2), 0.02))
    found = apply_corrections(
        tracks, (Place(**WHO | {"camera": "right"}, marker="B5", how="fit", path=text),), film.path
    )
    np.testing.assert_allclose(found.tracks.pixel["right"][20, column], path[20], atol=0.2)
    assert np.linalg.norm(in_frame - path[20]) > 0.5
