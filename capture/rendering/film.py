"""Synthetic recordings on disk: videos, images of a calibration board, and the ground truth."""

import io
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import h5py
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.calibration.board import FORMAT as BOARD_FORMAT
from rafl.calibration.board import CharucoPattern
from rafl.calibration.camera import Camera, OrthographicCamera, Plane
from rafl.calibration.rig import PLANE_SIGMA_MM, Rig, rig_text
from rafl.capture.rendering.motion import SimulatedMotion
from rafl.capture.rendering.render import Appearance, Renderer, apply_camera_effects, rendered_markers
from rafl.capture.specimen.specimen import Specimen
from rafl.common.files import write_bytes, write_text
from rafl.common.hdf5_files import write_hdf5

Array = NDArray[Any]

IMAGE_SIZE = (1280, 720)
FIELD_OF_VIEW_FACTOR = 1.12  # field of view as a multiple of the extent that the motion sweeps
SQUARE_MM, MARKER_SHARE = 10.0, 0.75  # side of a square on the ChArUco board; side of a marker relative to it
DICTIONARY_MARKERS, MIN_SQUARES = 250, 5  # markers of the dictionary; least squares along a side of the board
SQUARE_PRINT_PX = 240  # side of a square on the printed board [px]
BOARD_IMAGES = 12  # per camera


@dataclass(frozen=True)
class Encoding:
    """Encoding of a video file: its suffix, FFmpeg's names of muxer, encoder and pixel format, encoder options."""

    suffix: str
    muxer: str
    encoder: str
    pixel_format: str
    options: dict[str, str]


ENCODINGS = {
    "h264": Encoding("mp4", "mp4", "libx264", "yuv420p", {"crf": "14", "preset": "veryfast"}),
    "ffv1": Encoding("mkv", "matroska", "ffv1", "gray", {}),
    "mjpeg": Encoding("avi", "avi", "mjpeg", "yuvj420p", {"qmin": "2", "qmax": "3"}),
}
# Directions in the world of each camera: right and down in the image, and forward.
CAMERA_AXES = {
    "left": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "right": ((-1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
}


def side_cameras(specimen: Specimen, motions: list[SimulatedMotion], random: np.random.Generator) -> Rig:
    """Rig with one camera facing each y face, misaligned by about a degree, that sees the whole motion."""
    swept = np.concatenate([motion.q.reshape(-1, 3) for motion in motions])
    low, high = swept.min(0), swept.max(0)
    low[0] -= 0.01  # shows part of the clamp
    extent = FIELD_OF_VIEW_FACTOR * (high - low)
    scale = min(IMAGE_SIZE[0] / extent[0], IMAGE_SIZE[1] / extent[2])
    sides = (specimen.mesh.vertices[:, 1].min(), specimen.mesh.vertices[:, 1].max())
    cameras: dict[str, Camera] = {}
    for (name, axes), side in zip(CAMERA_AXES.items(), sides, strict=True):
        misalignment = Rotation.from_rotvec(np.radians(random.normal(0.0, 0.6, 3)))
        rotation = misalignment.as_matrix() @ np.array(axes)
        camera = OrthographicCamera(
            image_size=IMAGE_SIZE,
            scale=(float(scale), float(0.999 * scale)),
            skew=0.0,
            rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec().tolist()),
            offset=(0.0, 0.0),
            plane=Plane((0.0, -axes[2][1], 0.0), float(-side * axes[2][1]), 1e-3 * PLANE_SIGMA_MM),
        )
        centre = (np.asarray(IMAGE_SIZE) - 1.0) / 2.0 - camera.project(0.5 * (low + high))
        cameras[name] = replace(camera, offset=tuple(centre.tolist()))
    return Rig(cameras)


def exposure_positions(motion: SimulatedMotion, frame: int, appearance: Appearance) -> Array:
    """Node positions during the exposure of a frame [m], (samples, N, 3), centred on the time of the frame."""
    samples = appearance.samples if appearance.exposure > 0 else 1
    before = motion.q[max(frame - 1, 0)]
    after = motion.q[min(frame + 1, len(motion.q) - 1)]
    time = appearance.exposure * (np.arange(samples) + 0.5) / samples - 0.5 * appearance.exposure  # [frames]
    positions: Array = motion.q[frame] + time[:, None, None] * 0.5 * (after - before)
    return positions


def render_video(
    path: Path,
    motion: SimulatedMotion,
    renderer: Renderer,
    fps: float,
    codec: str,
    seed: int,
    tick: Callable[[], None],
) -> None:
    """Render a motion through one camera into a video file.

    Args:
        path: of the video, with the suffix of the encoding.
        motion: to render.
        renderer: of the camera.
        fps: frames per second.
        codec: key of `ENCODINGS`.
        seed: of the sensor noise.
        tick: called after every frame.
    """
    encoding = ENCODINGS[codec]
    levels = "MPEG" if encoding.pixel_format == "yuv420p" else "JPEG"

    def draw(frame: int) -> NDArray[np.uint8]:
        random = np.random.default_rng((seed, frame))
        return renderer.draw(exposure_positions(motion, frame, renderer.appearance), random)

    def images() -> Iterator[NDArray[np.uint8]]:
        with ThreadPoolExecutor(2) as pool:
            for start in range(0, len(motion.q), 8):
                yield from pool.map(draw, range(start, min(start + 8, len(motion.q))))

    content = io.BytesIO()
    with av.open(content, "w", format=encoding.muxer) as output:
        rate = Fraction(fps).limit_denominator(10000)
        stream = output.add_stream(encoding.encoder, rate=rate)
        stream.width, stream.height = renderer.camera.image_size
        stream.pix_fmt, stream.options = encoding.pixel_format, encoding.options
        for image in images():
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame = frame.reformat(format=encoding.pixel_format, dst_color_range=levels)
            output.mux(stream.encode(frame))
            tick()
        output.mux(stream.encode())
    write_bytes(path, content.getbuffer())


def write_board_images(folder: Path, rig: Rig, appearance: Appearance, random: np.random.Generator) -> None:
    """Write images of a ChArUco board for every camera, and `board.yaml`.

    In two images of each camera the board has a known pose: aligned with the camera axes, in the plane of the camera
    and 20 mm closer to it. In the others its pose is unknown, with a tilt of 12 to 38 degrees.
    """
    world = {}
    world_origin = np.zeros(3)
    pixels_per_metre = min(
        float(np.linalg.norm(camera.projection_jacobian(world_origin)[0])) for camera in rig.cameras.values()
    )
    pattern = board_for(tuple(size / pixels_per_metre for size in IMAGE_SIZE))
    squares = pattern.squares
    print_scale = SQUARE_PRINT_PX / pattern.square_mm  # print pixels per mm
    texture = pattern.opencv_board().generateImage(
        (squares[0] * SQUARE_PRINT_PX, squares[1] * SQUARE_PRINT_PX), marginSize=0
    )
    size = 1e-3 * pattern.square_mm * np.asarray(squares)
    for name, camera in rig.cameras.items():
        assert camera.plane is not None
        axes = np.array(CAMERA_AXES[name])
        to_centre = (np.asarray(IMAGE_SIZE) - 1.0) / 2.0 - camera.project_undistorted(world_origin)
        middle = np.linalg.lstsq(camera.projection_jacobian(world_origin), to_centre, rcond=None)[0]
        normal = np.array(camera.plane.normal)
        middle += (camera.plane.offset - middle @ normal) * normal
        corner = np.round(middle - axes[0] * size[0] / 2 - axes[1] * size[1] / 2, 3)
        corner += (camera.plane.offset - corner @ normal) * normal
        for view in range(BOARD_IMAGES):
            board = axes[:2].T  # board axes in the world, (3, 2)
            origin = corner
            if view < 2:
                origin = corner + 0.020 * view * normal
                world[f"{name}/{view:02d}.png"] = {
                    "origin_mm": np.round(1e3 * origin, 6).tolist(),
                    "x_axis": axes[0].tolist(),
                    "y_axis": axes[1].tolist(),
                }
            else:
                turn = np.radians(30.0 * view) + random.normal(0.0, 0.1)
                tilt = np.radians(random.uniform(12.0, 38.0))
                tilt_axis = np.cos(turn) * axes[0] + np.sin(turn) * axes[1]
                spin = Rotation.from_rotvec(np.radians(random.normal(0, 4)) * axes[2])
                board = (Rotation.from_rotvec(tilt * tilt_axis) * spin).as_matrix() @ board
                origin = middle - board @ (size / 2)
            image = _board_image(texture, print_scale, camera, board, origin)
            content = cv2.imencode(".png", apply_camera_effects(image, appearance, random))[1]
            write_bytes(folder / name / f"{view:02d}.png", content.tobytes())
    description = {"format": BOARD_FORMAT, "pattern": pattern.model_dump(mode="json"), "world": world}
    write_text(folder / "board.yaml", yaml.safe_dump(description, sort_keys=False, default_flow_style=None))


def board_for(view: tuple[float, ...]) -> CharucoPattern:
    """A board that fills most of a view (width, height) [m]: larger squares where the dictionary lacks markers."""
    square = SQUARE_MM
    while True:
        columns, rows = (int(0.92 * 1e3 * size / square) for size in view)
        if columns * rows > 2 * DICTIONARY_MARKERS:  # every other square has a marker
            square *= 2.0
        elif min(columns, rows) < MIN_SQUARES:
            square /= 2.0
        else:
            break
    return CharucoPattern(
        kind="charuco",
        squares=(columns, rows),
        square_mm=square,
        marker_mm=MARKER_SHARE * square,
        dictionary=f"DICT_4X4_{DICTIONARY_MARKERS}",
    )


def _board_image(texture: NDArray[np.uint8], print_scale: float, camera: Camera, board: Array, origin: Array) -> Array:
    """Image of the printed board [grey levels], (H, W): an affine warp at twice the resolution, averaged down."""
    to_pixels = camera.projection_jacobian(origin) @ board / (1e3 * print_scale)  # per print pixel
    shift = camera.project_undistorted(origin) + to_pixels @ [0.5, 0.5]
    warp = np.column_stack([2 * to_pixels, 2 * shift + 0.5])
    width, height = camera.image_size
    large = cv2.warpAffine(
        cv2.GaussianBlur(texture, (0, 0), 0.6 / (2 * float(np.linalg.norm(to_pixels, 2)))),
        warp,
        (2 * width, 2 * height),
        flags=cv2.INTER_LINEAR,
        borderValue=90,
    )
    image: Array = 30.0 + 0.75 * cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA).astype(float)
    return image


def write_truth(path: Path, specimen: Specimen, motions: list[SimulatedMotion], rig: Rig, material_text: str) -> None:
    """Write `truth.h5`: time, marker positions [m], their pixels by camera, and node positions of each recording."""
    markers = rendered_markers(specimen)
    with write_hdf5(path) as file:
        file.attrs.update({"calibration": rig_text(rig), "material": material_text, "specimen": specimen.text})
        file["marker_names"] = np.array(markers.names, dtype=h5py.string_dtype())
        for motion in motions:
            group = file.create_group(motion.name)
            positions = markers.positions(torch.from_numpy(motion.q)).numpy()
            group.attrs["load_g"] = 1e3 * motion.load
            group["time"], group["position"], group["vertices"] = motion.time, positions, motion.q
            for name, camera in rig.cameras.items():
                group[f"cameras/{name}/pixel"] = camera.project(positions)
