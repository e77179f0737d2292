from collections.abc import Callable
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
        file.attrs["format"] = "rafl-tracks/3"
    with pytest.raises(InputError, match="newer"):
        read_tracks(path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "rafl-tracks/1"
    assert read_tracks(path).fps == 50.0
    with h5py.File(path, "r+") as file:
        del file["sigma"]
    with pytest.raises(InputError, match="track again"):
        read_tracks(path)


LEFT = "cameras/left"


def replaced(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.Group], None]:
    """Puts another array in the place of one of the left camera's."""

    def apply(group: h5py.Group) -> None:
        values = change(group[key][()])
        del group[key]
        group[key] = values

    return apply


def entry(key: str, index: int, value: float) -> Callable[[h5py.Group], None]:
    return replaced(key, lambda values: np.where(np.arange(len(values)) == index, value, values).astype(values.dtype))


def without(key: str) -> Callable[[h5py.Group], None]:
    return lambda group: group.__delitem__(key)


DAMAGE: dict[str, tuple[Callable[[h5py.Group], None], str]] = {
    "fewer frames": (replaced("filmed_pixel", lambda values: values[:-1]), f"{LEFT}/filmed_pixel: expected shape (7, "),
    "other markers": (replaced("filmed_sigma", lambda values: values[:, 1:]), f"{LEFT}/filmed_sigma: expected shape"),
    "late by a frame": (entry("lag", 2, 0.0101), f"{LEFT}/lag: expected times within half a frame interval of the"),
    "no time": (entry("lag", 2, np.nan), f"{LEFT}/lag: expected finite numbers, found nan"),
    "other time": (entry("lag", 2, 0.001), f"{LEFT}/lag: expected filmed_time minus time"),
    "lag missing": (without("lag"), f"expected the array {LEFT}/lag beside {LEFT}/filmed_pixel, found none"),
    "sigma missing": (without("filmed_sigma"), f"expected the array {LEFT}/filmed_sigma beside {LEFT}/filmed_pixel"),
    "time missing": (without("filmed_time"), f"expected the array {LEFT}/filmed_time beside {LEFT}/filmed_pixel"),
    "backwards": (entry("filmed_time", 2, 0.0), f"{LEFT}/filmed_time: expected two frames or more, each later than"),
    "infinite": (entry("filmed_time", 2, np.inf), f"{LEFT}/filmed_time: expected finite numbers"),
    "no such frame": (entry("frame", 6, 7), f"{LEFT}/frame: expected frames up to 6 as in filmed_time, found 7"),
    "exact": (replaced("filmed_sigma", lambda values: 0.0 * values), f"{LEFT}/filmed_sigma: expected numbers from"),
    "far": (replaced("filmed_pixel", lambda values: 1e9 + values), f"{LEFT}/filmed_pixel: expected numbers from"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_filmed_pixels_are_refused(tracks: Tracks, tmp_path: Path, damage: str) -> None:
    path, (change, message) = tmp_path / "a.h5", DAMAGE[damage]
    frame = np.array([0, 1, 2, -1, 3, 4, 5])
    own = 0.01 * np.array([0.3, 1.3, 2.3, 4.3, 5.3, 6.3, 7.3])
    late = replace(
        tracks,
        lag={"left": np.where(frame < 0, 0.0, 0.003)},
        filmed_time={"left": own},
        filmed_pixel={"left": tracks.pixel["left"]},
        filmed_sigma={"left": tracks.pixel_sigma["left"]},
    )
    write_tracks(path, late)
    with h5py.File(path, "r+") as file:
        change(file[LEFT])
    with pytest.raises(InputError) as caught:
        read_tracks(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert str(caught.value).endswith("; track again")
