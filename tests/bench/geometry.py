"""How near calibrated cameras and reconstructed places are to the true ones."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
from footage import Row, write_video
from rafl.calibration.board import BoardFile, View, WorldPose
from rafl.calibration.camera import Camera, OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.calibration.solve import solve_rig
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.pipeline import TrackingSettings, track_recording
from rafl.tracking.synthetic import Scene, draw, expose
from rafl.tracking.video.reader import Video, open_video
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError

SIZE = (1280, 720)
BOARD = 0.01 * np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)
PLAIN = BoardFile.model_validate(
    {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [10, 6], "spacing_mm": 10}}
)
SQUARE = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def random_views(camera: Camera, name: str, poses: tuple[WorldPose, ...], random: np.random.Generator) -> list[View]:
    def view(pose: WorldPose, number: int, known: bool) -> View:
        world = pose.origin + BOARD @ pose.rotation[:, :2].T
        pixels = camera.project(world) + random.normal(0, 0.05, BOARD.shape)
        key = f"{name}/{number}"
        return View(key, key, BOARD, pixels, pose if known else None)

    views = [view(pose, number, True) for number, pose in enumerate(poses)]
    for number in range(12 - len(poses)):
        axis = random.normal(size=3)
        axis -= axis @ camera.viewing_direction * camera.viewing_direction
        axis /= np.linalg.norm(axis)
        turn = Rotation.from_rotvec(np.radians(random.uniform(10, 40)) * axis).as_matrix() @ poses[0].rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(turn[:, 0]), y_axis=tuple(turn[:, 1])
        )
        views.append(view(pose, number + 9, False))
    return views


def calibrating(random: np.random.Generator, quick: bool) -> Iterator[Row]:
    count = 60 if quick else 1000
    flat = WorldPose(origin_mm=(5.0, 0.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
    nearer = WorldPose(origin_mm=(5.0, -20.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
    flips = refused = 0
    scales, scores = [], []
    for k in range(count):
        tilt = Rotation.from_rotvec(np.radians(random.uniform(-15, 15, 3))).as_matrix()
        scale = random.uniform(6e3, 12e3)
        camera = OrthographicCamera(
            image_size=SIZE,
            scale=(scale, scale * random.uniform(0.998, 1.002)),
            skew=random.normal(0, 10),
            rotation_vector=tuple(Rotation.from_matrix(tilt @ SQUARE).as_rotvec()),
            offset=(150.0, 400.0),
            distortion=(random.normal(0, 2e-3), 0.0),
        )
        views = random_views(camera, "left", (flat, nearer) if k % 2 else (flat,), random)
        try:
            found = solve_rig({"left": views}, {"left": SIZE}, PLAIN, {}).rig.cameras["left"]
        except InputError:
            refused += 1
            continue
        assert isinstance(found, OrthographicCamera)
        flips += bool((Rotation.from_matrix(found.rotation @ camera.rotation.T)).magnitude() > np.radians(1.0))
        scales.append(found.scale[0] / camera.scale[0] - 1)
        sigma = 1e3 * np.sqrt(np.array(found.covariance)[0, 0])
        scores.append((found.scale[0] - camera.scale[0]) / sigma)
    yield Row("silent flips", f"{count} random rigs, half with one known board", flips, "0")
    yield Row("  refused", "the same", refused)
    yield Row("scale error, RMS", "12 views at 0.05 px", float(np.sqrt(np.mean(np.square(scales)))), "<= 3e-4")
    yield Row("error / predicted sigma", "scale", float(np.sqrt(np.mean(np.square(scores)))), "0.75 to 1.25")


def two_cameras(scale: float) -> Rig:
    """At 90 degrees, both at 45 degrees to the faces, so that both see the same dots."""
    cameras: dict[str, Camera] = {}
    for name, angle in (("a", 45.0), ("b", -45.0)):
        rotation = SQUARE @ Rotation.from_rotvec([np.radians(angle), 0, 0]).as_matrix()
        cameras[name] = OrthographicCamera(
            image_size=SIZE, scale=(scale, scale), rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec())
        )
    return Rig(cameras)


def filmed(rig: Rig, places: np.ndarray, folder: Path, random: np.random.Generator) -> dict[str, Video]:
    """Raw videos of dots at places (T, M, 3), seen from every camera."""
    videos = {}
    for name, camera in rig.cameras.items():
        scene = Scene(size=SIZE, noise=2.0, slope=0.2)
        pixels = camera.project(places)
        pictures = []
        for t, now in enumerate(pixels):
            velocity = 0.5 * (pixels[min(t + 1, len(pixels) - 1)] - pixels[max(t - 1, 0)])
            ellipses = np.column_stack([now, np.full((len(now), 2), 9.0), np.zeros(len(now))])
            pictures.append(expose(draw(scene, ellipses, random, 0.2 * velocity), scene, random))
        path = folder / f"{name}.mkv"
        write_video(path, pictures, "ffv1", {})
        videos[name] = open_video(path)
    return videos


def in_the_middle(rig: Rig, places: np.ndarray) -> Rig:
    """The same rig, its pictures centred on the motion."""
    cameras: dict[str, Camera] = {}
    for name, camera in rig.cameras.items():
        assert isinstance(camera, OrthographicCamera)
        pixels = camera.project(places).reshape(-1, 2)
        middle = 0.5 * (pixels.min(0) + pixels.max(0))
        cameras[name] = replace(camera, offset=tuple(0.5 * (np.array(SIZE) - 1) - middle))
    return Rig(cameras)


def reconstructing(random: np.random.Generator, quick: bool, real: Path | None) -> Iterator[Row]:
    frames = 40 if quick else 100
    time_ = 0.01 * np.arange(frames)
    x, y = np.meshgrid(0.01 + 0.012 * np.arange(8), [0.005, 0.017, 0.029])
    rest = np.stack([x.ravel(), y.ravel(), np.full(24, 0.03)], axis=1)
    swing = 0.012 * np.sin(2 * np.pi * 7.7 * time_) * np.exp(-3 * time_)
    places = np.repeat(rest[None], frames, axis=0)
    places[..., 2] += swing[:, None] * (rest[:, 0] / 0.1) ** 2
    places[..., 1] += 0.3 * swing[:, None] * (rest[:, 0] / 0.1) ** 2
    yield from recovered("two cameras at 90 degrees, 6 px/mm", places, 6e3, random, "<= 5")
    if real is None:
        return
    for path in sorted(real.glob("*.c3d")):
        points = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
        places = points[:frames] - np.nanmean(points[:frames], axis=(0, 1))
        scale = 0.8 * min(SIZE) / float(np.ptp(places.reshape(-1, 3), axis=0).max())
        yield from recovered(path.stem, places, min(scale, 6e3), random, "<= 10")


def recovered(case: str, places: np.ndarray, scale: float, random: np.random.Generator, asked: str) -> Iterator[Row]:
    rig = in_the_middle(two_cameras(scale), places)
    layout = layout_of(places[0])
    with tempfile.TemporaryDirectory() as folder:
        videos = filmed(rig, places, Path(folder), random)
        tracks = track_recording(videos, rig, TrackingSettings(layout, None, 5), lambda: None)
    order = [tracks.names.index(name) for name in layout.names]
    error = 1e6 * (tracks.position[:, order] - places)
    rms = np.sqrt(np.nanmean(error**2, axis=(0, 1)))
    yield Row("RMS per axis, the worst [um]", case, float(rms.max()), asked)
    yield Row("within one sigma [%]", case, 100 * float((np.abs(error) < 1e6 * tracks.sigma[:, order]).mean()))


def layout_of(places: np.ndarray) -> MarkerLayout:
    return MarkerLayout(tuple(f"m{k}" for k in range(len(places))), places)
