"""Camera models: from the world frame to pixels and back."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[Any]


@dataclass(frozen=True)
class Plane:
    """Where a marker lies that one camera alone sees: normal . X = offset.

    Attributes:
        normal: unit vector, world frame, (3).
        offset: [m].
        sigma: how far markers may stray from it, one standard deviation [m].
    """

    normal: tuple[float, float, float]
    offset: float
    sigma: float


@dataclass(frozen=True, kw_only=True)
class Camera:
    """What both models share: world to camera, then an ideal image, then distortion.

    Attributes:
        image_size: width and height [px].
        rotation_vector: world to camera (x right, y down, z away from the camera) [rad], (3).
        plane: for markers this camera alone sees.
        time_offset: this camera's clock minus the rig's [s].
        residual: root mean square of the calibration [px].
        covariance: of the model's ten first parameters, see `datasets/README.md`, (10, 10), or None.
    """

    image_size: tuple[int, int]
    rotation_vector: tuple[float, float, float]
    plane: Plane | None = None
    time_offset: float = 0.0
    residual: float = 0.0
    covariance: tuple[tuple[float, ...], ...] | None = None

    @cached_property
    def rotation(self) -> Array:
        """World to camera, (3, 3)."""
        return Rotation.from_rotvec(self.rotation_vector).as_matrix()

    @property
    def viewing_direction(self) -> Array:
        """Unit vector of the line of sight at the picture's centre, away from the camera, world frame, (3)."""
        return self.rotation[2]

    def ideal(self, points: Array) -> Array:
        """Undistorted pixels (..., 2) of world points (..., 3) [m]."""
        raise NotImplementedError

    def slopes(self, points: Array) -> Array:
        """Derivatives of `ideal` by the point [px/m], (..., 2, 3)."""
        raise NotImplementedError

    def distort(self, ideal: Array) -> Array:
        """Pixels (..., 2) where undistorted pixels (..., 2) really appear."""
        raise NotImplementedError

    def undistort(self, pixels: Array) -> Array:
        """The inverse of `distort`, by fixed-point iteration, (..., 2)."""
        ideal = pixels.copy()
        for _ in range(40):
            away = pixels - self.distort(ideal)
            ideal += away
            if not np.nanmax(np.abs(away), initial=0.0) > 1e-10:
                break
        return ideal

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of world points (..., 3) [m]."""
        return self.distort(self.ideal(points))


@dataclass(frozen=True, kw_only=True)
class OrthographicCamera(Camera):
    """u = K2 (R X)[:2] + offset with K2 = [[mx, skew], [0, my]], then radial distortion.

    Attributes:
        scale: mx, my [px/m].
        skew: [px/m].
        offset: image of the world origin [px], (2).
        distortion: k1, k2 about the image centre, in units of half the image diagonal.
    """

    scale: tuple[float, float]
    skew: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def matrix(self) -> Array:
        """K2 R[:2]: undistorted pixels per metre of world displacement, (2, 3)."""
        k2 = np.array([[self.scale[0], self.skew], [0.0, self.scale[1]]])
        return k2 @ self.rotation[:2]

    def ideal(self, points: Array) -> Array:
        """See `Camera`."""
        return points @ self.matrix.T + np.asarray(self.offset)

    def slopes(self, points: Array) -> Array:
        """See `Camera`; the same everywhere."""
        return np.broadcast_to(self.matrix, (*points.shape[:-1], 2, 3))

    def distort(self, ideal: Array) -> Array:
        """See `Camera`."""
        centre, half = centre_and_half_diagonal(self.image_size)
        return distort(ideal, self.distortion, centre, half)


@dataclass(frozen=True, kw_only=True)
class PinholeCamera(Camera):
    """OpenCV's model: u = f x / z + c after distortion of (x, y) / z.

    Attributes:
        focal: fx, fy [px].
        centre: cx, cy [px].
        translation: of the world origin in the camera [m], (3).
        distortion: k1, k2, p1, p2, k3.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    translation: tuple[float, float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def _in_camera(self, points: Array) -> Array:
        return points @ self.rotation.T + np.asarray(self.translation)

    def ideal(self, points: Array) -> Array:
        """See `Camera`."""
        seen = self._in_camera(points)
        return seen[..., :2] / seen[..., 2:] * np.asarray(self.focal) + np.asarray(self.centre)

    def slopes(self, points: Array) -> Array:
        """See `Camera`."""
        seen = self._in_camera(points)
        depth = seen[..., 2, None, None]
        focal = np.asarray(self.focal)[:, None]
        return focal / depth * (self.rotation[:2] - seen[..., :2, None] / depth * self.rotation[2])

    def distort(self, ideal: Array) -> Array:
        """See `Camera`."""
        x, y = np.moveaxis((ideal - np.asarray(self.centre)) / np.asarray(self.focal), -1, 0)
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=-1) * np.asarray(self.focal) + np.asarray(self.centre)


def centre_and_half_diagonal(image_size: tuple[int, int]) -> tuple[Array, float]:
    """Image centre [px], (2), and half the image diagonal [px]."""
    size = np.asarray(image_size, dtype=float)
    return (size - 1.0) / 2.0, float(np.linalg.norm(size) / 2.0)


def distort(ideal: Array, distortion: tuple[float, float], centre: Array, half: float) -> Array:
    """centre + (u - centre) (1 + k1 r^2 + k2 r^4), r in units of `half`; pixels (..., 2)."""
    off = ideal - centre
    square = (off**2).sum(-1, keepdims=True) / half**2
    return centre + off * (1.0 + distortion[0] * square + distortion[1] * square**2)
