"""A camera's assumed plane and the world's axes, as lines in its image."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import Camera, PinholeCamera

Array = NDArray[Any]

LINES_ACROSS = 14  # of the grid along the longer side of the image, about
MAX_LINES = 60  # each way: a plane seen at a slant fills the image with ever more of them
POINTS = 33  # of a line, which distortion may bend
AXIS_SPACINGS = 3  # length of the axes
STEPS = (1.0, 2.0, 5.0, 10.0)
EDGE_ON = 0.05  # sine of the angle between plane and line of sight below which the plane is not drawn


@dataclass(frozen=True)
class PlaneGrid:
    """Lines of round world coordinates on a plane, and the world's axes, in pixels.

    Attributes:
        spacing: of the lines [m].
        lines: axis (x, y or z), its value [m] and the pixels (K, 2) of each line.
        axes: pixels (K, 2) of each axis from the origin on; none where the origin is behind the camera.
        length: of the axes [m].
        reason: why there are no lines; empty if there are.
    """

    spacing: float
    lines: tuple[tuple[str, float, Array], ...]
    axes: dict[str, Array]
    length: float
    reason: str = ""


def plane_grid(camera: Camera) -> PlaneGrid:
    """The grid on the plane of a camera, and the world's axes."""
    scale = float(np.linalg.norm(camera.projection_jacobian(_looked_at(camera)), 2))
    spacing = _rounded(max(camera.image_size) / LINES_ACROSS / scale)
    length = AXIS_SPACINGS * spacing
    ends = length * np.linspace(0.0, 1.0, POINTS)[:, None]
    axes = {"xyz"[k]: _drawn(camera, ends * np.eye(3)[k]) for k in range(3)}
    axes = {name: line for name, line in axes.items() if len(line) == POINTS}
    plane = camera.plane
    if plane is None:
        return PlaneGrid(spacing, (), axes, length, "calib.yaml gives this camera no plane")
    normal = np.asarray(plane.normal)
    corners = _on_plane(camera, normal, plane.offset)
    if corners is None:
        return PlaneGrid(spacing, (), axes, length, "the camera looks along its plane: check `plane` in calib.yaml")
    dropped = int(np.abs(normal).argmax())  # the coordinate that follows from the two others
    kept = [k for k in range(3) if k != dropped]
    low, high = corners[:, kept].min(axis=0), corners[:, kept].max(axis=0)
    lines = []
    for own, other in ((0, 1), (1, 0)):
        middle = round(0.5 * (low[own] + high[own]) / spacing)
        first = max(int(np.ceil(low[own] / spacing)), middle - MAX_LINES // 2)
        last = min(int(np.floor(high[own] / spacing)), middle + MAX_LINES // 2)
        for number in range(first, last + 1):
            points = np.zeros((POINTS, 3))
            points[:, kept[own]] = number * spacing
            points[:, kept[other]] = np.linspace(low[other], high[other], POINTS)
            points[:, dropped] = (plane.offset - points @ normal) / normal[dropped]
            line = _drawn(camera, points)
            if len(line) > 1:
                lines.append(("xyz"[kept[own]], number * spacing, line))
    return PlaneGrid(spacing, tuple(lines), axes, length)


def _looked_at(camera: Camera) -> Array:
    """A point in front of the camera at which its scale is taken: on its plane, or else the world origin, (3)."""
    if camera.plane is not None:
        found = _on_plane(camera, np.asarray(camera.plane.normal), camera.plane.offset)
        if found is not None:
            return np.asarray(found.mean(axis=0))
    if isinstance(camera, PinholeCamera) and camera.to_camera_frame(np.zeros(3))[2] <= 0.0:
        return np.asarray(camera.rotation.T @ (np.array([0.0, 0.0, 1.0]) - np.asarray(camera.translation)))
    return np.zeros(3)


def _on_plane(camera: Camera, normal: Array, offset: float) -> Array | None:
    """World points on a plane, spread over the image, (K, 3); None if the camera sees it edge-on or not at all."""
    if abs(normal @ camera.viewing_direction) < EDGE_ON:
        return None
    width, height = camera.image_size
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, 5), np.linspace(-0.5, height - 0.5, 5))
    slopes, values = camera.sight_equations(camera.undistort(np.column_stack([u.ravel(), v.ravel()])))
    system = np.concatenate([slopes, np.broadcast_to(normal, (len(slopes), 1, 3))], axis=1)
    right = np.concatenate([values, np.full((len(values), 1), offset)], axis=1)
    known = np.isfinite(system).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    known[known] = np.linalg.cond(system[known]) < 1e12
    points = np.linalg.solve(system[known], right[known][..., None])[..., 0]
    if isinstance(camera, PinholeCamera):
        points = points[camera.to_camera_frame(points)[:, 2] > 0.0]
    return points if len(points) >= 3 else None


def _drawn(camera: Camera, points: Array) -> Array:
    """Pixels of the world points (K, 3) that are in front of the camera, (K', 2)."""
    if isinstance(camera, PinholeCamera):
        points = points[camera.to_camera_frame(points)[:, 2] > 0.0]
    pixels = camera.project(points)
    return np.asarray(pixels[np.isfinite(pixels).all(axis=1)])


def _rounded(value: float) -> float:
    """The number 1, 2, 5 or 10 times a power of ten that is next above a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in STEPS if step * power >= value * (1 - 1e-9)) * power)
