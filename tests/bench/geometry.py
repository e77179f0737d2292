"""Tracking benchmark: accuracy of calibrated cameras and of reconstructed positions."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
from footage import Measurement, write_video
from scipy.spatial.transform import Rotation
from synthetic import Scene, draw, expose

from rafl.calibration.board import BoardFile, View, WorldPose
from rafl.calibration.camera import Camera, OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.calibration.solve import solve_rig
from rafl.common.errors import InputError
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.pipeline import TrackingSettings, track_recording
from rafl.tracking.video.reader import Video, open_video

IMAGE_SIZE = (1280, 720)
BOARD_POINTS = 0.01 * np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)  # [m]
BOARD_FILE = BoardFile.model_validate(
    {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [10, 6], "spacing_mm": 10}}
)
SIDE_VIEW_ROTATION = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # world to camera: image x along X, y along -Z


def random_views(camera: Camera, name: str, poses: tuple[WorldPose, ...], random: np.random.Generator) -> list[View]:
    """Twelve images of the board: at the known poses, then at unknown orientations tilted by 10 to 40 degrees."""

    def view(pose: WorldPose, number: int, known: bool) -> View:
        world = pose.origin + BOARD_POINTS @ pose.rotation[:, :2].T
        pixels = camera.project(world) + random.normal(0, 0.05, BOARD_POINTS.shape)
        key = f"{name}/{number}"
        return View(key, key, BOARD_POINTS, pixels, pose if known else None)

    views = [view(pose, number, True) for number, pose in enumerate(poses)]
    for number in range(12 - len(poses)):
        axis = random.normal(size=3)
        axis -= axis @ camera.viewing_direction * camera.viewing_direction
        axis /= np.linalg.norm(axis)
        rotation = Rotation.from_rotvec(np.radians(random.uniform(10, 40)) * axis).as_matrix() @ poses[0].rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(rotation[:, 0]), y_axis=tuple(rotation[:, 1])
        )
        views.append(view(pose, number + 9, False))
    return views


def measure_calibration(random: np.random.Generator, quick: bool) -> Iterator[Measurement]:
    count = 60 if quick else 1000
    first_pose = WorldPose(origin_mm=(5.0, 0.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
    nearer_pose = WorldPose(origin_mm=(5.0, -20.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
    flips = refused = 0
    scale_errors, normalised_errors = [], []
    for k in range(count):
        tilt = Rotation.from_rotvec(np.radians(random.uniform(-15, 15, 3))).as_matrix()
        scale = random.uniform(6e3, 12e3)
        camera = OrthographicCamera(
            image_size=IMAGE_SIZE,
            scale=(scale, scale * random.uniform(0.998, 1.002)),
            skew=random.normal(0, 10),
            rotation_vector=tuple(Rotation.from_matrix(tilt @ SIDE_VIEW_ROTATION).as_rotvec()),
            offset=(150.0, 400.0),
            distortion=(random.normal(0, 2e-3), 0.0),
        )
        views = random_views(camera, "left", (first_pose, nearer_pose) if k % 2 else (first_pose,), random)
        try:
            found = solve_rig({"left": views}, {"left": IMAGE_SIZE}, BOARD_FILE, {}).rig.cameras["left"]
        except InputError:
            refused += 1
            continue
        assert isinstance(found, OrthographicCamera)
        flips += bool((Rotation.from_matrix(found.rotation @ camera.rotation.T)).magnitude() > np.radians(1.0))
        scale_errors.append(found.scale[0] / camera.scale[0] - 1)
        sigma = 1e3 * np.sqrt(np.array(found.covariance)[0, 0])
        normalised_errors.append((found.scale[0] - camera.scale[0]) / sigma)
    case = f"{count} random rigs, half with one known board"
    rms_scale_error, rms_normalised = (
        float(np.sqrt(np.mean(np.square(values)))) for values in (scale_errors, normalised_errors)
    )
    yield Measurement("undetected flips (rotation off by > 1 degree)", case, flips, "0")
    yield Measurement("  calibrations refused", case, refused)
    yield Measurement("relative scale error, RMS", "12 views, noise 0.05 px", rms_scale_error, "<= 3e-4")
    yield Measurement("RMS of error / reported sigma", "scale", rms_normalised, "0.75 to 1.25")


def perpendicular_cameras(scale: float) -> Rig:
    """Two cameras at 90 degrees, each at 45 degrees to the faces, so that both see the same dots."""
    cameras: dict[str, Camera] = {}
    for name, angle in (("a", 45.0), ("b", -45.0)):
        rotation = SIDE_VIEW_ROTATION @ Rotation.from_rotvec([np.radians(angle), 0, 0]).as_matrix()
        cameras[name] = OrthographicCamera(
            image_size=IMAGE_SIZE,
            scale=(scale, scale),
            rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()),
        )
    return Rig(cameras)


def render_videos(rig: Rig, positions: np.ndarray, folder: Path, random: np.random.Generator) -> dict[str, Video]:
    """Lossless videos from every camera of dots at the given positions [m], (T, M, 3)."""
    videos = {}
    for name, camera in rig.cameras.items():
        scene = Scene(size=IMAGE_SIZE, noise=2.0, light_falloff=0.2)
        pixels = camera.project(positions)
        frames = []
        for t, current in enumerate(pixels):
            velocity = 0.5 * (pixels[min(t + 1, len(pixels) - 1)] - pixels[max(t - 1, 0)])
            ellipses = np.column_stack([current, np.full((len(current), 2), 9.0), np.zeros(len(current))])
            frames.append(expose(draw(scene, ellipses, random, 0.2 * velocity), scene, random))
        path = folder / f"{name}.mkv"
        write_video(path, frames, "ffv1", {})
        videos[name] = open_video(path)
    return videos


def centre_images(rig: Rig, positions: np.ndarray) -> Rig:
    """The same rig with the image of every camera centred on the motion."""
    cameras: dict[str, Camera] = {}
    for name, camera in rig.cameras.items():
        assert isinstance(camera, OrthographicCamera)
        pixels = camera.project(positions).reshape(-1, 2)
        middle = 0.5 * (pixels.min(0) + pixels.max(0))
        cameras[name] = replace(camera, offset=tuple(0.5 * (np.array(IMAGE_SIZE) - 1) - middle))
    return Rig(cameras)


def measure_reconstruction(random: np.random.Generator, quick: bool, real: Path | None) -> Iterator[Measurement]:
    """Errors for a vibrating beam, and for the motions of C3D recordings where their folder `real` is given."""
    frames = 40 if quick else 100
    time_ = 0.01 * np.arange(frames)
    x, y = np.meshgrid(0.01 + 0.012 * np.arange(8), [0.005, 0.017, 0.029])
    rest = np.stack([x.ravel(), y.ravel(), np.full(24, 0.03)], axis=1)
    deflection = 0.012 * np.sin(2 * np.pi * 7.7 * time_) * np.exp(-3 * time_)
    positions = np.repeat(rest[None], frames, axis=0)
    positions[..., 2] += deflection[:, None] * (rest[:, 0] / 0.1) ** 2
    positions[..., 1] += 0.3 * deflection[:, None] * (rest[:, 0] / 0.1) ** 2
    yield from measure_recording("two cameras at 90 degrees, 6 px/mm", positions, 6e3, random, "<= 5")
    if real is None:
        return
    for path in sorted(real.glob("*.c3d")):
        points = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
        positions = points[:frames] - np.nanmean(points[:frames], axis=(0, 1))
        scale = 0.8 * min(IMAGE_SIZE) / float(np.ptp(positions.reshape(-1, 3), axis=0).max())
        yield from measure_recording(path.stem, positions, min(scale, 6e3), random, "<= 10")


def measure_recording(
    case: str, positions: np.ndarray, scale: float, random: np.random.Generator, target: str
) -> Iterator[Measurement]:
    rig = centre_images(perpendicular_cameras(scale), positions)
    layout = numbered_layout(positions[0])
    with tempfile.TemporaryDirectory() as folder:
        videos = render_videos(rig, positions, Path(folder), random)
        tracks = track_recording(videos, rig, TrackingSettings(layout, None, 5), lambda: None)
    order = [tracks.names.index(name) for name in layout.names]
    error = 1e6 * (tracks.position[:, order] - positions)
    rms = np.sqrt(np.nanmean(error**2, axis=(0, 1)))
    covered = 100 * float((np.abs(error) < 1e6 * tracks.sigma[:, order]).mean())
    yield Measurement("RMS error of the worst axis [um]", case, float(rms.max()), target)
    yield Measurement("errors within one sigma [%]", case, covered)


def numbered_layout(positions: np.ndarray) -> MarkerLayout:
    return MarkerLayout(tuple(f"m{k}" for k in range(len(positions))), positions)
