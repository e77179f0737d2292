"""Datasets of cameras with different clocks: their pixels are as filmed, at the times of their own frames."""

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import torch
from filmed_markers import side_camera
from late_rig import as_in_version_1, film, track
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, write_dataset
from rafl.data.objective import Recordings, recording_losses
from rafl.data.synthetic import with_material
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.corrections import Delete, Swap, corrections_path, write_corrections
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks

STEP, STILL, FRAMES, SIGMA = 0.01, 8, 30, 0.02
CAMERAS = {"left": side_camera(-0.7), "right": side_camera(0.7)}
ROW = RecordingRow(recording="swing", load_g=30, split="train")
STIFFNESS = 0.6  # of the assumed E

Motion = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def specimen(front: Specimen) -> Specimen:
    return replace(front, material=replace(front.material, integration="enhanced"))


@pytest.fixture(scope="module")
def released(specimen: Specimen) -> np.ndarray:
    """Node positions [m], (T, N, 3), of a specimen softer than assumed from its release on."""
    softer = replace(specimen.material, youngs_modulus=STIFFNESS * specimen.material.youngs_modulus)
    return tip_load_release(specimen, softer, 0.03, FRAMES, 1.0 / STEP).q


@pytest.fixture(scope="module")
def motion(specimen: Specimen, released: np.ndarray) -> Motion:
    """Positions of the markers [m] at times [s]; it rests until the frame `STILL`."""
    path = make_interp_spline(STEP * np.arange(FRAMES), released, k=7)
    markers = specimen.markers(1e-6)

    def moved(time: np.ndarray) -> np.ndarray:
        return markers.positions(torch.from_numpy(path(np.maximum(time - STILL * STEP, 0.0)))).numpy()

    return moved


def clocks(late: float, first: int = 0) -> dict[str, np.ndarray]:
    """Times of the frames of both cameras [s]; the right one's are late by some frames, and begin a frame earlier."""
    rows = STEP * np.arange(first, STILL + FRAMES - 1)
    return {"left": rows, "right": np.append(rows[0] - STEP, rows) + late * STEP}


def tracks_of(specimen: Specimen, motion: Motion, late: float, seed: int = 0) -> Tracks:
    times = clocks(late)
    return track(
        CAMERAS, times, film(CAMERAS, times, motion, SIGMA, np.random.default_rng(seed)), specimen.layout.names
    )


def build(specimen: Specimen, folder: Path, tracks: Tracks, initial: str = "rest", start: int = STILL) -> Dataset:
    folder.mkdir(exist_ok=True)
    write_tracks(folder / "swing.h5", tracks)
    settings = CaptureSettings(start=start, initial=initial)  # type: ignore[arg-type]
    return build_dataset(specimen, folder, [ROW], settings, "", lambda: None)


def best_modulus(dataset: Dataset, poissons_ratio: float) -> float:
    """E with which the simulated motion is nearest to the pixels, over the true one."""
    recordings, simulator = Recordings.of(dataset, ["swing"]), dataset.simulator

    def loss(factor: float) -> float:
        true = factor * STIFFNESS * simulator.material.youngs_modulus
        with torch.no_grad():
            markers, _ = recordings.in_simulator(with_material(simulator, true, poissons_ratio)).simulate()
        return 1e6 * float(recording_losses(recordings, markers))

    found = minimize_scalar(loss, bounds=(0.995, 1.005), method="bounded", options={"xatol": 1e-6})
    return float(found.x)


@pytest.mark.parametrize("late", [0.3, 0.5])
def test_modulus_and_first_frame_are_at_least_as_near_to_the_truth(
    late: float, specimen: Specimen, released: np.ndarray, motion: Motion, tmp_path: Path
) -> None:
    """The true motion explains the filmed pixels to their errors, and interpolated ones only worse."""
    tracks = tracks_of(specimen, motion, late)
    now, before = (
        build(specimen, tmp_path / key, own) for key, own in (("now", tracks), ("1", as_in_version_1(tracks)))
    )
    exact = torch.from_numpy(motion(STEP * np.arange(STILL, STILL + FRAMES - 1)))[:, None]
    losses, moduli, distances = [], [], []
    for dataset in (now, before):
        losses.append(float(recording_losses(Recordings.of(dataset, ["swing"]), exact)))
        moduli.append(abs(best_modulus(dataset, specimen.material.poissons_ratio) - 1.0))
        difference = dataset.trajectories["swing"].q - released[0]
        distances.append(float(np.sqrt((difference**2).sum(-1).mean())))
    assert losses[0] < 0.8 * losses[1]
    assert moduli[0] < 1e-4  # interpolated ones give it as well; the errors alone give 3e-5
    assert distances[0] < min(2.5e-5, 1.5 * distances[1])
    view = now.trajectories["swing"].views["right"]
    np.testing.assert_allclose(view.lag, late * STEP, atol=1e-12)
    write_dataset(tmp_path / "data.h5", now)
    back = read_dataset(tmp_path / "data.h5").trajectories["swing"].views["right"]
    np.testing.assert_array_equal(back.lag, view.lag)


def test_corrections_hold_in_datasets(specimen: Specimen, motion: Motion, tmp_path: Path) -> None:
    """A swap and a deleted dot of the right camera, of which the first is undone and the second is not there."""
    tracks = tracks_of(specimen, motion, 0.3)
    right = build(specimen, tmp_path / "right", tracks).trajectories["swing"]
    first, other, third = specimen.layout.names[:3]
    swapped = tracks.filmed_pixel["right"].copy()
    swapped[20:, [0, 1]] = swapped[20:, [1, 0]]
    wrong = replace(tracks, filmed_pixel={"right": swapped})
    who = {"by": "Ann", "at": datetime(2026, 1, 2, tzinfo=UTC), "camera": "right"}
    entries = (Swap(**who, markers=(first, other), first=20), Delete(**who, marker=third, first=25, last=26))
    (tmp_path / "wrong").mkdir()
    write_corrections(corrections_path(tmp_path / "wrong/swing.h5"), entries)
    found = build(specimen, tmp_path / "wrong", wrong).trajectories["swing"]
    gone = found.views["right"].seen ^ right.views["right"].seen
    assert np.argwhere(gone).tolist() == [[tracks.rows_by_frame("right")[k] - STILL, 2] for k in (25, 26)]
    both = found.views["right"].seen
    np.testing.assert_allclose(found.views["right"].pixel[both], right.views["right"].pixel[both])
    np.testing.assert_allclose(found.markers[:, :2], right.markers[:, :2], atol=1e-9)


def test_a_recording_that_starts_in_motion(specimen: Specimen, motion: Motion, tmp_path: Path) -> None:
    """The right camera's first frames show the moving body 0.4 frame late; the first row is where it was before."""
    times = clocks(0.4, STILL + 4)
    pixels = film(CAMERAS, times, motion, SIGMA, np.random.default_rng(0))
    tracks = track(CAMERAS, times, pixels, specimen.layout.names)
    dataset = build(specimen, tmp_path / "moving", tracks, "moving", 0)
    item = dataset.trajectories["swing"]
    exact = motion(times["left"][:1])[0]
    moved = np.abs(motion(times["left"][:1] + 0.4 * STEP)[0] - exact).max()
    found = dataset.markers.positions(torch.from_numpy(item.q)).numpy()
    assert moved > 1e-3
    assert np.abs(found - exact).max() < 2e-5


CLAMP = np.array([[-0.01, 0.0, 0.0], [-0.01, 0.0, 0.03], [-0.03, 0.0, 0.01], [-0.03, 0.02, 0.03]])


def test_a_moving_clamp_is_where_it_was_when_the_camera_measured(
    specimen: Specimen, motion: Motion, tmp_path: Path
) -> None:
    """The clamp turns and shifts by a millimetre between frames; the exact motion explains all pixels."""

    def turned(time: np.ndarray) -> np.ndarray:
        rotation = Rotation.from_rotvec(np.sin(20.0 * time)[:, None] * np.array([0.05, 0.07, -0.05])).as_matrix()
        shift = 0.005 * np.sin(20.0 * time)[:, None] * np.array([0.6, -0.4, 0.7])
        points = np.concatenate([motion(time), np.broadcast_to(CLAMP, (len(time), *CLAMP.shape))], axis=1)
        return np.einsum("tji,tmj->tmi", rotation, points - shift[:, None])

    layout = MarkerLayout(tuple(f"C{k}" for k in range(len(CLAMP))), CLAMP, 0.0)
    clamped, times = replace(specimen, clamp_layout=layout), clocks(0.4)
    pixels = film(CAMERAS, times, turned, 1e-4, np.random.default_rng(0))
    tracks = track(CAMERAS, times, pixels, specimen.layout.names + layout.names)
    item = build(clamped, tmp_path / "clamp", tracks).trajectories["swing"]
    view = item.views["right"]
    exact = motion(STEP * STILL + item.time + view.lag)
    gap = np.linalg.norm(view.project(exact) - view.pixel, axis=2)
    still = np.linalg.norm(np.diff(view.project(exact[:1].repeat(len(exact), axis=0)), axis=0), axis=2)
    assert still.max() > 5.0  # px, that the clamp alone moves between frames
    assert np.nanmax(gap[:-4]) < 0.01  # a spline is less exact where it ends


def test_rows_at_even_times_know_when_their_frames_were(specimen: Specimen, motion: Motion, tmp_path: Path) -> None:
    """Both cameras' clocks drift by 0.4 % against that of the dataset, which has the rate of another recording."""
    folder = tmp_path / "two"
    folder.mkdir()
    write_tracks(folder / "even.h5", tracks_of(specimen, motion, 0.0))
    times = {name: 1.004 * own for name, own in clocks(0.0).items()}
    pixels = film(CAMERAS, times, motion, SIGMA, np.random.default_rng(0))
    write_tracks(folder / "slow.h5", track(CAMERAS, times, pixels, specimen.layout.names))
    rows = [ROW.model_copy(update={"recording": name}) for name in ("even", "slow")]
    settings = CaptureSettings(start=STILL, initial="rest")
    dataset = build_dataset(specimen, folder, rows, settings, "", lambda: None)
    np.testing.assert_array_equal(dataset.trajectories["even"].views["left"].lag, 0.0)
    item, begin = dataset.trajectories["slow"], 1.004 * STEP * STILL
    for name, view in item.views.items():
        np.testing.assert_allclose(view.lag, 0.004 * item.time, atol=1e-9)
        gap = (view.pixel - CAMERAS[name].project(motion(begin + item.time + view.lag))) / SIGMA
        assert np.nanmean(gap**2) == pytest.approx(1.0, abs=0.15)
