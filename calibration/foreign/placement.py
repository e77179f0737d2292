"""Placing a calibrated rig in the frame of known points."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import PinholeCamera
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError

Array = NDArray[Any]


@dataclass(frozen=True)
class KnownPoints:
    """Points in the new world frame [m], (P, 3), and their pixels in one camera (P, 2)."""

    points: Array
    pixels: Array


def place_rig(rig: Rig, views: dict[str, KnownPoints]) -> Rig:
    """Move the world frame of a rig of pinhole cameras to that of known points; the cameras keep their places.

    The transform X_old = R X + t minimises the reprojection residuals of all cameras. The poses of every camera by
    itself are the starts (`cv2.solvePnPGeneric`; two for points in a plane).

    Args:
        rig: pinhole cameras.
        views: known points by camera, at least four not in a line for each.

    Returns:
        The cameras in the new frame, with the RMS residual of each. They have no plane and no covariance.

    Raises:
        InputError: a camera is not a pinhole camera, or the points determine no pose.
    """
    cameras = {name: _pinhole(rig, name) for name in views}

    def residuals(values: Array) -> Array:
        parts = [_moved(cameras[name], values).project(view.points) - view.pixels for name, view in views.items()]
        return np.concatenate([part.ravel() for part in parts])

    starts = [start for name, view in views.items() for start in _starts(cameras[name], view)]
    if not starts:
        raise InputError(
            f"expected points that determine the pose of {', '.join(views)}, found none; check the markers"
        )
    best = min((least_squares(residuals, start, x_scale="jac") for start in starts), key=lambda fit: float(fit.cost))
    placed = {}
    for name, view in views.items():
        camera = _moved(cameras[name], best.x)
        rms = float(np.sqrt(((camera.project(view.points) - view.pixels) ** 2).mean()))
        placed[name] = replace(camera, residual=rms, plane=None, covariance=None)
    return Rig(dict(placed))


def _pinhole(rig: Rig, name: str) -> PinholeCamera:
    camera = rig.cameras[name]
    if not isinstance(camera, PinholeCamera):
        raise InputError(
            f"expected a calibration of pinhole cameras, found another camera {name}; calibrate it instead"
        )
    return camera


def _moved(camera: PinholeCamera, values: Array) -> PinholeCamera:
    """The camera with the rotation vector and translation [m] of X_old = R X + t applied before it, (6)."""
    back = Rotation.from_rotvec(values[:3]).as_matrix().T
    return camera.in_frame(back, -back @ values[3:])


def _starts(camera: PinholeCamera, view: KnownPoints) -> list[Array]:
    """Transforms X_old = R X + t from one camera's poses, (6) each."""
    matrix = np.array([[camera.focal[0], camera.skew, 0.0], [0.0, camera.focal[1], 0.0], [0.0, 0.0, 1.0]])
    matrix[:2, 2] = camera.centre
    flat = np.linalg.matrix_rank(view.points - view.points.mean(axis=0), tol=1e-6) < 3
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    _, vectors, shifts, _ = cv2.solvePnPGeneric(view.points, camera.undistort(view.pixels), matrix, None, flags=method)
    starts = []
    for vector, shift in zip(vectors, shifts, strict=True):
        rotation = camera.rotation.T @ Rotation.from_rotvec(vector.ravel()).as_matrix()
        translation = camera.rotation.T @ (shift.ravel() - np.asarray(camera.translation))
        starts.append(np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), translation]))
    return starts
