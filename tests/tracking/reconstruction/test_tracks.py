from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from rafl.common.errors import InputError
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks, write_tracks
from rafl.tracking.report import summary_cells


@pytest.fixture
def tracks(random: np.random.Generator) -> Tracks:
    shape = (7, 4)
    state = np.ones(shape, np.uint8)
    state[2, 1], state[3, 1] = 0, 2
    position = random.normal(size=(*shape, 3))
    position[2, 1] = np.nan
    return Tracks(
        names=("L1", "L2", "Marker ä", "r1c1"),
        time=0.01 * np.arange(7),
        position=position,
        sigma=np.full((*shape, 3), 1e-5),
        state=state,
        pixel={"left": random.normal(size=(*shape, 2))},
        residual={"left": np.zeros(shape)},
        pixel_sigma={"left": np.full((*shape, 2), 0.02)},
        damaged={"left": np.zeros(7, dtype=bool)},
        frame={"left": np.array([0, 1, 2, -1, 3, 4, 5])},
        images={"left": {0: b"first", 5: b"worst"}},
        fps=100.0,
        calibration="format: rafl-calibration/1",
        sources={"videos/a  b/left.mp4": "0123abcd"},
        settings="fill = 5",
        notes=("left.mp4: frames 2 are damaged",),
    )


def test_round_trip(tracks: Tracks, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write_tracks(path, tracks)
    back = read_tracks(path)
    for key in ("time", "position", "sigma", "state"):
        np.testing.assert_array_equal(getattr(back, key), getattr(tracks, key))
    for key in ("pixel", "residual", "pixel_sigma", "damaged"):
        np.testing.assert_array_equal(getattr(back, key)["left"], getattr(tracks, key)["left"])
    for key in ("names", "fps", "calibration", "sources", "settings", "notes", "images", "version"):
        assert getattr(back, key) == getattr(tracks, key)


def test_residuals_count_only_markers_seen_by_two_cameras(tracks: Tracks) -> None:
    """A marker that one camera alone sees is placed exactly where that camera sees it, so its residual is 0."""
    assert summary_cells(tracks) == ["7", "4", "92.9%", "3.6%", "3.6%", "0.020", "-"]
    right = np.full((7, 4), np.nan)
    right[:, 2] = 0.3
    left = np.zeros((7, 4))
    left[:, 2] = 0.1
    both = replace(tracks, residual={"left": left, "right": right})
    assert summary_cells(both)[-1] == f"{np.sqrt(0.05):.3f}"


def test_other_files_are_refused(tracks: Tracks, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with pytest.raises(InputError, match="found nothing"):
        read_tracks(path)
    path.write_bytes(b"text")
    with pytest.raises(InputError, match="cannot be read"):
        read_tracks(path)
    write_tracks(path, replace(tracks, fps=50.0))
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "rafl-tracks/2"
    with pytest.raises(InputError, match="newer"):
        read_tracks(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "rafl-tracks/1"
        del file["sigma"]
    with pytest.raises(InputError, match="track again"):
        read_tracks(path)
