"""A camera whose clock is late: the page shows and corrects what is in its frames."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filmed_markers import side_camera
from late_rig import film, track

from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.review.tracks.blocks import block, series
from rafl.review.tracks.edits import Action, perform
from rafl.review.tracks.recording import OpenRecording
from rafl.tracking.overlay import display_pixels
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.video.reader import Video

ROWS, SIGMA, STEP = 40, 0.02, 0.01
CAMERAS = {"left": side_camera(-0.7), "right": side_camera(0.7)}
REST = np.random.default_rng(0).uniform([0.01, 0.0, 0.0], [0.1, 0.02, 0.03], (6, 3))


def motion(time: np.ndarray) -> np.ndarray:
    return REST + 0.01 * np.sin(30.0 * time)[:, None, None] * np.array([0.0, 0.3, 1.0])


def no_video(name: str, camera: str, tracks: Tracks) -> Video:
    raise InputError("no video")


@pytest.fixture
def recording(tmp_path: Path) -> OpenRecording:
    """Frame k + 1 of the right camera is in row k, 0.4 frame late."""
    times = {"left": STEP * np.arange(ROWS), "right": STEP * (np.arange(ROWS + 1) - 0.6)}
    pixels = film(CAMERAS, times, motion, SIGMA, np.random.default_rng(1))
    write_tracks(tmp_path / "swing.h5", track(CAMERAS, times, pixels, tuple(f"m{k}" for k in range(6))))
    return OpenRecording(tmp_path / "swing.h5", "Ann", no_video)


def shown(recording: OpenRecording, marker: int) -> np.ndarray:
    """Pixels of a marker in the right camera as the page gets them, (T, 2)."""
    values = np.frombuffer(series(recording, marker, "right"), "<f4").reshape(-1, ROWS)
    return values[4:6].T


def test_dots_are_shown_where_they_are_in_the_frames(recording: OpenRecording) -> None:
    tracks = recording.tracks
    exact = CAMERAS["right"].project(motion(tracks.time + 0.4 * STEP))
    assert np.abs(shown(recording, 2) - exact[:, 2]).max() < 5.0 * SIGMA
    assert np.abs(tracks.pixel["right"][:, 2] - exact[:, 2]).max() > 5.0
    values = np.frombuffer(block(recording, Rig(dict(CAMERAS)), 10, 1), "<f4")
    for x in exact[10, :, 0]:
        assert np.abs(values - x).min() < 5.0 * SIGMA
    assert np.abs(display_pixels(tracks, "right", CAMERAS["right"]) - exact).max() < 5.0 * SIGMA


def test_corrections_are_made_in_the_frames(recording: OpenRecording) -> None:
    def correct(**action: Any) -> None:
        perform(recording, "page", Action(camera="right", marker="m2", **action))

    before = shown(recording, 2)
    correct(kind="delete", row=10, last_row=11)
    gone = np.flatnonzero(np.isnan(shown(recording, 2)[:, 0]))
    assert gone.tolist() == [10, 11]
    assert np.isnan(recording.tracks.filmed_pixel["right"][[11, 12], 2]).all()
    assert np.flatnonzero(recording.found.changed[:, 2]).tolist() == [10, 11]
    correct(kind="place", row=10, x=float(before[10, 0]), y=float(before[10, 1]), hand=True, sigma=SIGMA)
    np.testing.assert_allclose(shown(recording, 2)[10], before[10], atol=1e-3)
    np.testing.assert_allclose(recording.tracks.pixel["right"][10, 2], recording.raw.pixel["right"][10, 2], atol=0.05)
    perform(recording, "page", Action(kind="undo"))
    perform(recording, "page", Action(kind="undo"))
    np.testing.assert_array_equal(shown(recording, 2), before)
    np.testing.assert_allclose(recording.tracks.position, recording.raw.position, atol=1e-9)
