"""Rigid registration of recorded markers to the specimen frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rafl.data.views import pose_jacobian

Array = NDArray[Any]

MIN_MARKERS = 3


@dataclass(frozen=True)
class RigidTransform:
    """x -> R x + t.

    Attributes:
        rotation: R, (..., 3, 3).
        translation: t [m], (..., 3).
    """

    rotation: Array
    translation: Array

    def apply(self, points: Array) -> Array:
        """Transform points (..., M, 3)."""
        result: Array = points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]
        return result

    def followed_by(self, step: Array) -> "RigidTransform":
        """This transform followed by a rotation vector [rad] and a translation [m]: `step` (..., 6)."""
        rotation = Rotation.from_rotvec(step[..., :3].reshape(-1, 3)).as_matrix().reshape(*step.shape[:-1], 3, 3)
        turned = (rotation @ self.translation[..., None])[..., 0]
        return RigidTransform(rotation @ self.rotation, turned + step[..., 3:])

    def step_from(self, other: "RigidTransform") -> Array:
        """Rotation vector [rad] and translation [m] of the step that leads from another transform to this, (..., 6)."""
        rotation = self.rotation @ np.swapaxes(other.rotation, -1, -2)
        vector = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(*rotation.shape[:-1])
        turned = (rotation @ other.translation[..., None])[..., 0]
        return np.concatenate([vector, self.translation - turned], axis=-1)

    def select_frames(self, chosen: Any) -> "RigidTransform":
        """The transforms of some frames; itself if one transform holds for all frames."""
        if self.rotation.ndim != 3:
            return self
        return RigidTransform(self.rotation[chosen], self.translation[chosen])

    def at_times(self, time: Array, requested: Array) -> "RigidTransform":
        """Of transforms at times (T) [s] those at other times (S), by cubic splines."""
        rotation = RotationSpline(time, Rotation.from_matrix(self.rotation))(requested).as_matrix()
        return RigidTransform(rotation, CubicSpline(time, self.translation)(requested))

    def rotate_sigma(self, sigma: Array) -> Array:
        """Sigmas (..., M, 3) along the rotated axes; correlations between axes are ignored."""
        return np.asarray(np.sqrt(sigma**2 @ np.swapaxes(self.rotation, -1, -2) ** 2))


def pose_sigma(covariance: Array, points: Array) -> Array:
    """Sigmas [m] of transformed points (..., 3) [m] that follow from the covariance (..., 6, 6) of the transform."""
    by_pose = pose_jacobian(points)
    return np.asarray(np.sqrt(np.einsum("...ij,...jk,...ik->...i", by_pose, covariance, by_pose)))


IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def kabsch(source: Array, target: Array, weight: Array | None = None) -> RigidTransform:
    """Least-squares proper rotation and translation from source to target points (Kabsch).

    Args:
        source: (..., M, 3); at least three points with positive weight, not collinear.
        target: (M, 3).
        weight: (..., M); equal if None. Points of weight 0 may be NaN.

    Returns:
        One transform for each leading index.
    """
    weight = np.ones(source.shape[:-1]) if weight is None else weight
    share = (weight / weight.sum(-1, keepdims=True))[..., None]
    source = np.where(share > 0, source, 0.0)
    source_mean, target_mean = (share * source).sum(-2, keepdims=True), (share * target).sum(-2)
    moment = np.swapaxes(share * (source - source_mean), -1, -2) @ (target - target_mean[..., None, :])
    u, _, vt = np.linalg.svd(moment)
    flip = np.ones(moment.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    rotation = np.swapaxes(vt, -1, -2) @ (flip[..., None] * np.swapaxes(u, -1, -2))
    return RigidTransform(rotation, target_mean - (rotation @ np.swapaxes(source_mean, -1, -2))[..., 0])
