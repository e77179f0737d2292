"""The size of a box-shaped body, from the corners that somebody clicks on in the frames of its cameras."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import Camera
from rafl.calibration.rig import Rig
from rafl.calibration.summary import OTHER_SET_UP
from rafl.common.errors import InputError

Array = NDArray[Any]

CORNERS = 4  # of a face
# Length of a cantilever beyond its span, in units of drop^2 / span: half the integral of the squared slope of a beam
# that sags under its own weight, y = (u^4 - 4 u^3 + 6 u^2) / 3.
SAG_SHARE = 4.0 / 7.0
EDGE_ON = 0.2  # sine of the angle between a camera's plane and its line of sight, below which corners tell too little
EDGE_POINTS = 9  # of a drawn edge, which distortion may bend
LARGEST_PX = 1e6  # of what is drawn
PARALLEL = 2.0  # largest angle between an axis and the normal of a face across it [degrees]
MAX_ORIGIN_MM = 5.0  # of the clamped corner from the world's origin; beyond, the world is not the specimen's frame


@dataclass(frozen=True)
class MeasuredBody:
    """What the corners say.

    Attributes:
        size_mm: along x, y and z; None where neither corners nor opposite cameras tell it.
        remarks: what somebody should look at.
    """

    size_mm: tuple[float | None, float | None, float | None]
    remarks: tuple[str, ...]


def measure_body(rig: Rig, corners: dict[str, Array]) -> MeasuredBody:
    """The size of a box that is clamped at x = 0, and hangs or lies.

    Args:
        rig: cameras in the specimen's frame.
        corners: the four corners of the face that each camera films, in any order [px], by camera, (4, 2).

    Raises:
        InputError: there are other than four corners, a camera has no plane, films an end, or sees its plane edge-on.
    """
    if not corners:
        raise InputError("expected the four corners of the body in a camera, found none; click on them")
    found: dict[int, list[float]] = {0: [], 1: [], 2: []}  # lengths along x, y, z [mm]
    remarks = []
    for name, pixels in corners.items():
        points, across = _on_plane(name, rig.cameras[name], pixels)
        points = 1e3 * points
        order = np.argsort(points[:, 0])
        clamp, tip = (part[np.argsort(part[:, across])] for part in (points[order[:2]], points[order[2:]]))
        span = np.array(tip.mean(axis=0) - clamp.mean(axis=0))
        if not span[0] > 0.0:
            raise InputError(f"camera {name}: expected corners at the clamp and at the tip; clear them and click again")
        found[0].append(float(span[0] + SAG_SHARE * span[2] ** 2 / span[0]))
        found[across].append(float(np.linalg.norm(clamp[1] - clamp[0])))
        distance = float(np.hypot(clamp[0, 0], clamp[0, across]))
        if distance > MAX_ORIGIN_MM:
            remarks.append(
                f"camera {name}: the lower corner at the clamp is {distance:.1f} mm from the world's origin; if you "
                "hit it, the calibration's world is not the specimen's frame (check the poses in board.yaml), or "
                f"{OTHER_SET_UP}"
            )
    sizes = [round(float(np.mean(found[axis])), 1) if found[axis] else _between_planes(rig, axis) for axis in range(3)]
    words = [word for word, size in zip(("length", "width", "height"), sizes, strict=True) if size is None]
    if words:
        remarks.append(f"the corners do not tell the {' and the '.join(words)}: measure and type it")
    return MeasuredBody((sizes[0], sizes[1], sizes[2]), tuple(remarks))


def _on_plane(name: str, camera: Camera, pixels: Array) -> tuple[Array, int]:
    """Where the lines of sight of pixels (4, 2) meet the camera's plane [m], (4, 3); the axis across it, y or z."""
    if pixels.shape != (CORNERS, 2):
        raise InputError(f"camera {name}: expected the {CORNERS} corners of the body, found {len(pixels)}")
    if camera.plane is None:
        raise InputError(
            f"camera {name} has no plane in the calibration, so its corners tell no lengths; type the size"
        )
    normal = np.asarray(camera.plane.normal)
    facing = int(np.abs(normal).argmax())
    if facing == 0:
        raise InputError(
            f"camera {name} films an end of the body; click in a camera that films a side, or type the size"
        )
    if abs(normal @ camera.viewing_direction) < EDGE_ON:
        raise InputError(f"camera {name} sees its plane edge-on, so the corners tell no lengths; check `plane`")
    slopes, values = camera.sight_equations(camera.undistort(pixels))
    system = np.concatenate([slopes, np.broadcast_to(normal, (CORNERS, 1, 3))], axis=1)
    right = np.concatenate([values, np.full((CORNERS, 1), camera.plane.offset)], axis=1)
    return np.asarray(np.linalg.solve(system, right[..., None])[..., 0]), 3 - facing


def _between_planes(rig: Rig, axis: int) -> float | None:
    """The distance of the outermost planes across an axis [mm]; None if there are no two."""
    planes = [camera.plane for camera in rig.cameras.values() if camera.plane is not None]
    places = [
        plane.offset / plane.normal[axis] for plane in planes if abs(plane.normal[axis]) > np.cos(np.radians(PARALLEL))
    ]
    widest = max(places, default=0.0) - min(places, default=0.0)
    return round(1e3 * float(widest), 1) if widest > 0.0 else None


def box_outline(size_mm: tuple[float, float, float], rig: Rig) -> dict[str, list[list[list[float]]]]:
    """The edges of an undeformed box with a corner at the world's origin, in each camera [px]."""
    size = 1e-3 * np.asarray(size_mm)
    edges = []
    for along in range(3):
        first, second = (axis for axis in range(3) if axis != along)
        for a in (0.0, 1.0):
            for b in (0.0, 1.0):
                edge = np.zeros((EDGE_POINTS, 3))
                edge[:, along] = np.linspace(0.0, size[along], EDGE_POINTS)
                edge[:, first], edge[:, second] = a * size[first], b * size[second]
                edges.append(edge)
    return projected(edges, rig)


def projected(edges: list[Array], rig: Rig) -> dict[str, list[list[list[float]]]]:
    """World lines (K, 3) [m] in each camera [px]."""
    return {
        name: [np.round(np.clip(camera.project(edge), -LARGEST_PX, LARGEST_PX), 2).tolist() for edge in edges]
        for name, camera in rig.cameras.items()
    }
