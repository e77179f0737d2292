"""Datasets and tracks whose markers were filmed: exact positions become pixels of given cameras."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic_tracks import tracks_of_pixels

from rafl.calibration.camera import Camera, OrthographicCamera, PinholeCamera
from rafl.calibration.rig import Rig
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.views import View
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

SIZE = (1280, 720)
PIXELS_PER_METRE = 8000.0
POSE_SIGMA = np.array([1e-4, 2e-4, 1e-4, 5e-6, 2e-6, 5e-6])  # of a moving frame [rad, m]


def side_camera(angle: float, distortion: tuple[float, float] = (0.0, 0.0)) -> OrthographicCamera:
    """An orthographic camera that looks along y, turned about z by an angle [rad]."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotation = axes @ Rotation.from_rotvec([0.0, 0.0, -angle]).as_matrix()
    return OrthographicCamera(
        image_size=SIZE,
        rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec().tolist()),
        scale=(PIXELS_PER_METRE, PIXELS_PER_METRE),
        offset=(300.0, 400.0),
        distortion=distortion,
    )


def pinhole_camera(distance: float) -> PinholeCamera:
    """A pinhole camera with distortion that looks along y from a distance [m]."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return PinholeCamera(
        image_size=SIZE,
        rotation_vector=tuple(Rotation.from_matrix(axes).as_rotvec().tolist()),
        focal=(PIXELS_PER_METRE * distance, PIXELS_PER_METRE * distance),
        centre=(640.0, 360.0),
        translation=(-0.03, 0.01, distance),
        distortion=(0.05, -0.02, 1e-3, -2e-3, 0.01),
    )


def frame_motion(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3) and translations [m], (T, 3), from a frame at rest to one that turns and shifts."""
    time = np.linspace(0.0, 1.0, frames)[:, None]
    turn = Rotation.from_rotvec(0.1 * time * [0.5, 0.7, -0.5]).as_matrix()
    return turn, time**2 * [0.003, -0.002, 0.004]


def filmed(
    dataset: Dataset,
    cameras: Mapping[str, Camera],
    sigma: float = 0.02,
    noise: np.random.Generator | None = None,
    moving: bool = False,
) -> Dataset:
    """The dataset with what the cameras see of all valid markers.

    Args:
        dataset: with positions.
        cameras: in the specimen frame where it starts.
        sigma: of the pixels [px].
        noise: adds errors of this sigma to the pixels; none if None.
        moving: whether the specimen frame turns by 6 degrees and shifts by 5 mm, as known to POSE_SIGMA.
    """

    def view(camera: Camera, item: Trajectory) -> View:
        rotation, translation = frame_motion(len(item.time))
        seen = np.einsum("tji,tmj->tmi", rotation, item.markers - translation[:, None]) if moving else item.markers
        pixel = camera.project(seen)
        if noise is not None:
            pixel = pixel + noise.normal(0.0, sigma, pixel.shape)
        covariance = np.where(item.valid[..., None, None], sigma**2 * np.eye(2), np.nan)
        found = View(camera, np.where(item.valid[..., None], pixel, np.nan), covariance, np.zeros(len(item.time)))
        known = np.broadcast_to(np.diag(POSE_SIGMA**2), (len(rotation), 6, 6))
        return replace(found, rotation=rotation, translation=translation, pose_covariance=known) if moving else found

    return replace(
        dataset,
        trajectories={
            name: replace(item, views={key: view(camera, item) for key, camera in cameras.items()})
            for name, item in dataset.trajectories.items()
        },
    )


def filmed_tracks(
    names: tuple[str, ...],
    exact: np.ndarray,
    cameras: Mapping[str, Camera],
    sigma: float = 0.02,
    noise: np.ndarray | float = 0.0,
    seen: Mapping[str, np.ndarray] | None = None,
) -> Tracks:
    """Tracks of markers at exact positions in the cameras' frame, at 100 frames/s.

    Args:
        names: of the markers, (M).
        exact: [m], (T, M, 3).
        cameras: by name.
        sigma: of the pixels [px].
        noise: their errors [px], (T, M, 2).
        seen: which markers each camera sees, (M); all if None.
    """
    pixels = {}
    for name, camera in cameras.items():
        kept = np.ones(len(names), bool) if seen is None else seen[name]
        pixel = np.where(kept[:, None], camera.project(exact) + noise, np.nan)
        pixels[name] = CameraPixels(pixel, np.where(np.isfinite(pixel), sigma, np.nan))
    return tracks_of_pixels(names, Rig(dict(cameras)), pixels, longest_gap=5)
