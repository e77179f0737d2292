"""Cameras that were touched after their calibration, and clocks that are late, are found from the recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from filmed_markers import PIXELS_PER_METRE, side_camera
from late_rig import film, track
from scipy.interpolate import CubicSpline, make_interp_spline
from synthetic_tracks import tracks_of_pixels

from rafl.calibration.camera import Plane
from rafl.calibration.rig import Rig
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.camera_summary import camera_rows, camera_warnings
from rafl.capture.dataset.refine_cameras import Refinement
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.camera_change import CameraChange
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, write_dataset
from rafl.fem.maxwell import branch_shares, branch_times
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

FRAMES, STILL, SIGMA_PX, STEP = 24, 6, 0.02, 0.01
LATE = 0.3  # of the right camera's clock [frames]
TURN = np.radians(0.2) * np.array([0.6, 0.8, 0.0])  # of the right camera [rad]
CALIBRATED = {"left": side_camera(-0.7), "right": side_camera(0.7)}
ROW = RecordingRow(recording="swing", load_g=60, split="train")


@pytest.fixture(scope="module")
def front(small_specimen: Specimen) -> Specimen:
    """The specimen with the markers of one side only, and with elements that do not lock."""
    kept = small_specimen.layout.positions[:, 1] == 0.0
    names = tuple(name for name, own in zip(small_specimen.layout.names, kept, strict=True) if own)
    layout = MarkerLayout(names, small_specimen.layout.positions[kept], 0.0)
    material = replace(small_specimen.material, integration="enhanced")
    return replace(small_specimen, layout=layout, material=material)


@pytest.fixture(scope="module")
def motion(front: Specimen) -> np.ndarray:
    """Node positions [m], (T, N, 3), of a specimen softer than assumed, after some frames at rest."""
    softer = replace(front.material, youngs_modulus=0.4 * front.material.youngs_modulus)
    swing = tip_load_release(front, softer, 0.03, FRAMES, 1.0 / STEP).q
    return np.concatenate([np.repeat(swing[:1], STILL, axis=0), swing])


def write_swing(folder: Path, specimen: Specimen, motion: np.ndarray, late: float) -> None:
    """Tracks with the calibrated cameras of what cameras saw of which the right one was turned, and is late."""
    markers, random = specimen.markers(1e-6), np.random.default_rng(0)
    path = CubicSpline(np.arange(len(motion) - STILL), motion[STILL:])
    change = CameraChange(np.concatenate([TURN, np.zeros(4)]), markers.rest.mean(axis=0))
    true = {"left": CALIBRATED["left"], "right": change.moved(CALIBRATED["right"])}
    pixels = {}
    for name, camera in true.items():
        time = np.arange(len(motion)) - STILL - (late if name == "right" else 0.0)
        exact = markers.positions(torch.from_numpy(path(np.maximum(time, 0.0)))).numpy()
        pixel = camera.project(exact) + random.normal(0.0, SIGMA_PX, (*exact.shape[:2], 2))
        pixels[name] = CameraPixels(pixel, np.full_like(pixel, SIGMA_PX))
    write_tracks(folder / "swing.h5", tracks_of_pixels(markers.names, Rig(dict(CALIBRATED)), pixels, 1.0 / STEP))


def built(folder: Path, specimen: Specimen, refine: bool, row: RecordingRow = ROW) -> Dataset:
    settings = CaptureSettings(start=STILL, initial="rest", refine_cameras=refine)
    return build_dataset(specimen, folder, [row], settings, "", lambda: None)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory, front: Specimen, motion: np.ndarray) -> tuple[Dataset, Dataset]:
    """The dataset with the cameras as calibrated, and as found."""
    folder = tmp_path_factory.mktemp("tracks")
    write_swing(folder, front, motion, LATE)
    return built(folder, front, False), built(folder, front, True)


def test_turn_and_clock_are_found(datasets: tuple[Dataset, Dataset]) -> None:
    attributes = datasets[1].trajectories["swing"].attributes
    left, right = (np.asarray(attributes[f"camera_change_{name}"]) for name in ("left", "right"))
    assert np.abs(right[:3] - TURN).max() < np.radians(0.02)
    assert np.abs(left[:3]).max() < np.radians(0.02)
    assert abs(right[6] - LATE * STEP) < min(0.001 * STEP, right[13])
    for found, turn in ((left, np.zeros(3)), (right, TURN)):
        assert (np.abs(found[:3] - turn) < 4.0 * found[7:10]).all()


def test_first_frame_is_nearer_to_the_truth(datasets: tuple[Dataset, Dataset], motion: np.ndarray) -> None:
    before, after = (np.sqrt(((item.trajectories["swing"].q - motion[STILL]) ** 2).sum(-1).mean()) for item in datasets)
    assert after < 4e-5
    assert 3.0 * after < before


def test_views_and_positions_are_those_of_the_found_cameras(
    datasets: tuple[Dataset, Dataset], front: Specimen, motion: np.ndarray
) -> None:
    item = datasets[1].trajectories["swing"]
    assert item.views["right"].lag == pytest.approx(-LATE * STEP, abs=1e-4)
    assert item.views["left"].lag == pytest.approx(0.0, abs=1e-6)
    exact = front.markers(1e-6).positions(torch.from_numpy(motion[STILL:])).numpy()
    error = item.markers - exact
    assert np.nanstd(error[1:-1], axis=0).max() < 2e-5


def test_what_is_found_adds_to_a_clock_that_is_known(tmp_path: Path, front: Specimen, motion: np.ndarray) -> None:
    """The right camera is 0.2 frame early by the tracks, and filmed 0.3 frame before that."""
    markers, random = front.markers(1e-6), np.random.default_rng(0)
    path = make_interp_spline(STEP * np.arange(len(motion) - STILL), motion[STILL:], k=7)

    def moved(time: np.ndarray) -> np.ndarray:
        return markers.positions(torch.from_numpy(path(np.maximum(time - STILL * STEP, 0.0)))).numpy()

    count = np.arange(len(motion) + 1)
    true = {"left": STEP * count[:-1], "right": STEP * (count - 0.2 - LATE)}
    told = true | {"right": STEP * (count - 0.2)}
    pixels = film(CALIBRATED, true, moved, SIGMA_PX, random)
    write_tracks(tmp_path / "swing.h5", track(CALIBRATED, told, pixels, markers.names))
    known, refined = (built(tmp_path, front, refine).trajectories["swing"] for refine in (False, True))
    found = np.asarray(refined.attributes["camera_change_right"])
    assert abs(found[6] - LATE * STEP) < min(0.002 * STEP, found[13])
    assert known.views["right"].lag == pytest.approx(-0.2 * STEP)
    assert refined.views["right"].lag == pytest.approx(-(0.2 + LATE) * STEP, abs=0.002 * STEP)
    error = refined.markers - moved(STEP * count[STILL:-1])
    assert np.nanstd(error[1:-1], axis=0).max() < 1e-5
    before = known.markers - moved(STEP * count[STILL:-1])
    assert np.nanstd(before[1:-1], axis=0).max() > 1e-4


def test_a_rubber_that_hardly_creeps_turns_no_camera(tmp_path: Path, front: Specimen) -> None:
    """Its loss factor is constant above 1 Hz only; the description has none."""
    shares = tuple(branch_shares(torch.tensor(0.1, dtype=torch.float64), 1.0, 50.0).tolist())
    rubber = replace(front.material, branch_shares=shares, branch_times=branch_times(1.0, 50.0))
    swing = tip_load_release(front, rubber, 0.06, FRAMES, 1.0 / STEP).q
    q = np.concatenate([np.repeat(swing[:1], STILL, axis=0), swing])
    markers, random = front.markers(1e-6), np.random.default_rng(0)
    camera = replace(side_camera(0.0), plane=Plane((0.0, 1.0, 0.0), 0.0, 5e-4))
    exact = camera.project(markers.positions(torch.from_numpy(q)).numpy())
    pixel = exact + random.normal(0.0, SIGMA_PX, exact.shape)
    pixels = {"left": CameraPixels(pixel, np.full_like(pixel, SIGMA_PX))}
    write_tracks(tmp_path / "swing.h5", tracks_of_pixels(markers.names, Rig({"left": camera}), pixels, 1.0 / STEP))
    found = np.asarray(built(tmp_path, front, True).trajectories["swing"].attributes["camera_change_left"])
    assert (np.abs(found[:3]) < 3.0 * found[7:10]).all()
    assert found[17] < 2.0 * SIGMA_PX  # what remains [px]; with one loss factor for all frequencies, 0.41


def test_changes_are_reported_and_kept(datasets: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write_dataset(tmp_path / "beam.h5", datasets[1])
    rows = {row.camera: row for row in camera_rows(read_dataset(tmp_path / "beam.h5"))}
    assert rows["right"].touched
    assert not rows["left"].touched
    assert rows["left"].clock == ("reference", "of the others")
    clock, line = camera_warnings(datasets[1])
    assert clock.startswith("camera right: its clock was found off")
    seconds, frames = (float(clock.split(before)[1].split()[0]) for before in ("Add ", " s ("))
    assert abs(seconds / STEP) == pytest.approx(0.3, abs=0.01)
    assert frames == pytest.approx(seconds / STEP, abs=0.001)
    assert rows["right"].clock == (clock.split("Add ")[1].split(" (")[0], clock.split(" s (")[1].split(")")[0])
    assert line.startswith("camera right: ")
    assert "calibrate again" in line
    assert camera_rows(datasets[0]) == []


def test_pixels_that_no_moved_camera_explains_accuse_no_camera(datasets: tuple[Dataset, Dataset]) -> None:
    """The left camera's pixels stay unexplained, so the turn of the right one, found with it, is in doubt as well."""
    swing = datasets[1].trajectories["swing"]
    numbers = np.array(swing.attributes["camera_change_left"], dtype=float)
    numbers[17] = 1.5  # px that remain
    worse = replace(swing, attributes=swing.attributes | {"camera_change_left": numbers})
    dataset = replace(datasets[1], trajectories={"swing": worse})
    (line,) = camera_warnings(dataset)
    assert line.startswith("camera left: a moved camera does not explain the pixels")
    assert f"left 1.5 px = {1.5e3 / PIXELS_PER_METRE:.2g} mm, where sigma is {SIGMA_PX:.2g} px" in line
    for cause in ("size, preset or material", "names of markers", "perspective"):
        assert cause in line
    rows = {row.camera: row for row in camera_rows(dataset)}
    assert not any(row.touched or row.late for row in rows.values())
    assert [name for name, row in rows.items() if not row.explained] == ["left"]


@pytest.mark.parametrize("damaged", ["<b>", 3.0, (1.0, 2.0, 3.0), ("a",) * 21])
def test_changes_that_are_no_such_numbers_are_refused(datasets: tuple[Dataset, Dataset], damaged: object) -> None:
    swing = datasets[1].trajectories["swing"]
    worse = replace(swing, attributes=swing.attributes | {"camera_change_left": damaged})
    with pytest.raises(InputError, match="recording swing, camera_change_left: expected 21 numbers, found"):
        camera_rows(replace(datasets[1], trajectories={"swing": worse}))


def test_errors_of_the_model_are_not_taken_for_a_turn(
    tmp_path: Path, front: Specimen, motion: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_swing(tmp_path, front, motion, 0.0)
    locking = replace(front, material=replace(front.material, integration="full"))
    with pytest.raises(InputError, match="expected elements that follow a bent body"):
        built(tmp_path, locking, True)
    found = Refinement(
        {"right": CameraChange(np.append(TURN, np.zeros(4)), np.zeros(3), 1e-9 * np.eye(7))}, {"right": 5.0}
    )
    monkeypatch.setattr("rafl.capture.dataset.build.refine_cameras", lambda *arguments: found)
    with pytest.raises(InputError, match=r"camera right would have its pixels moved by .* but 5 px = .* remain"):
        built(tmp_path, front, True)


def test_recordings_that_cannot_show_it_are_refused(tmp_path: Path, front: Specimen, motion: np.ndarray) -> None:
    write_swing(tmp_path, front, motion, 0.0)
    with pytest.raises(InputError, match="--refine-cameras: expected a training recording"):
        built(tmp_path, front, True, ROW.model_copy(update={"split": "test"}))
