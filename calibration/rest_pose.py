"""Calibration of a camera from one view of points of known position: the markers of a specimen at rest.

One view does not determine everything: pixels are assumed square, without skew, and the lens without distortion.
Markers on one face look the same to two mirrored cameras, as a flat board does.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rafl.calibration.board import View
from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import PLANE_SIGMA_MM
from rafl.calibration.solve import MAX_RESIDUAL_RATIO, SAME_ROTATION
from rafl.calibration.views import farther_edge, fit_affine
from rafl.common.errors import InputError

Array = NDArray[Any]

MIN_POINTS = 6
PLANARITY_TOLERANCE = 0.02  # thickness over extent below which points count as coplanar, or as collinear
# Decrease of the sum of squared residuals, in variances of a residual, below which a tilt is not significant.
MIN_TILT_GAIN = 9.2
MIN_VISIBLE_SHORTENING = 3.0  # residuals by which a tilt must shorten a face to be detected
HUBER_SIGMAS = 2.5  # the cost of a residual larger than this many sigmas grows linearly


@dataclass(frozen=True)
class RestCamera:
    """A camera fitted to one view.

    Attributes:
        camera: with residual, covariance and the plane of the points.
        tilt: angle between the face with the points and the image plane [rad].
        undetected_tilt: largest tilt that the view could hide [rad]; 0 if a tilt was detected.
    """

    camera: OrthographicCamera
    tilt: float
    undetected_tilt: float


def camera_from_points(
    points: Array, pixels: Array, image_size: tuple[int, int], name: str, tilt_sign: int | None = None
) -> RestCamera:
    """Fit the orthographic camera that sees points (P, 3) [m] at pixels (P, 2).

    Args:
        points: positions on the specimen, whose frame is the world frame.
        pixels: their pixels.
        image_size: width and height [px].
        name: camera name for error messages.
        tilt_sign: the choice between two mirrored cameras: +1 if the right edge of the face is farther away (or the
            lower edge, if the face is tilted more about the horizontal), else -1.

    Raises:
        InputError: there are too few points, or two mirrored cameras explain them equally well.
    """
    if len(points) < MIN_POINTS:
        raise InputError(
            f"camera {name}: expected at least {MIN_POINTS} markers of known position, found {len(points)}; make sure "
            "that the whole face is in the image, or calibrate with a board"
        )
    middle = points.mean(0)
    _, extent, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extent[1] < PLANARITY_TOLERANCE * extent[0]:
        raise InputError(f"camera {name}: expected markers that span a plane, found all in one line; use a board")
    face = axes * [[1.0], [1.0], [np.linalg.det(axes)]]  # rows: two directions in the face, and its normal
    view = View(name, name, (points - middle) @ face[:2].T, pixels, None)
    starts = [rotation @ face for rotation in fit_affine(view).rotations]
    if extent[2] > PLANARITY_TOLERANCE * extent[0]:
        rows = np.linalg.lstsq(points - middle, pixels - pixels.mean(0), rcond=None)[0].T
        u, _, vt = np.linalg.svd(rows, full_matrices=False)
        starts.insert(0, np.vstack([u @ vt, np.cross((u @ vt)[0], (u @ vt)[1])]))
    found: list[_Fit] = []
    for start in starts:
        fit = _Fit.of(points - middle, pixels, start, tilted=True)
        if not any((fit.rotation * other.rotation.inv()).magnitude() < SAME_ROTATION for other in found):
            found.append(fit)
    best = min(fit.rms for fit in found)
    plausible = [fit for fit in found if fit.rms < MAX_RESIDUAL_RATIO * best + 1e-6]
    undetected_tilt = 0.0
    if len(plausible) > 1:
        facing = _facing_rotation(plausible[0].rotation.as_matrix(), face[2])
        untilted = _Fit.of(points - middle, pixels, facing, tilted=False)
        degrees_of_freedom = 2 * len(points) - 6
        if untilted.rms**2 < best**2 * (1.0 + MIN_TILT_GAIN / degrees_of_freedom):
            # A tilt t shortens the face by t^2 / 2 of its extent.
            shortening = MIN_VISIBLE_SHORTENING * untilted.rms / (untilted.values[0] * extent[1])
            undetected_tilt = float(np.sqrt(2.0 * shortening))
            plausible = [untilted]
    if len(plausible) > 1:
        edges = [farther_edge(fit.rotation.as_matrix() @ face.T) for fit in plausible]
        chosen = [fit for fit, (sign, _, _) in zip(plausible, edges, strict=True) if sign == tilt_sign]
        if len(chosen) != 1:
            _, tilt, edge = edges[0]
            raise InputError(
                f"camera {name}: the face of the specimen is tilted by {np.degrees(tilt):.1f} degrees, and one "
                "orthographic view of markers in one plane does not show which way; give "
                f"--tilt-sign {name}=+ if the {edge} edge of the face is farther from the camera, {name}=- if it is "
                "nearer, or calibrate with a board"
            )
        plausible = chosen
    planar = extent[2] <= PLANARITY_TOLERANCE * extent[0]
    return _rest_camera(plausible[0], middle, face, planar, image_size, undetected_tilt)


@dataclass(frozen=True)
class _Fit:
    """Least-squares fit of an orthographic view.

    Attributes:
        values: scale [px/m], rotation vector (3), offset [px] (2).
        covariance: of the values, (6, 6).
        rms: root mean square residual of a coordinate [px].
    """

    values: Array
    covariance: Array
    rms: float

    @property
    def rotation(self) -> Rotation:
        return Rotation.from_rotvec(self.values[1:4])

    @classmethod
    def of(cls, points: Array, pixels: Array, start: Array, tilted: bool) -> "_Fit":
        """Fit from an initial rotation (3, 3). If not `tilted`, only the rotation about the line of sight is free."""
        base = Rotation.from_matrix(start)
        free = [0, 1, 2, 3, 4, 5] if tilted else [0, 3, 4, 5]
        scale = np.sqrt(((pixels - pixels.mean(0)) ** 2).sum() / ((points @ start[:2].T) ** 2).sum())

        def values(x: Array) -> Array:
            full = np.array([1.0, 0.0, 0.0, 0.0, *pixels.mean(0)])
            full[free] = x
            rotation = Rotation.from_rotvec(full[1:4]) * base
            return np.concatenate([[full[0] * scale], rotation.as_rotvec(), full[4:]])

        def residuals(x: Array) -> Array:
            full = values(x)
            rotation = Rotation.from_rotvec(full[1:4]).as_matrix()
            result: Array = (full[0] * points @ rotation[:2].T + full[4:] - pixels).ravel()
            return result

        first = least_squares(residuals, np.array([1.0, 0.0, 0.0, 0.0, *pixels.mean(0)])[free], x_scale="jac")
        sigma = 1.4826 * float(np.median(np.abs(first.fun))) + 1e-6
        last = least_squares(residuals, first.x, x_scale="jac", loss="huber", f_scale=HUBER_SIGMAS * sigma)
        rms = float(np.sqrt((last.fun**2).mean()))
        jacobian = np.array([(values(last.x + h) - values(last.x - h)) / 2e-6 for h in 1e-6 * np.eye(len(free))]).T
        variance = (last.fun**2).sum() / (len(last.fun) - len(free))
        covariance = variance * jacobian @ np.linalg.pinv(last.jac.T @ last.jac) @ jacobian.T
        return cls(values(last.x), covariance, rms)


def _facing_rotation(rotation: Array, normal: Array) -> Array:
    """The rotation nearest to `rotation` whose line of sight is along the face's normal."""
    seen = rotation @ normal
    straight = np.array([0.0, 0.0, np.sign(seen[2]) or 1.0])
    axis = np.cross(seen, straight)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return rotation
    facing: Array = Rotation.from_rotvec(np.arcsin(min(sine, 1.0)) * axis / sine).as_matrix() @ rotation
    return facing


def _rest_camera(
    fit: _Fit, middle: Array, face: Array, planar: bool, image_size: tuple[int, int], undetected_tilt: float
) -> RestCamera:
    scale, rotation = float(fit.values[0]), fit.rotation.as_matrix()
    offset = fit.values[4:] - scale * rotation[:2] @ middle
    # Derivative of mx, my, skew [px/mm], rotation vector, offset at the world origin [px], k1, k2 by the fit's values.
    jacobian = np.zeros((10, 6))
    jacobian[0, 0] = jacobian[1, 0] = 1e-3
    jacobian[3:6, 1:4] = np.eye(3)
    jacobian[6:8, 4:] = np.eye(2)
    jacobian[6:8, 0] = -rotation[:2] @ middle
    for k, h in enumerate(1e-6 * np.eye(3)):
        varied = Rotation.from_rotvec(fit.values[1:4] + h).as_matrix()
        jacobian[6:8, 1 + k] = -scale * (varied - rotation)[:2] @ middle / 1e-6
    covariance = jacobian @ fit.covariance @ jacobian.T
    normal = face[2]
    plane = Plane(tuple(normal.tolist()), float(normal @ middle), 1e-3 * PLANE_SIGMA_MM) if planar else None
    camera = OrthographicCamera(
        image_size=image_size,
        scale=(scale, scale),
        rotation_vector=tuple(fit.values[1:4].tolist()),
        offset=tuple(offset.tolist()),
        plane=plane,
        residual=fit.rms,
        covariance=tuple(map(tuple, covariance.tolist())),
    )
    tilt = float(np.arccos(np.clip(abs(rotation[2] @ normal), 0.0, 1.0)))
    return RestCamera(camera, tilt, undetected_tilt)
