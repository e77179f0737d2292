"""Bundle adjustment of cameras and board poses.

Every camera maps a world point X to p = R X and u = centre + (K2 p_xy + offset) / (1 + inverse_distance p_z).
Distortion about the centre follows. An inverse distance of 0 gives the orthographic camera, otherwise a pinhole at
1 / inverse_distance. The distortion of a pinhole is that of OpenCV, for lengths in units of half the image diagonal; an
orthographic camera has its radial part k1, k2 only. The centre is the image centre, moved for a pinhole if asked for.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import centre_and_half_diagonal

Array = NDArray[Any]

# mx, my, skew [px/mm], rotation vector, offset from the centre [px], k1, k2, inverse distance [1/m], shift of the
# centre [px], p1, p2, k3
CAMERA_PARAMETERS = 16
INVERSE_DISTANCE = 10  # index of that camera parameter
LENS = slice(11, 16)  # indices of the shift of the centre, p1, p2 and k3
POSE_PARAMETERS = 6  # rotation vector, position [m]
MAX_ITERATIONS = 80
HUBER_THRESHOLD_PX = 0.5  # the cost of a larger residual grows linearly


@dataclass(frozen=True)
class Observations:
    """Observed board points, O in all. The pose of a board is known, free, or moved along a line from another pose.

    Attributes:
        points: board frame [m], (O, 2).
        pixels: (O, 2).
        camera: index of the camera, (O).
        pose: index of the board pose, or of the pose that the board was moved from, (O).
        move: index of the move, -1 for none, (O).
        directions: directions of the moves, world frame, (D, 3).
        known: whether a pose is known and stays fixed, (B).
        sizes: image sizes [px], (C, 2).
    """

    points: Array
    pixels: Array
    camera: NDArray[np.int64]
    pose: NDArray[np.int64]
    move: NDArray[np.int64]
    directions: Array
    known: NDArray[np.bool_]
    sizes: Array


@dataclass(frozen=True)
class Unknowns:
    """Camera parameters (C, 16), board poses (B, 6) and distances of the moves (D) [m]."""

    cameras: Array
    poses: Array
    distances: Array


@dataclass(frozen=True)
class Adjustment:
    """Result of a bundle adjustment.

    Attributes:
        unknowns: the solution.
        residual: residual of every observation [px], (O, 2).
        covariance: covariance of each camera's parameters, (C, 16, 16).
    """

    unknowns: Unknowns
    residual: Array
    covariance: Array

    @property
    def robust_rms(self) -> float:
        """Root mean square residual of a coordinate [px]; outliers count linearly (Huber)."""
        distance = np.linalg.norm(self.residual, axis=1)
        linear = 2.0 * HUBER_THRESHOLD_PX * distance - HUBER_THRESHOLD_PX**2
        square = np.where(distance < HUBER_THRESHOLD_PX, distance**2, linear)
        return float(np.sqrt(square.mean() / 2.0))


def project_observations(observations: Observations, unknowns: Unknowns) -> Array:
    """Predicted pixels of all observations, (O, 2)."""
    rotations = Rotation.from_rotvec(unknowns.poses[:, :3]).as_matrix()
    world = (
        np.einsum("oij,oj->oi", rotations[observations.pose][:, :, :2], observations.points)
        + unknowns.poses[observations.pose, 3:]
    )
    if len(unknowns.distances):
        moved = unknowns.distances[observations.move, None] * observations.directions[observations.move]
        world = world + np.where(observations.move[:, None] >= 0, moved, 0.0)
    cameras = unknowns.cameras
    rotation = Rotation.from_rotvec(cameras[:, 3:6]).as_matrix()[observations.camera]
    own = cameras[observations.camera]
    local = np.einsum("oij,oj->oi", rotation, world)
    u = 1e3 * (own[:, 0] * local[:, 0] + own[:, 2] * local[:, 1]) + own[:, 6]
    v = 1e3 * own[:, 1] * local[:, 1] + own[:, 7]
    offset = np.stack([u, v], axis=1) / (1.0 + own[:, INVERSE_DISTANCE] * local[:, 2])[:, None]
    sizes = [centre_and_half_diagonal(tuple(size)) for size in observations.sizes]
    centre = np.array([c for c, _ in sizes])[observations.camera]
    half_diagonal = np.array([h for _, h in sizes])[observations.camera]
    # OpenCV distorts lengths in units of the focal lengths, the orthographic model those in pixels.
    aspect = np.where(own[:, INVERSE_DISTANCE, None] != 0.0, own[:, :2] / own[:, :2].mean(axis=1)[:, None], 1.0)
    x, y = (offset / (aspect * half_diagonal[:, None])).T
    p1, p2, k3 = own[:, 13], own[:, 14], own[:, 15]
    r2 = x**2 + y**2
    radial = (1.0 + own[:, 8] * r2 + own[:, 9] * r2**2 + k3 * r2**3)[:, None]
    tangential = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y], axis=1)
    pixels: Array = centre + own[:, 11:13] + offset * radial + aspect * half_diagonal[:, None] * tangential
    return pixels


def adjust_bundle(
    observations: Observations,
    start: Unknowns,
    *,
    perspective: bool = False,
    lens: bool = False,
    fixed_cameras: bool = False,
) -> Adjustment:
    """Robust least squares over all cameras, free board poses and move distances.

    Args:
        observations: the observed points.
        start: initial guess near the solution.
        perspective: whether to solve for the inverse distances of the cameras; otherwise they keep their values.
        lens: whether to solve for the shift of the centre, p1, p2 and k3; otherwise they keep their values.
        fixed_cameras: whether to keep the cameras and solve for the poses only.
    """
    own = np.ones(CAMERA_PARAMETERS, dtype=bool)
    own[INVERSE_DISTANCE] = perspective
    own[2] = not perspective  # the pinhole model has no skew
    own[LENS] = lens
    if fixed_cameras:
        own[:] = False
    free = ~observations.known
    shape = (len(start.cameras), len(start.poses))
    counts = (shape[0] * own.sum(), free.sum() * POSE_PARAMETERS, len(start.distances))
    # Index of each parameter in the vector x; -1 for a fixed parameter.
    camera_slots = np.full((shape[0], CAMERA_PARAMETERS), -1)
    camera_slots[:, own] = np.arange(counts[0]).reshape(shape[0], -1)
    pose_slots = np.full((shape[1], POSE_PARAMETERS), -1)
    pose_slots[free] = counts[0] + np.arange(counts[1]).reshape(-1, POSE_PARAMETERS)

    def unpack(x: Array) -> Unknowns:
        cameras, poses = start.cameras.copy(), start.poses.copy()
        cameras[:, own] = x[: counts[0]].reshape(shape[0], -1)
        poses[free] = x[counts[0] : counts[0] + counts[1]].reshape(-1, POSE_PARAMETERS)
        return Unknowns(cameras, poses, x[counts[0] + counts[1] :])

    def residuals(x: Array) -> Array:
        return (project_observations(observations, unpack(x)) - observations.pixels).ravel()

    def jacobian_at(x: Array) -> Array:
        # An observation depends on one camera and one pose: a parameter of all cameras is varied at once.
        here = unpack(x)
        jacobian = np.zeros((2 * len(observations.points), len(x)))
        rows = np.arange(len(observations.points))
        for number in np.flatnonzero(own).tolist():
            step = _difference_step(here.cameras[:, number], 1e-3 if number == INVERSE_DISTANCE else 1e-2)
            varied = [here.cameras.copy(), here.cameras.copy()]
            for sign, cameras in zip((1, -1), varied, strict=True):
                cameras[:, number] += sign * step
            up, down = (project_observations(observations, replace(here, cameras=cameras)) for cameras in varied)
            _fill_columns(jacobian, rows, camera_slots[observations.camera, number], (up - down) / (2 * step))
        for number in range(POSE_PARAMETERS):
            step = 1e-6
            varied = [here.poses.copy(), here.poses.copy()]
            for sign, poses in zip((1, -1), varied, strict=True):
                poses[:, number] += sign * step
            up, down = (project_observations(observations, replace(here, poses=poses)) for poses in varied)
            _fill_columns(jacobian, rows, pose_slots[observations.pose, number], (up - down) / (2 * step))
        if len(here.distances):
            step = 1e-6
            up, down = (
                project_observations(observations, replace(here, distances=here.distances + sign * step))
                for sign in (1, -1)
            )
            slots = np.where(observations.move >= 0, counts[0] + counts[1] + observations.move, -1)
            _fill_columns(jacobian, rows, slots, (up - down) / (2 * step))
        return jacobian

    x0 = np.concatenate([start.cameras[:, own].ravel(), start.poses[free].ravel(), start.distances])
    x = _levenberg_marquardt(residuals, jacobian_at, x0)
    residual = residuals(x).reshape(-1, 2)
    jacobian = jacobian_at(x)
    inliers = np.repeat(np.linalg.norm(residual, axis=1) < 4.0 * HUBER_THRESHOLD_PX, 2)
    # Depths that no camera observes form the null space.
    rank = np.linalg.matrix_rank(jacobian[inliers] / (np.linalg.norm(jacobian[inliers], axis=0) + 1e-12), tol=1e-7)
    degrees_of_freedom = max(int(inliers.sum()) - int(rank), 1)
    scale = np.linalg.norm(jacobian[inliers], axis=0) + 1e-12
    scaled = jacobian[inliers] / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12) / np.outer(scale, scale)
    full = (residual.ravel()[inliers] ** 2).sum() / degrees_of_freedom * inverse
    covariance = np.zeros((shape[0], CAMERA_PARAMETERS, CAMERA_PARAMETERS))
    for camera in range(shape[0]):
        slots = camera_slots[camera, own]
        covariance[camera][np.ix_(own, own)] = full[np.ix_(slots, slots)]
    return Adjustment(unpack(x), residual, covariance)


def move_points(observations: Observations, found: Adjustment, names: NDArray[np.int64]) -> Observations:
    """The observations with the points of the board where the residuals of an adjustment put them.

    A printed board is not exact. The moves have no affine part: the position, size and shape of the whole board stay.

    Args:
        observations: the observed points.
        found: adjustment with these points.
        names: number of each observed point on the board, (O).
    """
    step = 1e-6
    derivatives = []
    for direction in step * np.eye(2):
        moved = (replace(observations, points=observations.points + sign * direction) for sign in (1, -1))
        up, down = (project_observations(one, found.unknowns) for one in moved)
        derivatives.append((up - down) / (2 * step))
    jacobian = np.stack(derivatives, axis=2)
    weight = np.minimum(1.0, HUBER_THRESHOLD_PX / np.maximum(np.linalg.norm(found.residual, axis=1), 1e-12))
    normal, right = np.zeros((names.max() + 1, 2, 2)), np.zeros((names.max() + 1, 2))
    np.add.at(normal, names, np.einsum("o,oki,okj->oij", weight, jacobian, jacobian))
    np.add.at(right, names, -np.einsum("o,oki,ok->oi", weight, jacobian, found.residual))
    shifts = np.linalg.solve(normal, right[..., None])[..., 0]
    points = np.zeros_like(shifts)
    points[names] = observations.points
    affine = np.column_stack([points, np.ones(len(points))])
    shifts -= affine @ np.linalg.lstsq(affine, shifts, rcond=None)[0]
    return replace(observations, points=observations.points + shifts[names])


def _levenberg_marquardt(residuals: Callable[[Array], Array], jacobian_at: Callable[[Array], Array], x: Array) -> Array:
    """Minimise the Huber cost of the residuals by iteratively reweighted Levenberg-Marquardt steps."""

    def weights_and_cost(values: Array) -> tuple[Array, float]:
        distance = np.linalg.norm(values.reshape(-1, 2), axis=1)
        weight = np.minimum(1.0, HUBER_THRESHOLD_PX / np.maximum(distance, 1e-12))
        linear = 2.0 * HUBER_THRESHOLD_PX * distance - HUBER_THRESHOLD_PX**2
        cost = np.where(distance < HUBER_THRESHOLD_PX, distance**2, linear).sum()
        return np.repeat(weight, 2), float(cost)

    residual = residuals(x)
    weight, cost = weights_and_cost(residual)
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        jacobian = jacobian_at(x)
        scale = np.sqrt((weight[:, None] * jacobian**2).sum(0)) + 1e-9
        scaled = jacobian / scale
        normal = scaled.T @ (weight[:, None] * scaled)
        right = -scaled.T @ (weight * residual)
        decrease = 0.0
        for _ in range(12):
            step = np.linalg.solve(normal + (damping + 1e-10) * np.eye(len(x)), right) / scale
            trial = residuals(x + step)
            new_weight, new_cost = weights_and_cost(trial)
            if new_cost <= cost:
                decrease = cost - new_cost
                x, residual, weight, cost = x + step, trial, new_weight, new_cost
                damping = max(0.1 * damping, 1e-10)
                break
            damping *= 10.0
        if decrease <= 1e-8 * cost:
            break
    return x


def _difference_step(values: Array, minimum: float) -> float:
    """Step of a central difference in a parameter with these values."""
    return 1e-6 * max(float(np.abs(values).max()), minimum)


def _fill_columns(jacobian: Array, rows: NDArray[np.int64], slots: NDArray[np.int64], derivative: Array) -> None:
    """Write the derivatives (O, 2) of the observations into the columns `slots`; -1 for none."""
    used = slots >= 0
    jacobian[2 * rows[used], slots[used]] = derivative[used, 0]
    jacobian[2 * rows[used] + 1, slots[used]] = derivative[used, 1]
