"""Datasets from pixels: the depth that a camera's plane assumes does not matter, nor how a clamp with markers moves."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from filmed_markers import filmed_tracks, side_camera
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.summary import missing_pixels
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.registration.averaging import average_views
from rafl.capture.registration.rigid import RigidTransform
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import damaged_parts, read_dataset, update_dataset, write_dataset
from rafl.data.objective import Recordings, recording_losses
from rafl.evaluation.metrics import compare
from rafl.fitting.fit import fit
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import read_tracks, write_tracks

FRAMES, SIGMA_PX = 8, 0.02
ROW = RecordingRow(recording="swing", load_g=60, split="train")
SETTINGS = CaptureSettings(start=0, initial="rest")


@pytest.fixture(scope="module")
def motion(front: Specimen) -> np.ndarray:
    """Node positions [m], (T, N, 3), of a specimen softer than assumed."""
    softer = replace(front.material, youngs_modulus=0.8 * front.material.youngs_modulus)
    return tip_load_release(front, softer, 0.06, FRAMES, 100.0).q


def write_swing(
    folder: Path, specimen: Specimen, motion: np.ndarray, plane_m: float, hidden: tuple[int, int] | None = None
) -> OrthographicCamera:
    """Tracks of one camera whose plane is y = `plane_m`; `hidden` are a frame and a marker that were only filled."""
    camera = replace(side_camera(0.0), plane=Plane((0.0, 1.0, 0.0), plane_m, 5e-4))
    markers = specimen.markers(1e-6)
    exact = markers.positions(torch.from_numpy(motion)).numpy()
    noise = np.random.default_rng(0).normal(0.0, SIGMA_PX, (*exact.shape[:2], 2))
    write_filmed(folder, markers.names, exact, {"left": camera}, noise, hidden)
    return camera


def write_filmed(
    folder: Path,
    names: tuple[str, ...],
    exact: np.ndarray,
    cameras: dict[str, OrthographicCamera],
    noise: np.ndarray | float = 0.0,
    hidden: tuple[int, int] | None = None,
) -> None:
    """Tracks of markers at exact positions [m], (T, M, 3), in the cameras' frame, with an error of the pixels."""
    tracks = filmed_tracks(names, exact, cameras, SIGMA_PX, noise)
    if hidden is not None:
        tracks.state[hidden] = 2
        for name in cameras:
            tracks.pixel[name][hidden], tracks.pixel_sigma[name][hidden] = np.nan, np.nan
    write_tracks(folder / "swing.h5", tracks)


def build(specimen: Specimen, folder: Path) -> Dataset:
    return build_dataset(specimen, folder, [ROW], SETTINGS, "", lambda: None)


def test_first_frame_does_not_depend_on_the_assumed_depth(front: Specimen, motion: np.ndarray, tmp_path: Path) -> None:
    found = []
    for number, plane in enumerate((0.0, 0.002)):
        folder = tmp_path / str(number)
        folder.mkdir()
        write_swing(folder, front, motion, plane)
        found.append(build(front, folder).trajectories["swing"])
    np.testing.assert_allclose(found[0].q, found[1].q, atol=2e-5)
    assert np.abs(found[0].markers - found[1].markers).max() == pytest.approx(0.002)
    distance = np.sqrt(((found[0].q - motion[0]) ** 2).sum(-1).mean())
    assert distance < 4e-5  # out of the image plane nothing but the shape tells the position, and that a weight hung
    sigma = np.asarray(found[0].attributes["fit_sigma_mm"])
    assert sigma.shape == (len(front.layout.names),)
    assert 0.01 < sigma.max() < 0.2  # most of it for nu, as elements lock here
    assert 1e3 * distance < 3.0 * sigma.max()


def test_pixels_are_kept_with_their_camera_and_markers(front: Specimen, motion: np.ndarray, tmp_path: Path) -> None:
    """Markers in another order than the specimen's; a filled position has no pixel, though it has a position."""
    turned = replace(
        front, layout=MarkerLayout(front.layout.names[::-1], front.layout.positions[::-1].copy(), front.layout.sigma)
    )
    camera = write_swing(tmp_path, turned, motion, 0.0, hidden=(3, 2))
    dataset = build(front, tmp_path)
    write_dataset(tmp_path / "data.h5", dataset)
    item = read_dataset(tmp_path / "data.h5").trajectories["swing"]
    view = item.views["left"]
    exact = camera.project(dataset.markers.positions(torch.from_numpy(motion)).numpy())
    hidden = (3, len(front.layout.names) - 3)
    assert item.valid.all()
    assert not view.seen[hidden]
    assert view.seen.sum() == view.seen.size - 1
    assert np.nanmax(np.abs(view.pixel - exact)) < 6.0 * SIGMA_PX
    np.testing.assert_allclose(view.covariance[view.seen], np.broadcast_to(SIGMA_PX**2 * np.eye(2), (79, 2, 2)))
    np.testing.assert_allclose(view.camera.project(item.markers[0]), camera.project(item.markers[0]), atol=1e-9)


CLAMP = np.array([[-0.01, 0.0, 0.0], [-0.01, 0.0, 0.03], [-0.03, 0.0, 0.01], [-0.03, 0.02, 0.03]])


def clamp_motion(in_plane: bool) -> RigidTransform:
    """Poses of a clamp that turns by up to 6 degrees and shifts by up to 5 mm; about y and in x and z if `in_plane`."""
    time = np.linspace(0.0, 1.0, FRAMES)[:, None]
    axis = np.array([0.0, 1.0, 0.0]) if in_plane else np.array([0.5, 0.7, -0.5])
    shift = np.array([0.003, 0.0 if in_plane else -0.002, 0.004])
    return RigidTransform(Rotation.from_rotvec(0.1 * time * axis).as_matrix(), time**2 * shift)


def write_moving(
    folder: Path, specimen: Specimen, motion: np.ndarray, cameras: int, noise: float = 0.0
) -> tuple[Specimen, np.ndarray]:
    """Tracks of a specimen in a moving clamp, as one or two cameras see it, with errors of the pixels of `noise`.

    Returns:
        The specimen with the clamp's markers, and its own markers in its frame [m], (T, M, 3).
    """
    pose, exact = clamp_motion(cameras == 1), specimen.markers(1e-6).positions(torch.from_numpy(motion)).numpy()
    clamp = CLAMP[:3] if cameras == 1 else CLAMP  # those in the plane of one camera
    layout = MarkerLayout(tuple(f"C{k}" for k in range(len(clamp))), clamp, 0.0)
    points = np.concatenate([exact, np.broadcast_to(clamp, (FRAMES, *clamp.shape))], axis=1)
    at_rest = (points - pose.translation[:, None]) @ pose.rotation
    rig = {"left": replace(side_camera(0.1, (0.02, -0.01)), plane=Plane((0.0, 1.0, 0.0), 0.0, 5e-4))}
    if cameras > 1:
        rig["right"] = side_camera(1.2)
    errors = noise * np.random.default_rng(0).normal(size=(*at_rest.shape[:2], 2))
    write_filmed(folder, specimen.layout.names + layout.names, at_rest, rig, errors)
    return replace(specimen, clamp_layout=layout), exact


@pytest.mark.parametrize("cameras", [1, 2])
def test_pixels_are_kept_where_the_clamp_moves(
    cameras: int, front: Specimen, motion: np.ndarray, tmp_path: Path
) -> None:
    """The exact motion explains the pixels of a turning and shifting clamp, and one that keeps still does not."""
    specimen, exact = write_moving(tmp_path, front, motion, cameras)
    write_dataset(tmp_path / "data.h5", build(specimen, tmp_path))
    dataset = read_dataset(tmp_path / "data.h5")
    item = dataset.trajectories["swing"]
    recordings = Recordings.of(dataset, ["swing"])
    markers = torch.from_numpy(exact)[:, None]
    assert recordings.in_image
    np.testing.assert_allclose(item.markers, exact, atol=1e-9 if cameras > 1 else 3e-4)  # or off the assumed plane
    assert float(recording_losses(recordings, markers)) < 1e-9 * float(recording_losses(recordings, markers + 1e-4))
    for name, view in item.views.items():
        np.testing.assert_allclose(view.project(exact), view.pixel, atol=1e-6, err_msg=name)
        still = replace(view, rotation=None, translation=None)
        assert np.linalg.norm(still.project(exact) - view.pixel, axis=2)[-1].min() > 10.0
    distance = np.sqrt(((item.q - motion[0]) ** 2).sum(-1).mean())
    assert distance < (4e-4 if cameras == 1 else 1e-4)
    assert item.attributes["fit_residual_mm"] < 0.01


@pytest.mark.parametrize("cameras", [1, 2])
def test_errors_of_the_clamp_are_those_of_the_specimen(
    cameras: int, front: Specimen, motion: np.ndarray, tmp_path: Path
) -> None:
    """The true motion differs from the pixels by as much as they and the poses of the clamp are uncertain."""
    specimen, exact = write_moving(tmp_path, front, motion, cameras, SIGMA_PX)
    dataset = build(specimen, tmp_path)
    recordings = Recordings.of(dataset, ["swing"])
    exactly = {name: replace(term, by_pose=torch.zeros_like(term.by_pose)) for name, term in recordings.terms.items()}
    squares = []
    for each in (recordings, replace(recordings, terms=exactly)):
        own = [
            gap / (term.root[..., :1, 0] * SIGMA_PX)
            for gap, term in zip(each.gaps(torch.from_numpy(exact)[:, None]), each.terms.values(), strict=True)
        ]
        squares.append(np.mean([float(gap.square().mean()) for gap in own]))
    assert 0.7 < squares[0] < 1.2
    assert squares[1] > 2.0
    sigma = dataset.trajectories["swing"].sigma[0]
    assert sigma[-1, 2] > 1.5 * SIGMA_PX / 8000.0


def test_dropped_frames_of_a_moving_clamp_are_gaps(front: Specimen, motion: np.ndarray, tmp_path: Path) -> None:
    specimen, exact = write_moving(tmp_path, front, motion, 2)
    tracks = read_tracks(tmp_path / "swing.h5")
    kept = np.delete(np.arange(FRAMES), [3, 4])
    per_frame = {key: getattr(tracks, key)[kept] for key in ("time", "position", "sigma", "state")}
    per_camera = {
        key: {name: array[kept] for name, array in getattr(tracks, key).items()}
        for key in ("pixel", "residual", "pixel_sigma", "damaged", "frame")
    }
    write_tracks(tmp_path / "swing.h5", replace(tracks, **per_frame, **per_camera))
    view = build(specimen, tmp_path).trajectories["swing"].views["right"]
    assert np.flatnonzero(~view.seen.any(axis=1)).tolist() == [3, 4]
    np.testing.assert_allclose(view.project(exact)[kept], view.pixel[kept], atol=1e-6)


def test_the_mean_of_frames_at_rest_allows_for_a_clamp_that_shakes(
    front: Specimen, motion: np.ndarray, tmp_path: Path
) -> None:
    """Frames are averaged as the specimen sees them: those of a shaking clamp show one shape."""
    specimen, exact = write_moving(tmp_path, front, np.repeat(motion[:1], FRAMES, axis=0), 2)
    views = build(specimen, tmp_path).trajectories["swing"].views
    near = exact[0] + np.random.default_rng(0).normal(0.0, 2e-4, exact[0].shape)
    near[3] = np.nan
    target, _, sigma = average_views(views, near)
    known = np.arange(len(near)) != 3
    np.testing.assert_allclose(target[known], exact[0, known], atol=2e-5)
    assert np.isnan(target[3]).all()
    assert (sigma[known] < 1e-5).all()


def test_a_file_of_the_first_format_takes_recordings_with_pixels(
    front: Specimen, motion: np.ndarray, tmp_path: Path
) -> None:
    """Its own have none. It is read, told of, evaluated and fitted by positions; pixels alone cannot be compared."""
    write_swing(tmp_path, front, motion, 0.0)
    path, new = tmp_path / "data.h5", build(front, tmp_path)
    assert missing_pixels(new) == []
    item = new.trajectories["swing"]
    write_dataset(path, replace(new, trajectories={"old": replace(item, views={})}))
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "rafl-dataset/1"
    assert missing_pixels(read_dataset(path)) == []
    update_dataset(path, new)
    assert damaged_parts(path) == []
    whole = read_dataset(path)
    assert {name: list(own.views) for name, own in whole.trajectories.items()} == {"old": [], "swing": ["left"]}
    (line,) = missing_pixels(whole)
    assert line.startswith("recordings old: no pixels, which the others have")
    assert [each.recording for each in compare(whole, {})] == ["old", "swing"]
    options: dict[str, Any] = {"method": "sysid-e", "epochs": 1, "frames": 3}
    with pytest.raises(InputError, match="small, recording old: expected the pixels that its cameras measured"):
        fit(path, tmp_path / "image", objective="image", **options)
    assert not (tmp_path / "image").exists()
    told: list[str] = []
    assert fit(path, tmp_path / "any", notify=told.append, **options).material is not None
    assert "some recordings have no pixels" in told[0]
