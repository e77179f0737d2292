"""The orthographic camera: from the world frame to pixels and back onto a plane."""

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


@dataclass(frozen=True)
class OrthographicCamera:
    """u = K2 (R X)[:2] + offset with K2 = [[mx, skew], [0, my]], then radial distortion.

    Attributes:
        image_size: width and height [px].
        scale: mx, my [px/m].
        skew: [px/m].
        rotation_vector: world to camera (x right, y down, z away from the camera) [rad], (3).
        offset: image of the world origin [px], (2).
        distortion: k1, k2 about the image centre, in units of half the image diagonal.
        plane: for markers this camera alone sees.
        time_offset: this camera's clock minus the rig's [s].
        residual: root mean square of the calibration [px].
        covariance: of (mx, my, skew, rx, ry, rz, u0, v0, k1, k2), scales in px/mm, (10, 10), or None.
    """

    image_size: tuple[int, int]
    scale: tuple[float, float]
    skew: float
    rotation_vector: tuple[float, float, float]
    offset: tuple[float, float]
    distortion: tuple[float, float] = (0.0, 0.0)
    plane: Plane | None = None
    time_offset: float = 0.0
    residual: float = 0.0
    covariance: tuple[tuple[float, ...], ...] | None = None

    @cached_property
    def rotation(self) -> Array:
        """World to camera, (3, 3)."""
        return Rotation.from_rotvec(self.rotation_vector).as_matrix()

    @cached_property
    def matrix(self) -> Array:
        """K2 R[:2]: undistorted pixels per metre of world displacement, (2, 3)."""
        k2 = np.array([[self.scale[0], self.skew], [0.0, self.scale[1]]])
        return k2 @ self.rotation[:2]

    @property
    def viewing_direction(self) -> Array:
        """Unit vector of the line of sight, away from the camera, world frame, (3)."""
        return self.rotation[2]

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of world points (..., 3) [m]."""
        return self.distort(points @ self.matrix.T + np.asarray(self.offset))

    def distort(self, ideal: Array) -> Array:
        """Pixels where undistorted pixels (..., 2) really appear."""
        centre, half = centre_and_half_diagonal(self.image_size)
        return distort(ideal, self.distortion, centre, half)

    def undistort(self, pixels: Array) -> Array:
        """The inverse of `distort`, by fixed-point iteration, (..., 2)."""
        centre, half = centre_and_half_diagonal(self.image_size)
        ideal = pixels.copy()
        if any(self.distortion):
            for _ in range(20):
                ideal = ideal + pixels - distort(ideal, self.distortion, centre, half)
        return ideal


def centre_and_half_diagonal(image_size: tuple[int, int]) -> tuple[Array, float]:
    """Image centre [px], (2), and half the image diagonal [px]."""
    size = np.asarray(image_size, dtype=float)
    return (size - 1.0) / 2.0, float(np.linalg.norm(size) / 2.0)


def distort(ideal: Array, distortion: tuple[float, float], centre: Array, half: float) -> Array:
    """centre + (u - centre) (1 + k1 r^2 + k2 r^4), r in units of `half`; pixels (..., 2)."""
    off = ideal - centre
    square = (off**2).sum(-1, keepdims=True) / half**2
    return centre + off * (1.0 + distortion[0] * square + distortion[1] * square**2)
