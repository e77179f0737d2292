"""Poses of specimens and clamps that one camera filmed: they fit its pixels, whatever plane the calibration assumes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filmed_markers import filmed_tracks, pinhole_camera, side_camera
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import Camera, Plane
from rafl.capture.dataset.sources import read_recording
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.registration import Registration, RestFit, RestPose, fit_rest, register
from rafl.capture.registration.rigid import RigidTransform, pose_sigma
from rafl.capture.specimen.specimen import Specimen
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import write_tracks

SIGMA_PX, PX_PER_MM = 0.02, 8.0
TOP = np.array([(x, y, 0.02) for x in (0.01, 0.025, 0.04) for y in (0.006, 0.014)])
NO_CLAMP = np.zeros((0, 3))
FLAT_CLAMP = np.array([[-0.01, 0.0, 0.0], [-0.01, 0.0, 0.03], [-0.03, 0.0, 0.01], [-0.03, 0.0, 0.03]])
DEEP_CLAMP = FLAT_CLAMP.copy()
DEEP_CLAMP[3, 1] = 0.02
CORNERS = np.array([(x, y, z) for x in (0.0, 0.06) for y in (0.0, 0.02) for z in (0.0, 0.02)])  # of the specimen
TILT = RigidTransform(Rotation.from_rotvec([0.03, 0.02, 0.04]).as_matrix(), np.array([0.002, 0.001, -0.001]))
OBLIQUE = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix()


def camera(kind: str, plane: float = 0.0) -> Camera:
    """A camera of the side y = 0, which it takes for y = `plane` [m]."""
    own: Camera = side_camera(0.5 if kind == "oblique" else 0.0)
    if kind.endswith("pinhole"):
        own = pinhole_camera(0.4)
        own = own.in_frame(OBLIQUE, np.zeros(3)) if kind == "oblique pinhole" else own
    return replace(own, plane=Plane((0.0, -1.0, 0.0), -plane, 5e-4))


def with_markers(specimen: Specimen, own: np.ndarray, clamp: np.ndarray = NO_CLAMP) -> Specimen:
    layouts = [
        MarkerLayout(tuple(f"{letter}{k}" for k in range(len(points))), points, 5e-4)
        for letter, points in (("m", own), ("C", clamp))
    ]
    return replace(specimen, layout=layouts[0], clamp_layout=layouts[1])


def record(folder: Path, points: np.ndarray, pose: RigidTransform, cameras: dict[str, Camera], seed: int) -> Recording:
    """A recording of points (M, 3) of the specimen frame, to which `pose` leads from that of the cameras."""
    exact = (points - pose.translation[..., None, :]) @ pose.rotation
    exact = np.broadcast_to(exact, (12, *points.shape)) if exact.ndim == 2 else exact
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_PX, (*exact.shape[:2], 2))
    names = tuple(f"p{k}" for k in range(len(points)))
    write_tracks(folder / "own.h5", filmed_tracks(names, exact, cameras, SIGMA_PX, noise))
    return read_recording(folder / "own.h5", 100.0)


def rest_fit(
    folder: Path, specimen: Specimen, pose: RigidTransform, cameras: dict[str, Camera], seed: int = 0
) -> RestFit:
    points = np.concatenate([specimen.layout.positions, specimen.clamp_layout.positions])
    return fit_rest(record(folder, points, pose, cameras, seed), RestPose("own"), specimen, 1e-2)


def corners(pose: RigidTransform) -> np.ndarray:
    """Corners of the specimen in the frame of the cameras [m], (.., 8, 3)."""
    return np.asarray((CORNERS - pose.translation[..., None, :]) @ pose.rotation)


def image_error_mm(found: RigidTransform, true: RigidTransform, seen_by: Camera) -> float:
    gap = seen_by.project(corners(found)) - seen_by.project(corners(true))
    return float(np.sqrt((gap**2).sum(-1).mean())) / PX_PER_MM


@pytest.mark.parametrize("kind", ["pinhole", "oblique", "oblique pinhole"])
def test_a_rest_pose_fits_the_pixels_of_one_camera(
    kind: str, small_specimen: Specimen, front: Specimen, tmp_path: Path
) -> None:
    """Of a specimen that is tilted by 3 degrees; a fit to the positions would be 0.6 to 0.8 mm off in the image."""
    for plane in (0.0, 0.002):
        cameras = {"a": camera(kind, plane)}
        found = rest_fit(tmp_path, front, TILT, cameras).fit
        assert not found.outliers.any()
        assert image_error_mm(found.transform, TILT, cameras["a"]) < 0.03
        if kind == "oblique":  # the distance along parallel lines of sight is as the plane says, which sigma knows
            error = np.linalg.norm(corners(found.transform) - corners(TILT), axis=1).max()
            assert 0.5e-3 < error < 2.0 * np.linalg.norm(pose_sigma(found.covariance, CORNERS), axis=1).max()
        else:
            np.testing.assert_allclose(corners(found.transform), corners(TILT), atol=3e-4)


def test_markers_on_two_sides_tell_the_tilt_though_one_plane_is_assumed(front: Specimen, tmp_path: Path) -> None:
    """A fit to the positions would be 2.6 mm off in the image."""
    specimen = with_markers(front, np.concatenate([front.layout.positions, TOP]))
    for kind in ("orthographic", "oblique", "pinhole"):
        cameras = {"a": camera(kind, 0.002)}
        found = rest_fit(tmp_path, specimen, TILT, cameras).fit
        assert image_error_mm(found.transform, TILT, cameras["a"]) < 0.005, kind
        np.testing.assert_allclose(found.transform.rotation, TILT.rotation, atol=1e-3)


def test_two_cameras_need_no_plane(front: Specimen, tmp_path: Path) -> None:
    cameras: dict[str, Camera] = {"a": side_camera(-0.8), "b": side_camera(0.8)}
    found = rest_fit(tmp_path, front, TILT, cameras).fit
    np.testing.assert_allclose(corners(found.transform), corners(TILT), atol=5e-6)


@pytest.mark.parametrize("kind", ["orthographic", "pinhole"])
def test_an_outlier_is_found_in_the_pixels_of_one_camera(kind: str, front: Specimen, tmp_path: Path) -> None:
    cameras = {"a": camera(kind, 0.002)}
    moved = front.layout.positions.copy()
    moved[4] += [0.003, 0.0, 0.002]
    recording = record(tmp_path, moved, TILT, cameras, 0)
    found = fit_rest(recording, RestPose("own"), front, 1e-2).fit
    assert np.flatnonzero(found.outliers).tolist() == [4]
    gap = [cameras["a"].project(corners(pose)[[0, 1, 4, 5]]) for pose in (found.transform, TILT)]  # on the side
    np.testing.assert_allclose(gap[0], gap[1], atol=0.05 * PX_PER_MM)


def test_a_flat_layout_may_be_tilted_to_either_side(front: Specimen, tmp_path: Path) -> None:
    """Parallel lines of sight show both poses alike: the covariance contains the difference."""
    turn = Rotation.from_rotvec([0.0, 0.0, 0.15])
    cameras, found = {"a": camera("orthographic")}, []
    for sign in (1, -1):
        pose = RigidTransform((turn if sign > 0 else turn.inv()).as_matrix(), np.zeros(3))
        fit = rest_fit(tmp_path, front, pose, cameras).fit
        found.append(float(Rotation.from_matrix(fit.transform.rotation).as_rotvec()[2]))
        assert abs(found[-1]) == pytest.approx(0.15, abs=5e-3)
        assert np.sqrt(fit.covariance[2, 2]) == pytest.approx(0.3 * np.sqrt(0.5), rel=0.2)


def test_clamp_markers_stay_where_the_layout_has_them_along_the_line_of_sight(front: Specimen, tmp_path: Path) -> None:
    """The assumed plane would have the one on the far side 20 mm nearer."""
    specimen = with_markers(front, front.layout.positions, DEEP_CLAMP)
    found = rest_fit(tmp_path, specimen, TILT, {"a": camera("orthographic", 0.002)})
    np.testing.assert_allclose(found.clamp, DEEP_CLAMP, atol=1e-5)


def moving(tilt: float, frames: int = 30) -> RigidTransform:
    """Poses of a clamp that swings about y and is tilted out of the plane [rad]."""
    time = np.linspace(0.0, 1.0, frames)[:, None]
    swing = 0.1 * np.sin(2.0 * np.pi * time) * [0.0, 1.0, 0.0] + tilt * np.array([0.7, 0.0, 0.7])
    return RigidTransform(Rotation.from_rotvec(swing).as_matrix(), 0.004 * time**2 * [1.0, 0.3, 0.5])


def clamp_registration(
    folder: Path, front: Specimen, clamp: np.ndarray, pose: RigidTransform, cameras: dict[str, Camera], seed: int = 0
) -> Registration:
    specimen = with_markers(front, front.layout.positions, clamp)
    recording = record(folder, np.concatenate([front.layout.positions, clamp]), pose, cameras, seed)
    return register(recording, specimen, None, 1e-3, True, "own")


@pytest.mark.parametrize(
    ("kind", "clamp", "limit_mm"),
    [("orthographic", DEEP_CLAMP, 0.03), ("pinhole", DEEP_CLAMP, 0.03), ("oblique", FLAT_CLAMP, 0.05)],
)
def test_poses_of_a_moving_clamp_fit_the_pixels_of_one_camera(
    kind: str, clamp: np.ndarray, limit_mm: float, front: Specimen, tmp_path: Path
) -> None:
    """One clamp marker is 20 mm behind the plane, or all leave it: positions in the plane would be millimetres off."""
    for tilt in (0.0, 0.1):
        cameras, pose = {"a": camera(kind, 0.002)}, moving(tilt)
        found = clamp_registration(tmp_path, front, clamp, pose, cameras)
        assert image_error_mm(found.pose, pose, cameras["a"]) < limit_mm
        assert max(found.residual.values()) < 1e-5


def test_errors_of_clamp_poses_are_as_large_as_their_covariance_says(front: Specimen, tmp_path: Path) -> None:
    pose, scaled = moving(0.1), []
    rigs: list[dict[str, Camera]] = [
        {"a": camera("pinhole")},
        {"a": camera("orthographic")},
        {"a": side_camera(-0.8), "b": side_camera(0.8)},
    ]
    for cameras, clamp in zip(rigs, (FLAT_CLAMP, DEEP_CLAMP, FLAT_CLAMP), strict=True):
        found = clamp_registration(tmp_path, front, clamp, pose, cameras)
        step = pose.step_from(found.pose)
        if "b" not in cameras:  # the shift along parallel lines of sight is that of the plane in all frames
            step, covariance = step[:, :3], found.covariance[:, :3, :3]
        else:
            covariance = found.covariance
        scaled.append(np.einsum("ti,tij,tj->t", step, np.linalg.inv(covariance), step).mean() / step.shape[1])
    assert scaled == pytest.approx(np.ones(3), abs=0.4)
