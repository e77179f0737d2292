"""What a camera with another clock filmed: its own pixels, each at the time of its frame, also after corrections."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from filmed_markers import side_camera
from late_rig import as_in_version_1, film, track

from rafl.calibration.rig import Rig
from rafl.tracking.reconstruction.corrected_tracks import CorrectedTracks, apply_corrections
from rafl.tracking.reconstruction.corrections import Delete, Place, Swap, path_text
from rafl.tracking.reconstruction.filmed_markers import FilmedMarkers
from rafl.tracking.reconstruction.gap_filling import FILLED, MEASURED
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks, write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

STEP, FRAMES, SIGMA = 0.01, 200, 0.02
CAMERAS = {"left": side_camera(-0.7), "right": side_camera(0.7)}
NAMES = tuple(f"m{k}" for k in range(12))
REST = np.random.default_rng(0).uniform([0.01, 0.0, 0.0], [0.1, 0.02, 0.03], (12, 3))
SOURCE = Path("swing.h5")
WHO = {"by": "Ann", "at": datetime(2026, 1, 2, tzinfo=UTC), "camera": "right"}


def motion(time: np.ndarray) -> np.ndarray:
    """Positions [m], (T, M, 3), of markers that swing seven times a second."""
    swing = 0.004 * np.sin(2.0 * np.pi * 7.0 * time) * np.exp(-time)
    return REST + swing[:, None, None] * np.array([0.3, 0.4, 1.0]) * (REST[:, :1] / 0.1) ** 2


def filmed(late: float) -> tuple[dict[str, np.ndarray], dict[str, CameraPixels]]:
    """Times of the frames [s] and pixels by camera. The right one is late by some frames, and began first."""
    times = {"left": STEP * np.arange(FRAMES), "right": STEP * (np.arange(FRAMES + 1) - 1.0 + late)}
    return times, film(CAMERAS, times, motion, SIGMA, np.random.default_rng(1))


def recorded(late: float) -> Tracks:
    times, pixels = filmed(late)
    return track(CAMERAS, times, pixels, NAMES)


def seen_by(tracks: Tracks, camera: str = "right") -> FilmedMarkers:
    return FilmedMarkers.of(tracks, Rig(dict(CAMERAS)), camera)


def errors(tracks: Tracks) -> np.ndarray:
    """Errors of the right camera's pixels in their sigmas, at the times that they are said to have, (T', M, 2)."""
    found = seen_by(tracks)
    gap = (found.pixel - CAMERAS["right"].project(motion(tracks.time + found.lag))) / found.sigma
    return gap[np.isfinite(gap[:, 0, 0])]


def likeness(gap: np.ndarray) -> float:
    """Correlation of the errors of successive frames."""
    return float((gap[1:] * gap[:-1]).mean() / (gap**2).mean())


@pytest.mark.parametrize(("late", "square", "alike"), [(0.3, 0.85, 0.18), (0.5, 0.79, 0.26)])
def test_errors_of_filmed_pixels_are_independent_and_as_large_as_sigma(
    late: float, square: float, alike: float
) -> None:
    """Those of interpolated pixels are smaller than their sigma says, and alike in successive frames."""
    tracks = recorded(late)
    before, after = errors(as_in_version_1(tracks)), errors(tracks)
    assert (before**2).mean() == pytest.approx(square, abs=0.04)
    assert likeness(before) == pytest.approx(alike, abs=0.04)
    assert (after**2).mean() == pytest.approx(1.0, abs=0.03)  # of 4,800 errors 0.02 is one standard deviation
    assert abs(likeness(after)) < 0.03
    by_row = (after**2).mean(axis=(1, 2))
    assert len(by_row) == FRAMES
    assert 0.25 < by_row.min() < by_row.max() < 2.4  # of 24 errors each
    np.testing.assert_array_equal(seen_by(tracks, "left").lag, 0.0)


def test_no_frame_is_in_two_rows() -> None:
    """A camera that films 1 % faster or slower: a frame is shown in two rows, or in none, about every second."""
    for rate in (0.99, 1.01):
        times = {"left": STEP * np.arange(FRAMES), "right": STEP * (rate * np.arange(FRAMES + 20) - 5.3)}
        tracks = track(CAMERAS, times, film(CAMERAS, times, motion, SIGMA, np.random.default_rng(2)), NAMES)
        found = seen_by(tracks)
        rows = np.flatnonzero(np.isfinite(found.pixel[:, 0, 0]))
        assert len(rows) > FRAMES - 5
        assert len(np.unique(tracks.frame["right"][rows])) == len(rows)
        assert (np.diff(found.lag[rows] + tracks.time[rows]) > 0.98 * STEP).all()
        assert (errors(tracks) ** 2).mean() == pytest.approx(1.0, abs=0.06)


def test_dots_near_a_gap_are_kept_and_wrong_ones_are_not() -> None:
    """A dot seen in one frame alone has no pixels to interpolate between; its frame tells that it is right."""
    times, pixels = filmed(0.4)
    for values in (pixels["right"].pixel, pixels["right"].sigma):
        values[60:71, 3], values[80:91, 3] = np.nan, np.nan
    exact = CAMERAS["right"].project(motion(times["right"]))
    pixels["right"].pixel[65, 3], pixels["right"].sigma[65, 3] = exact[65, 3], SIGMA
    pixels["right"].pixel[85, 3], pixels["right"].sigma[85, 3] = exact[85, 3] + [0.0, 9.0], SIGMA
    pixels["right"].pixel[120, 5] += [0.0, 9.0]
    tracks = track(CAMERAS, times, pixels, NAMES)
    found, shown = seen_by(tracks), tracks.rows_by_frame("right")
    assert np.isnan(tracks.pixel["right"][[shown[59], shown[65], shown[71]], 3]).any(axis=1).sum() >= 2
    assert np.isfinite(found.pixel[[shown[59], shown[65], shown[71]], 3]).all()
    assert np.isnan(found.pixel[[shown[64], shown[85]], 3]).all()
    assert np.isnan(found.pixel[shown[120], 5]).all()
    assert np.isfinite(found.pixel[[shown[118], shown[122]], 5]).all()


def corrected(tracks: Tracks, *corrections: Swap | Delete | Place) -> CorrectedTracks:
    found = apply_corrections(tracks, corrections, SOURCE)
    assert found.unfit == ()
    return found


def test_a_swap_is_undone_in_frames_and_rows() -> None:
    """The tracks are then those of a tracker that was never wrong; before, a spline led from one dot to the other."""
    times, pixels = filmed(0.3)
    right = track(CAMERAS, times, pixels, NAMES)
    wrong = {name: CameraPixels(item.pixel.copy(), item.sigma) for name, item in pixels.items()}
    wrong["right"].pixel[90:, [2, 7]] = wrong["right"].pixel[90:, [7, 2]]
    tracks = track(CAMERAS, times, wrong, NAMES)
    found = corrected(tracks, Swap(**WHO, markers=("m2", "m7"), first=90))
    np.testing.assert_array_equal(found.tracks.filmed_pixel["right"], right.filmed_pixel["right"])
    np.testing.assert_allclose(found.tracks.pixel["right"], right.pixel["right"], atol=2e-5)
    np.testing.assert_allclose(found.tracks.position, right.position, atol=1e-8)
    np.testing.assert_array_equal(found.tracks.state, right.state)
    np.testing.assert_allclose(seen_by(found.tracks).pixel, seen_by(right).pixel)
    shown = tracks.rows_by_frame("right")[90]
    assert np.flatnonzero(found.changed[:, 2]).tolist() == list(range(shown, FRAMES))
    again = apply_corrections(tracks, (), SOURCE, found)
    np.testing.assert_array_equal(again.tracks.pixel["right"], tracks.pixel["right"])
    np.testing.assert_allclose(again.tracks.position, tracks.position, atol=1e-9)


def test_a_deleted_dot_is_gone_from_frames_and_rows() -> None:
    tracks = replace(recorded(0.3), longest_gap=5)
    found = corrected(tracks, Delete(**WHO, marker="m4", first=50, last=52)).tracks
    shown = tracks.rows_by_frame("right")
    rows = np.array([shown[number] for number in (50, 51, 52)])
    assert np.isnan(found.filmed_pixel["right"][50:53, 4]).all()
    assert np.isnan(seen_by(found).pixel[rows, 4]).all()
    gone = np.flatnonzero(np.isnan(found.pixel["right"][:, 4, 0]) & np.isfinite(tracks.pixel["right"][:, 4, 0]))
    assert gone.tolist() == list(range(rows[0], rows[-1] + 2))  # also the row after, between frames 52 and 53
    assert (found.state[gone, 4] == FILLED).all()
    others = np.delete(np.arange(12), 4)
    np.testing.assert_array_equal(found.pixel["right"][:, others], tracks.pixel["right"][:, others])
    np.testing.assert_array_equal(found.position[:, others], tracks.position[:, others])


def test_positions_set_by_hand_are_those_of_the_frames() -> None:
    """Several frames in a row give rows between them; one alone is moved to its row as the marker's neighbours move."""
    times, pixels = filmed(0.3)
    for values in (pixels["right"].pixel, pixels["right"].sigma):
        values[60:80, 3] = np.nan
    tracks, exact = track(CAMERAS, times, pixels, NAMES), CAMERAS["right"].project(motion(times["right"]))
    numbers = np.array([60, 61, 62, 63, 70])
    text = path_text(numbers, exact[numbers, 3], np.full((5, 2), SIGMA))
    found = corrected(tracks, Place(**WHO, marker="m3", how="hand", path=text)).tracks
    shown = tracks.rows_by_frame("right")
    rows = np.array([shown[number] for number in numbers])
    pixel, sigma = found.in_frames("right")
    np.testing.assert_allclose(pixel[rows, 3], exact[numbers, 3], atol=1e-4)
    np.testing.assert_allclose(sigma[rows, 3], SIGMA)
    at_rows = CAMERAS["right"].project(motion(tracks.time))
    np.testing.assert_allclose(found.pixel["right"][rows[:4], 3], at_rows[rows[:4], 3], atol=0.1)
    alone = rows[4]
    far, largest = found.pixel["right"][alone, 3] - at_rows[alone, 3], found.pixel_sigma["right"][alone, 3].max()
    assert largest > SIGMA
    assert np.linalg.norm(far) < 4.0 * largest
    assert (found.state[rows, 3] == MEASURED).all()
    new = corrected(tracks, Place(**WHO, marker="X", new=True, how="fit", path=text)).tracks
    assert new.filmed_pixel["right"].shape == (FRAMES + 1, 13, 2)
    np.testing.assert_allclose(new.in_frames("right")[0][rows, 12], exact[numbers, 3], atol=1e-4)


def test_files_keep_what_was_filmed(tmp_path: Path) -> None:
    tracks = recorded(0.3)
    write_tracks(tmp_path / "a.h5", tracks)
    back = read_tracks(tmp_path / "a.h5")
    assert back.filmed_time.keys() == {"right"}
    for key in ("filmed_time", "filmed_pixel", "filmed_sigma", "lag"):
        np.testing.assert_array_equal(getattr(back, key)["right"], getattr(tracks, key)["right"])
    assert not back.lacks_filmed("right")
    assert as_in_version_1(back).lacks_filmed("right")
