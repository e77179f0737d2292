"""Fits of poses to markers that were measured along some directions each."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from rafl.capture.registration.rigid import MIN_MARKERS, RigidTransform, kabsch
from rafl.data.views import pose_jacobian

Array = NDArray[Any]

# A marker is an outlier if its residual exceeds the distance [m], and the factor times both its sigma and the median.
OUTLIER_DISTANCE, OUTLIER_FACTOR = 1e-3, 5.0
MARKERS_PER_OUTLIER = 4  # one outlier is allowed for so many markers, and always at least one
MAX_TRIPLES = 2000
# How far a pose may be from that of the positions where no camera tells: the turn [rad], the shift of the markers [m].
TURN_SIGMA, SHIFT_SIGMA = 0.05, 5e-3
TILT = 0.3  # to either side about both axes of an image, where the search starts again if depths are unknown [rad]
SAME_FIT = 4.0  # poses whose objectives differ by less fit equally well
MAX_STEPS, LEAST_DAMPING, MAX_DAMPING = 50, 1e-9, 1e9
STEP_TOLERANCE = 1e-9  # of the turn [rad] and the shift [m]


@dataclass(frozen=True)
class Measured:
    """Positions of K sets of markers, measured along three directions each.

    Attributes:
        position: in the recorded frame [m], (K, M, 3), NaN where missing.
        axes: unit vectors along which they were measured, the rows of (K, M, 3, 3). Where one camera saw a marker, the
            last is its line of sight.
        sigma: along the axes [m], (K, M, 3), infinite where not measured.
    """

    position: Array
    axes: Array
    sigma: Array

    @classmethod
    def of(cls, position: Array, sigma: Array, axes: Array | None = None) -> "Measured":
        """One set of markers, (M, 3), or K sets; measured along x, y and z if `axes` is None."""
        axes = np.broadcast_to(np.eye(3) if axes is None else axes, (*position.shape, 3))
        if position.ndim < 3:
            return cls(position[None], axes[None], sigma[None])
        return cls(position, axes, sigma)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which markers are not missing, (K, M)."""
        return np.isfinite(self.position[..., 0])

    @property
    def weight(self) -> Array:
        """Inverse of sigma [1/m], (K, M, 3); 0 where not measured."""
        known = self.seen[..., None] & np.isfinite(self.sigma)
        return np.where(known, 1.0 / np.where(known, self.sigma, 1.0), 0.0)

    @property
    def has_depths(self) -> bool:
        """Whether every marker that is not missing was measured along three directions."""
        return bool(np.isfinite(self.sigma[self.seen]).all())

    def select(self, sets: Any, markers: Any = slice(None)) -> "Measured":
        """Some markers of some sets."""
        return Measured(*(array[sets][:, markers] for array in (self.position, self.axes, self.sigma)))

    def gaps(self, pose: RigidTransform, layout: Array) -> Array:
        """Positions minus layout positions (M, 3) under K poses or one, along the axes [m], (K, M, 3).

        They are 0 where not measured.
        """
        expected = (layout - pose.translation[..., None, :]) @ pose.rotation
        gap = (self.axes @ (self.position - expected)[..., None])[..., 0]
        return np.where(self.weight > 0.0, gap, 0.0)

    def distances(self, pose: RigidTransform, layout: Array) -> Array:
        """Distances of the markers from their layout positions, as far as measured [m], (K, M); NaN where missing."""
        return np.where(self.seen, np.linalg.norm(self.gaps(pose, layout), axis=2), np.nan)


@dataclass(frozen=True)
class RigidFit:
    """Fit of one pose to the layout.

    Attributes:
        transform: recorded frame to specimen frame.
        covariance: of a rotation vector and a translation applied after `transform` [rad, m], (6, 6).
        residual: distance of each marker from its layout position, as far as measured [m], (M); NaN where missing.
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


def fit_pose(measured: Measured, layout: Array) -> RigidFit:
    """Weighted fit of one pose, robust against a few outliers.

    Every triple of markers gives a candidate pose. The candidate with the smallest median distance (least median of
    squares) shows which markers agree; the weighted fit uses those.

    Args:
        measured: one set of markers, at least three, not collinear.
        layout: layout positions [m], (M, 3).
    """
    seen = np.flatnonzero(measured.seen[0])
    used = seen
    if len(seen) > MIN_MARKERS:
        own, y = measured.select([0], seen), layout[seen]
        allowed = np.maximum(OUTLIER_DISTANCE, OUTLIER_FACTOR * _length_sigma(own)[0])
        distance = _candidate_distances(own, y)
        distance = distance[np.argmin(np.median(distance / allowed, axis=1))]
        for _ in range(3):  # the first pass compares with the best candidate, the others with all markers that agree
            agrees = distance <= np.maximum(allowed, OUTLIER_FACTOR * np.median(distance))
            if (~agrees).sum() > max(1, len(seen) // MARKERS_PER_OUTLIER):
                used = seen  # so many disagree that the layout is wrong, not a few markers
                break
            used = seen[agrees]
            distance = own.distances(_fit(measured.select([0], used), layout[used]).pose, y)[0]
    found = _fit(measured.select([0], used), layout[used])
    outliers = np.zeros(len(layout), dtype=bool)
    outliers[np.setdiff1d(seen, used)] = True
    freedom = max(int((measured.weight[0, used] > 0.0).sum()) - 6, 1)
    covariance = max(float(found.objective[0]) / freedom, 1.0) * found.covariance[0]
    pose = RigidTransform(found.pose.rotation[0], found.pose.translation[0])
    return RigidFit(pose, covariance, measured.distances(found.pose, layout)[0], outliers)


def _length_sigma(measured: Measured) -> Array:
    """Standard deviations of the distances [m], (K, M)."""
    return np.asarray(np.linalg.norm(np.where(measured.weight > 0.0, measured.sigma, 0.0), axis=2))


def _candidate_distances(measured: Measured, layout: Array) -> Array:
    """Distances (C, M) of one set of markers from their layout positions under the poses of C candidates.

    Candidates are the poses of triples and, where depths are unknown, that of all markers: a triple hardly tells them.
    """
    triples = np.array(list(itertools.combinations(range(len(layout)), 3)))
    if len(triples) > MAX_TRIPLES:
        triples = triples[np.random.default_rng(0).choice(len(triples), MAX_TRIPLES, replace=False)]
    chosen = np.zeros((len(triples), len(layout)), dtype=bool)
    np.put_along_axis(chosen, triples, True, axis=1)
    every = measured.select(np.zeros(len(triples), dtype=int))
    pose = kabsch(every.position, layout, chosen.astype(float))
    if measured.has_depths:
        return every.distances(pose, layout)
    part = Measured(measured.position[0, triples], measured.axes[0, triples], measured.sigma[0, triples])
    by_triple = every.distances(_search(part, layout[triples], pose, pose).pose, layout)
    return np.concatenate([by_triple, measured.distances(_fit(measured, layout).pose, layout)])


def fit_poses(measured: Measured, layout: Array) -> tuple[RigidTransform, Array, Array]:
    """Poses of successive frames, their covariances, and the distances of the markers from their layout positions.

    Frames with fewer than three markers are interpolated between their neighbours. Of poses that fit equally well,
    which differ in a tilt that one camera hardly sees, a frame gets the one nearest to the frame before.

    Args:
        measured: markers in T frames, of which at least one has three.
        layout: layout positions [m], (M, 3).

    Returns:
        Transforms of T frames, covariances as in `RigidFit`, (T, 6, 6), and distances [m], (T, M), NaN where missing.
    """
    fitted = np.flatnonzero(measured.seen.sum(axis=1) >= MIN_MARKERS)
    found = _fit(measured.select(fitted), layout)
    poses, covariance = found.pose, found.covariance
    if len(fitted) < len(measured.position):
        frames = np.clip(np.arange(len(measured.position)), fitted[0], fitted[-1])
        after = np.minimum(np.searchsorted(fitted, frames), len(fitted) - 1)
        before = np.maximum(after - 1, 0)
        share = (frames - fitted[before]) / np.maximum(fitted[after] - fitted[before], 1)
        share = share[:, None]
        translation = (1.0 - share) * poses.translation[before] + share * poses.translation[after]
        covariance = (1.0 - share[..., None]) * covariance[before] + share[..., None] * covariance[after]
        turns = Rotation.from_matrix(poses.rotation)
        rotation = Slerp(fitted, turns)(frames).as_matrix() if len(fitted) > 1 else poses.rotation[before]
        poses = RigidTransform(rotation, translation)
    return poses, covariance, measured.distances(poses, layout)


@dataclass(frozen=True)
class _Fits:
    """K fits, one of each set of markers.

    Attributes:
        pose: K transforms.
        covariance: as in `RigidFit`, (K, 6, 6).
        objective: sum of the squared gaps in units of sigma, and of what was added for the unseen directions, (K).
    """

    pose: RigidTransform
    covariance: Array
    objective: Array


def _fit(measured: Measured, layout: Array) -> _Fits:
    """Weighted fits of successive poses to the layout along the directions that were measured.

    Where cameras left depths unknown, the squared gaps in units of sigma are the reprojection error. What no camera
    sees, as the distance along the only line of sight, stays near the pose that fits the positions, within TURN_SIGMA
    and SHIFT_SIGMA. A flat layout looks alike tilted to either side, so the search starts from both; if another pose is
    nearly as probable, their difference adds to the covariance.
    """
    near = kabsch(measured.position, layout, (measured.weight**2).mean(-1))
    if measured.has_depths:
        return _search(measured, layout, near, near)
    sight = np.where(measured.weight[..., 2:] > 0.0, 0.0, measured.axes[:, :, 2]).sum(axis=1)
    across = near.rotation @ np.linalg.svd(sight[:, None])[2][:, 1:].swapaxes(1, 2)  # axes of an image, (K, 3, 2)
    middle, fits = layout.mean(axis=0), []
    for tilt in np.array([(0.0, 0.0), *itertools.product((TILT, -TILT), repeat=2)]):
        centred = RigidTransform(near.rotation, near.translation - middle)
        tilted = centred.followed_by(np.concatenate([across @ tilt, np.zeros_like(sight)], axis=1))
        fits.append(_search(measured, layout, RigidTransform(tilted.rotation, tilted.translation + middle), near))
    return _choose(fits, near)


def _choose(fits: list[_Fits], near: RigidTransform) -> _Fits:
    """Of several fits of successive frames one for each frame: a best one, of equal ones the nearest to that before.

    Before the first frame it is the one of `near`.
    """
    objective = np.stack([fit.objective for fit in fits])  # (F, K)
    rotation = np.stack([fit.pose.rotation for fit in fits])
    chosen, before = np.zeros(objective.shape[1], dtype=int), near.rotation[0]
    for k, own in enumerate(objective.T):
        turn = np.linalg.norm(rotation[:, k] - before, axis=(1, 2))
        chosen[k] = np.where(own < own.min() + SAME_FIT, turn, np.inf).argmin()
        before = rotation[chosen[k], k]
    frames = np.arange(len(chosen))
    translation = np.stack([fit.pose.translation for fit in fits])
    pose = RigidTransform(rotation[chosen, frames], translation[chosen, frames])
    covariance = np.stack([fit.covariance for fit in fits])[chosen, frames]
    # Two possible poses have the variance of their difference, times the probability of the other one.
    steps = np.stack([fit.pose.step_from(pose) for fit in fits])
    odds = np.exp(np.minimum(0.5 * (objective[chosen, frames] - objective), 0.0))
    probability = odds / (1.0 + odds)
    other = (probability * np.linalg.norm(steps[..., :3], axis=2) ** 2).argmax(axis=0)
    step = steps[other, frames]
    covariance = covariance + probability[other, frames, None, None] * step[:, :, None] * step[:, None, :]
    return _Fits(pose, covariance, objective[chosen, frames])


def _search(measured: Measured, layout: Array, start: RigidTransform, near: RigidTransform) -> _Fits:
    """Levenberg-Marquardt from K poses `start`, with a prior around the poses `near`.

    layout: layout positions [m], (M, 3), or of each set, (K, M, 3).
    """
    weight, pose = measured.weight, start
    middle = (np.any(weight > 0.0, axis=2)[..., None] * layout).sum(axis=1) / measured.seen.sum(axis=1)[:, None]
    by_pose = pose_jacobian(layout)

    def residuals(pose: RigidTransform) -> Array:
        step = pose.step_from(near)
        moved = np.cross(step[:, :3], middle) + step[:, 3:]
        prior = np.concatenate([step[:, :3] / TURN_SIGMA, moved / SHIFT_SIGMA], axis=1)
        return np.concatenate([(weight * measured.gaps(pose, layout)).reshape(len(weight), -1), prior], axis=1)

    def jacobian(pose: RigidTransform) -> Array:
        turned = measured.axes @ pose.rotation.swapaxes(1, 2)[:, None]
        by_step = (weight[..., None] * (turned @ by_pose)).reshape(len(weight), -1, 6)
        turn = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1) / TURN_SIGMA
        shift = pose_jacobian(middle) / SHIFT_SIGMA
        return np.concatenate([by_step, np.broadcast_to(turn, shift.shape), shift], axis=1)

    current = residuals(pose)
    objective, damping = (current**2).sum(axis=1), np.full(len(weight), 1e-3)
    for _ in range(MAX_STEPS):
        slope = jacobian(pose)
        hessian = slope.swapaxes(1, 2) @ slope
        diagonal = np.einsum("kii->ki", hessian)[..., None] * np.eye(6)
        gradient = slope.swapaxes(1, 2) @ current[..., None]
        step = -np.linalg.solve(hessian + damping[:, None, None] * diagonal, gradient)[..., 0]
        trial = pose.followed_by(step)
        tried = residuals(trial)
        better = (tried**2).sum(axis=1) < objective
        pose = RigidTransform(
            np.where(better[:, None, None], trial.rotation, pose.rotation),
            np.where(better[:, None], trial.translation, pose.translation),
        )
        current = np.where(better[:, None], tried, current)
        objective = (current**2).sum(axis=1)
        damping = np.clip(np.where(better, 0.2, 10.0) * damping, LEAST_DAMPING, MAX_DAMPING)
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    slope = jacobian(pose)
    return _Fits(pose, _inverse(slope.swapaxes(1, 2) @ slope), objective)


def _inverse(hessian: Array) -> Array:
    """Inverses of positive definite matrices (K, 6, 6) whose rows differ in their units."""
    scale = 1.0 / np.sqrt(np.einsum("kii->ki", hessian))
    scaled = scale[:, :, None] * hessian * scale[:, None, :]
    return np.asarray(scale[:, :, None] * np.linalg.inv(scaled) * scale[:, None, :])
