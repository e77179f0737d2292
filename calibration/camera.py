"""Camera models: projection of world points to pixels, and its inverse distortion."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[Any]

# Differences of [mx, my, skew] [px/mm], the rotation vector [rad], the offset [px], and k1, k2; far above rounding.
PARAMETER_STEPS = (*(1e-4,) * 3, *(1e-6,) * 3, *(1e-3,) * 2, *(1e-6,) * 2)
MAX_IMAGE_SIZE = 100_000  # [px]; no sensor has as many pixels along one of its sides
COMPLEX_STEP = 1e-20  # [m]; its square vanishes beside 1 in the computer


@dataclass(frozen=True)
class Plane:
    """Plane of the markers that only one camera sees: normal . X = offset.

    Attributes:
        normal: unit vector, world frame, (3).
        offset: [m].
        sigma: of the markers' distances from the plane [m].
    """

    normal: tuple[float, float, float]
    offset: float
    sigma: float


@dataclass(frozen=True)
class Perspective:
    """Perspective that the images of an orthographic camera show.

    Attributes:
        distance: of the camera from the world origin [m].
        depth: along the line of sight, from the world origin, at which the camera's scale is exact [m].
        centre: pixel at which points do not move with their depth, (2): that about which the calibration's points lie.
    """

    distance: float
    depth: float
    centre: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Base of the camera models: world to camera, projection to undistorted pixels, then distortion.

    Attributes:
        image_size: width and height [px].
        rotation_vector: rotation from world to camera (x right, y down, z away from the camera) [rad], (3).
        plane: plane of the markers that only this camera sees.
        time_offset: this camera's clock minus the rig's [s].
        residual: RMS reprojection residual of the calibration [px].
        covariance: covariance of the first ten model parameters, see `datasets/README.md`, (10, 10), or None.
    """

    image_size: tuple[int, int]
    rotation_vector: tuple[float, float, float]
    plane: Plane | None = None
    time_offset: float = 0.0
    residual: float = 0.0
    covariance: tuple[tuple[float, ...], ...] | None = None

    @cached_property
    def rotation(self) -> Array:
        """Rotation from world to camera, (3, 3)."""
        result: Array = Rotation.from_rotvec(self.rotation_vector).as_matrix()
        return result

    @property
    def viewing_direction(self) -> Array:
        """Line of sight at the image centre: unit vector away from the camera, world frame, (3)."""
        direction: Array = self.rotation[2]
        return direction

    def in_frame(self, rotation: Array, translation: Array) -> "Camera":
        """This camera in another world frame, in which a point X has the coordinates R X + t.

        The calibration's covariance is that of the old frame; the camera in the new one has none.

        Args:
            rotation: R, (3, 3).
            translation: t [m], (3).
        """
        turned = self.rotation @ rotation.T
        plane = self.plane
        if plane is not None:
            normal = rotation @ plane.normal
            plane = replace(plane, normal=tuple(normal.tolist()), offset=plane.offset + float(normal @ translation))
        vector = tuple(Rotation.from_matrix(turned).as_rotvec().tolist())
        return replace(self, rotation_vector=vector, plane=plane, covariance=None)

    def project_undistorted(self, points: Array) -> Array:
        """Undistorted pixels (..., 2) of world points (..., 3) [m]."""
        raise NotImplementedError

    def jacobian(self, points: Array) -> Array:
        """Derivative of `project`, with the distortion, with respect to the point [px/m], (..., 2, 3).

        By complex steps, which are exact to rounding: the projection is analytic.
        """
        directions = 1j * COMPLEX_STEP * np.eye(3)
        columns = [self.project(points + direction).imag / COMPLEX_STEP for direction in directions]
        result: Array = np.stack(columns, axis=-1)
        return result

    def projection_jacobian(self, points: Array) -> Array:
        """Derivative of `project_undistorted` with respect to the point [px/m], (..., 2, 3)."""
        raise NotImplementedError

    def sight_equations(self, undistorted: Array) -> tuple[Array, Array]:
        """Linear equations of the lines of sight of undistorted pixels (..., 2).

        Returns:
            A (..., 2, 3) and b (..., 2): the points X [m] with A X = b are those that `project_undistorted` maps to the
            pixel.
        """
        raise NotImplementedError

    def model_error(self, points: Array, depth_sigma: Array) -> Array:
        """Expected error of the model itself at world points (..., 3) [m], in undistorted pixels (..., 2).

        Args:
            points: world points [m], (..., 3).
            depth_sigma: of their distances from the camera [m], (...).
        """
        return np.zeros((*points.shape[:-1], 2))

    def calibration_sigma(self, points: Array) -> float:
        """Root mean square standard deviation of a coordinate of the pixels of points (..., 3) [m] [px].

        It follows from the covariance; NaN for a camera without one.
        """
        return float("nan")

    def distort(self, undistorted: Array) -> Array:
        """Distorted pixels (..., 2) of undistorted pixels (..., 2)."""
        raise NotImplementedError

    def undistort(self, pixels: Array) -> Array:
        """Undistorted pixels (..., 2): the inverse of `distort`, by fixed-point iteration.

        Where a distortion is so strong that the iteration diverges, they are not finite.
        """
        undistorted = pixels.copy()
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(40):
                error = pixels - self.distort(undistorted)
                undistorted += error
                if not np.nanmax(np.abs(error), initial=0.0) > 1e-10:
                    break
        return undistorted

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of world points (..., 3) [m]."""
        return self.distort(self.project_undistorted(points))


@dataclass(frozen=True, kw_only=True)
class OrthographicCamera(Camera):
    """u = K2 (R X)[:2] + offset with K2 = [[mx, skew], [0, my]], then radial distortion.

    Attributes:
        scale: mx, my [px/m].
        skew: [px/m].
        offset: undistorted pixel of the world origin [px], (2).
        distortion: k1, k2 about the image centre, for radii in units of half the image diagonal.
        perspective: that the model leaves out; None if the calibration's images show none.
    """

    scale: tuple[float, float]
    skew: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, float] = (0.0, 0.0)
    perspective: Perspective | None = None

    def in_frame(self, rotation: Array, translation: Array) -> "OrthographicCamera":
        """See `Camera`."""
        moved = super().in_frame(rotation, translation)
        assert isinstance(moved, OrthographicCamera)
        offset = np.asarray(self.offset) - moved.projection_matrix @ translation
        seen = self.perspective
        if seen is not None:
            along = float(moved.viewing_direction @ translation)
            seen = replace(seen, distance=seen.distance - along, depth=seen.depth + along)
        return replace(moved, offset=tuple(offset.tolist()), perspective=seen)

    @cached_property
    def projection_matrix(self) -> Array:
        """K2 R[:2]: undistorted pixels per metre of world displacement, (2, 3)."""
        k2 = np.array([[self.scale[0], self.skew], [0.0, self.scale[1]]])
        result: Array = k2 @ self.rotation[:2]
        return result

    def project_undistorted(self, points: Array) -> Array:
        """See `Camera`."""
        result: Array = points @ self.projection_matrix.T + np.asarray(self.offset)
        return result

    def projection_jacobian(self, points: Array) -> Array:
        """See `Camera`. It is the same for all points."""
        return np.broadcast_to(self.projection_matrix, (*points.shape[:-1], 2, 3))

    def sight_equations(self, undistorted: Array) -> tuple[Array, Array]:
        """See `Camera`."""
        slopes = np.broadcast_to(self.projection_matrix, (*undistorted.shape[:-1], 2, 3))
        return slopes, undistorted - np.asarray(self.offset)

    def model_error(self, points: Array, depth_sigma: Array) -> Array:
        """See `Camera`: a point farther away than where the scale is exact appears nearer to the centre."""
        if self.perspective is None:
            return super().model_error(points, depth_sigma)
        centre = np.asarray(self.perspective.centre)
        depth = points @ self.viewing_direction - self.perspective.depth
        size = np.copysign(np.hypot(depth, depth_sigma), depth)
        result: Array = (centre - self.project_undistorted(points)) * (size / self.perspective.distance)[..., None]
        return result

    def calibration_sigma(self, points: Array) -> float:
        """See `Camera`. The derivatives are by differences: the projection is nearly linear in the parameters."""
        if self.covariance is None:
            return super().calibration_sigma(points)
        base, slopes = self.project(points), []
        for parameter, step in enumerate(PARAMETER_STEPS):
            slopes.append((self._with_parameter(parameter, step).project(points) - base) / step)
        by_parameter = np.stack(slopes, axis=-1)
        variance = np.einsum("...k,kl,...l->...", by_parameter, np.asarray(self.covariance), by_parameter)
        return float(np.sqrt(variance.mean()))

    def _with_parameter(self, parameter: int, step: float) -> "OrthographicCamera":
        """The camera with one of the parameters of the covariance increased."""
        scale = 1e-3 * np.array([*self.scale, self.skew])  # [px/mm]
        values = np.concatenate([scale, self.rotation_vector, self.offset, self.distortion])
        values[parameter] += step
        scale = 1e3 * values[:3]
        return replace(
            self,
            scale=(float(scale[0]), float(scale[1])),
            skew=float(scale[2]),
            rotation_vector=tuple(values[3:6].tolist()),
            offset=tuple(values[6:8].tolist()),
            distortion=tuple(values[8:].tolist()),
        )

    def distort(self, undistorted: Array) -> Array:
        """See `Camera`."""
        centre, half_diagonal = centre_and_half_diagonal(self.image_size)
        return distort(undistorted, self.distortion, centre, half_diagonal)


@dataclass(frozen=True, kw_only=True)
class PinholeCamera(Camera):
    """OpenCV's pinhole model with skew: [u, v] = K2 [x, y] / z + c with K2 = [[fx, skew], [0, fy]].

    (x, y) / z is distorted before.

    Attributes:
        focal: focal lengths fx, fy [px].
        centre: principal point cx, cy [px].
        translation: position of the world origin in the camera frame [m], (3).
        skew: [px].
        distortion: k1, k2, p1, p2, k3.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    translation: tuple[float, float, float]
    skew: float = 0.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def in_frame(self, rotation: Array, translation: Array) -> "PinholeCamera":
        """See `Camera`."""
        moved = super().in_frame(rotation, translation)
        assert isinstance(moved, PinholeCamera)
        origin = np.asarray(self.translation) - moved.rotation @ translation
        return replace(moved, translation=tuple(origin.tolist()))

    @cached_property
    def _k2(self) -> Array:
        return np.array([[self.focal[0], self.skew], [0.0, self.focal[1]]])

    def to_camera_frame(self, points: Array) -> Array:
        """World points (..., 3) [m] in the camera frame; the last coordinate is the distance in front of the camera."""
        result: Array = points @ self.rotation.T + np.asarray(self.translation)
        return result

    def _to_pixels(self, normalised: Array) -> Array:
        """Pixels of image coordinates (x, y) / z, (..., 2)."""
        result: Array = normalised @ self._k2.T + np.asarray(self.centre)
        return result

    def project_undistorted(self, points: Array) -> Array:
        """See `Camera`."""
        local = self.to_camera_frame(points)
        return self._to_pixels(local[..., :2] / local[..., 2:])

    def projection_jacobian(self, points: Array) -> Array:
        """See `Camera`."""
        local = self.to_camera_frame(points)
        depth = local[..., 2, None, None]
        slopes = (self.rotation[:2] - local[..., :2, None] / depth * self.rotation[2]) / depth
        result: Array = self._k2 @ slopes
        return result

    def sight_equations(self, undistorted: Array) -> tuple[Array, Array]:
        """See `Camera`: the projection multiplied by the depth z."""
        offset = undistorted - np.asarray(self.centre)
        translation = np.asarray(self.translation)
        slopes = self._k2 @ self.rotation[:2] - offset[..., None] * self.rotation[2]
        return slopes, offset * translation[2] - self._k2 @ translation[:2]

    def distort(self, undistorted: Array) -> Array:
        """See `Camera`."""
        normalised = (undistorted - np.asarray(self.centre)) @ np.linalg.inv(self._k2).T
        x, y = np.moveaxis(normalised, -1, 0)
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        distorted_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return self._to_pixels(np.stack([distorted_x, distorted_y], axis=-1))


def centre_and_half_diagonal(image_size: tuple[int, int]) -> tuple[Array, float]:
    """Image centre [px], (2), and half the image diagonal [px]."""
    size = np.asarray(image_size, dtype=float)
    return (size - 1.0) / 2.0, float(np.linalg.norm(size) / 2.0)


def distort(undistorted: Array, distortion: tuple[float, float], centre: Array, half_diagonal: float) -> Array:
    """centre + (u - centre) (1 + k1 r^2 + k2 r^4) for pixels u (..., 2), with r in units of `half_diagonal`."""
    offset = undistorted - centre
    r2 = (offset**2).sum(-1, keepdims=True) / half_diagonal**2
    result: Array = centre + offset * (1.0 + distortion[0] * r2 + distortion[1] * r2**2)
    return result
