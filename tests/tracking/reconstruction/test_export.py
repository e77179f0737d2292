"""Each export is read back by an independent reader of its format."""

from pathlib import Path

import ezc3d
import numpy as np
import pandas as pd
import pytest

from rafl.tracking.reconstruction.export import write_c3d, write_csv, write_npy, write_trc
from rafl.tracking.reconstruction.tracks import Tracks


@pytest.fixture
def tracks(random: np.random.Generator) -> Tracks:
    state = np.ones((6, 3), np.uint8)
    state[2, 1], state[3, 1] = 0, 2
    position = random.uniform(-0.1, 0.1, (6, 3, 3))
    position[2, 1] = np.nan
    sigma = np.where(np.isfinite(position), 2e-5, np.nan)
    time = 0.01 * np.arange(6)
    return Tracks(("L1", "L2", "tip"), time, position, sigma, state, {}, {}, {}, {}, {}, {}, 100.0, "", {}, "")


def test_csv(tracks: Tracks, tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", tracks)
    table = pd.read_csv(tmp_path / "a.csv")
    assert len(table) == 18
    positions = table[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(6, 3, 3)
    np.testing.assert_allclose(1e-3 * positions, tracks.position, rtol=1e-5)
    assert table.state.tolist()[7] == "missing"
    assert table.marker.tolist()[:3] == list(tracks.names)
    np.testing.assert_allclose(table.sigma_x_mm.dropna(), 0.02)


def test_c3d(tracks: Tracks, tmp_path: Path) -> None:
    write_c3d(tmp_path / "a.c3d", tracks)
    file = ezc3d.c3d(str(tmp_path / "a.c3d"))
    group = file["parameters"]["POINT"]
    assert group["LABELS"]["value"] == ["L1", "L2", "tip"]
    assert (group["RATE"]["value"][0], group["UNITS"]["value"][0]) == (100.0, "mm")
    residual = file["data"]["meta_points"]["residuals"][0].T
    assert np.argwhere(residual < 0).tolist() == [[2, 1]]
    assert residual[2, 1] == -1
    seen = tracks.state > 0
    points = 1e-3 * file["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(points[seen], tracks.position[seen], atol=1e-8)


def test_trc(tracks: Tracks, tmp_path: Path) -> None:
    write_trc(tmp_path / "a.trc", tracks)
    lines = (tmp_path / "a.trc").read_text().splitlines()
    head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert (head["DataRate"], head["NumFrames"], head["NumMarkers"], head["Units"]) == ("100", "6", "3", "mm")
    assert [name for name in lines[3].split("\t")[2:] if name] == list(tracks.names)
    table = pd.read_csv(tmp_path / "a.trc", sep="\t", skiprows=5, header=None)
    np.testing.assert_allclose(table[1], tracks.time)
    np.testing.assert_allclose(1e-3 * table.iloc[:, 2:].to_numpy().reshape(6, 3, 3), tracks.position, atol=1e-8)


def test_npy(tracks: Tracks, tmp_path: Path) -> None:
    """Row 0 has the places of the markers at rest, as far as they are known."""
    places = {"tip": np.array([0.1, 0.0, 0.02]), "L1": np.array([0.01, 0.0, 0.02])}
    write_npy(tmp_path / "q0.npy", tracks, places)
    written = np.load(tmp_path / "q0.npy", allow_pickle=False)
    np.testing.assert_array_equal(written[1:], 1e3 * tracks.position)
    np.testing.assert_allclose(written[0], [[10.0, 0.0, 20.0], [np.nan] * 3, [100.0, 0.0, 20.0]])
