"""Rigid registration of recorded markers to the specimen frame."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

Array = NDArray[Any]

MIN_MARKERS = 3
# A marker is an outlier if its residual exceeds the distance [m], and the factor times both its sigma and the median.
OUTLIER_DISTANCE, OUTLIER_FACTOR = 1e-3, 5.0
MARKERS_PER_OUTLIER = 4  # one outlier is allowed for so many markers, and always at least one
MAX_TRIPLES = 2000


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
        """This transform followed by a rotation vector [rad] and a translation [m]: `step` (6)."""
        rotation = Rotation.from_rotvec(step[:3]).as_matrix()
        return RigidTransform(rotation @ self.rotation, rotation @ self.translation + step[3:])

    def select_frames(self, chosen: slice) -> "RigidTransform":
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


def pose_jacobian(points: Array) -> Array:
    """Derivatives of transformed points (..., 3) by a rotation vector and a translation afterwards, (..., 3, 6)."""
    rotation = np.cross(np.eye(3), points[..., None, :]).swapaxes(-1, -2)
    return np.concatenate([rotation, np.broadcast_to(np.eye(3), rotation.shape)], axis=-1)


def pose_sigma(covariance: Array, points: Array) -> Array:
    """Sigmas [m] of transformed points (..., 3) [m] that follow from the covariance (6, 6) of the transform."""
    by_pose = pose_jacobian(points)
    return np.asarray(np.sqrt(np.einsum("...ij,jk,...ik->...i", by_pose, covariance, by_pose)))


IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class RigidFit:
    """Fit of one pose to the layout.

    Attributes:
        transform: recorded frame to specimen frame.
        covariance: of a rotation vector and a translation applied after `transform` [rad, m], (6, 6).
        residual: distance of each marker from its layout position [m], (M); NaN where missing.
        outliers: markers that contradict the others and are left out of the fit, (M).
    """

    transform: RigidTransform
    covariance: Array
    residual: Array
    outliers: NDArray[np.bool_]

    @property
    def rms_residual(self) -> float:
        """Root mean square residual without the outliers [m]."""
        return float(np.sqrt(np.nanmean(self.residual[~self.outliers] ** 2)))


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


def fit_pose(points: Array, layout: Array, sigma: Array) -> RigidFit:
    """Weighted fit of one pose, robust against a few outliers.

    Every triple of markers gives a candidate pose. The candidate with the smallest median distance (least median of
    squares) shows which markers agree; the weighted fit uses those.

    Args:
        points: recorded positions [m], (M, 3), NaN where missing; at least three, not collinear.
        layout: layout positions [m], (M, 3).
        sigma: of the recorded positions along the recorded axes [m], (M, 3).
    """
    measured = np.flatnonzero(np.isfinite(points[:, 0]))
    used = measured
    if len(measured) > MIN_MARKERS:
        x, y = points[measured], layout[measured]
        allowed = np.maximum(OUTLIER_DISTANCE, OUTLIER_FACTOR * np.linalg.norm(sigma[measured], axis=1))
        distance = _distances_by_triple(x, y)
        distance = distance[np.argmin(np.median(distance / allowed, axis=1))]
        for _ in range(3):  # the first pass compares with the best triple, the others with all markers that agree
            agrees = distance <= np.maximum(allowed, OUTLIER_FACTOR * np.median(distance))
            if (~agrees).sum() > max(1, len(measured) // MARKERS_PER_OUTLIER):
                used = measured  # so many disagree that the layout is wrong, not a few markers
                break
            used = measured[agrees]
            distance = _distances(_weighted_least_squares(points, layout, sigma, used)[0], x, y)
    transform, covariance = _weighted_least_squares(points, layout, sigma, used)
    outliers = np.zeros(len(points), dtype=bool)
    outliers[np.setdiff1d(measured, used)] = True
    return RigidFit(transform, covariance, _distances(transform, points, layout), outliers)


def _distances_by_triple(points: Array, layout: Array) -> Array:
    """Distances (K, M) of all points from their layout positions under the pose of each of K triples."""
    triples = np.array(list(itertools.combinations(range(len(points)), 3)))
    if len(triples) > MAX_TRIPLES:
        triples = triples[np.random.default_rng(0).choice(len(triples), MAX_TRIPLES, replace=False)]
    chosen = np.zeros((len(triples), len(points)))
    np.put_along_axis(chosen, triples, 1.0, axis=1)
    poses = kabsch(np.broadcast_to(points, (len(triples), *points.shape)), layout, chosen)
    return np.asarray(np.linalg.norm(poses.apply(points) - layout, axis=2))


def _distances(transform: RigidTransform, points: Array, layout: Array) -> Array:
    return np.asarray(np.linalg.norm(transform.apply(points) - layout, axis=1))


def _weighted_least_squares(
    points: Array, layout: Array, sigma: Array, used: NDArray[np.int64]
) -> tuple[RigidTransform, Array]:
    """Pose from the `used` points, every coordinate weighted by its sigma, and the covariance (6, 6)."""
    x, y, s = points[used], layout[used], sigma[used]
    start = kabsch(x, y, 1.0 / (s**2).mean(1))

    def residuals(step: Array) -> Array:
        pose = start.followed_by(step)
        scaled: Array = (x - (y - pose.translation) @ pose.rotation) / s
        return scaled.ravel()

    found = least_squares(residuals, np.zeros(6), x_scale="jac")
    chi = max(float((found.fun**2).sum()) / max(len(found.fun) - 6, 1), 1.0)
    return start.followed_by(found.x), chi * np.linalg.pinv(found.jac.T @ found.jac)


def fit_clamp_poses(points: Array, layout: Array, sigma: Array) -> tuple[RigidTransform, Array]:
    """Pose of every frame from the clamp markers, and their distances from their layout positions.

    Frames with fewer than three clamp markers are interpolated between their neighbours.

    Args:
        points: recorded positions [m], (T, M, 3), NaN where missing; at least one frame has three.
        layout: layout positions [m], (M, 3).
        sigma: [m], (T, M, 3).

    Returns:
        Transforms of T frames, and distances [m], (T, M), NaN where missing.
    """
    measured = np.isfinite(points[..., 0])
    weight = np.where(measured, 1.0 / (np.where(measured[..., None], sigma, 1.0) ** 2).mean(-1), 0.0)
    fitted = np.flatnonzero(measured.sum(axis=1) >= MIN_MARKERS)
    poses = kabsch(points[fitted], layout, weight[fitted])
    if len(fitted) < len(points):
        frames = np.clip(np.arange(len(points)), fitted[0], fitted[-1])
        translation = np.stack([np.interp(frames, fitted, poses.translation[:, k]) for k in range(3)], axis=1)
        turns = Rotation.from_matrix(poses.rotation)
        if len(fitted) > 1:
            rotation = Slerp(fitted, turns)(frames).as_matrix()
        else:
            rotation = poses.rotation[np.zeros_like(frames)]
        poses = RigidTransform(rotation, translation)
    return poses, np.linalg.norm(poses.apply(points) - layout, axis=2)
