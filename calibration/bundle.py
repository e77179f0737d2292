"""Bundle adjustment of boards seen by cameras.

Every camera maps world points X by p = R X to u = centre + (K2 p_xy + offset) / (1 + nearness p_z), then
distorts. With nearness 0 this is the orthographic camera; else a pinhole at the distance 1 / nearness.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.camera import centre_and_half_diagonal
from scipy.spatial.transform import Rotation

Array = NDArray[Any]

CAMERA = 11  # mx, my, skew [px/mm], rotation vector, offset from the picture's centre [px], k1, k2, nearness [1/m]
NEARNESS = 10
BOARD = 6  # rotation vector, position [m]
STEPS = 80  # of descent, at most
OUTLIER = 0.5  # px: residuals beyond it count linearly


@dataclass(frozen=True)
class Scene:
    """Observations, O in all, of boards that stand fixed, free, or moved along a line from another.

    Attributes:
        points: on the board [m], (O, 2).
        pixels: (O, 2).
        camera: of each observation, (O).
        board: that it belongs to, or that its board was moved from, (O).
        move: index of the distance its board was moved by, -1 for none, (O).
        directions: of the moves, world frame, (D, 3).
        known: boards whose pose is not to be changed, (B).
        sizes: of the pictures, (C, 2).
    """

    points: Array
    pixels: Array
    camera: NDArray[np.int64]
    board: NDArray[np.int64]
    move: NDArray[np.int64]
    directions: Array
    known: NDArray[np.bool_]
    sizes: Array


@dataclass(frozen=True)
class Unknowns:
    """Cameras (C, 11), boards (B, 6) and distances of moves (D) [m]."""

    cameras: Array
    boards: Array
    distances: Array


@dataclass(frozen=True)
class Adjusted:
    """What a bundle adjustment found.

    Attributes:
        unknowns: the solution.
        residual: of every observation [px], (O, 2).
        covariance: of each camera's eleven parameters, (C, 11, 11).
    """

    unknowns: Unknowns
    residual: Array
    covariance: Array

    @property
    def size(self) -> float:
        """Root mean square residual of a coordinate, outliers counted linearly [px]."""
        away = np.linalg.norm(self.residual, axis=1)
        square = np.where(away < OUTLIER, away**2, 2.0 * OUTLIER * away - OUTLIER**2)
        return float(np.sqrt(square.mean() / 2.0))


def project(scene: Scene, unknowns: Unknowns) -> Array:
    """Pixels of all observations, (O, 2)."""
    turn = Rotation.from_rotvec(unknowns.boards[:, :3]).as_matrix()
    world = np.einsum("oij,oj->oi", turn[scene.board][:, :, :2], scene.points) + unknowns.boards[scene.board, 3:]
    if len(unknowns.distances):
        moved = unknowns.distances[scene.move, None] * scene.directions[scene.move]
        world = world + np.where(scene.move[:, None] >= 0, moved, 0.0)
    cameras = unknowns.cameras
    rotation = Rotation.from_rotvec(cameras[:, 3:6]).as_matrix()[scene.camera]
    own = cameras[scene.camera]
    seen = np.einsum("oij,oj->oi", rotation, world)
    u = 1e3 * (own[:, 0] * seen[:, 0] + own[:, 2] * seen[:, 1]) + own[:, 6]
    v = 1e3 * own[:, 1] * seen[:, 1] + own[:, 7]
    off = np.stack([u, v], axis=1) / (1.0 + own[:, NEARNESS] * seen[:, 2])[:, None]
    sizes = [centre_and_half_diagonal(tuple(size)) for size in scene.sizes]
    centre = np.array([c for c, _ in sizes])[scene.camera]
    half = np.array([h for _, h in sizes])[scene.camera]
    square = (off**2).sum(1) / half**2
    return centre + off * (1.0 + own[:, 8] * square + own[:, 9] * square**2)[:, None]


def adjust(scene: Scene, start: Unknowns, *, perspective: bool = False, cameras_known: bool = False) -> Adjusted:
    """Least squares over all cameras and free boards, robust against single wrong corners.

    Args:
        scene: the observations.
        start: near enough to the solution.
        perspective: whether nearness is solved for; else it stays as it is.
        cameras_known: whether only the boards move.
    """
    own = np.ones(CAMERA, dtype=bool)
    own[NEARNESS] = perspective
    own[2] = not perspective  # a pinhole's pixels are square to its axes
    if cameras_known:
        own[:] = False
    free = ~scene.known
    shape = (len(start.cameras), len(start.boards))
    counts = (shape[0] * own.sum(), free.sum() * BOARD, len(start.distances))
    camera_slots = np.full((shape[0], CAMERA), -1)
    camera_slots[:, own] = np.arange(counts[0]).reshape(shape[0], -1)
    board_slots = np.full((shape[1], BOARD), -1)
    board_slots[free] = counts[0] + np.arange(counts[1]).reshape(-1, BOARD)

    def unpack(x: Array) -> Unknowns:
        cameras, boards = start.cameras.copy(), start.boards.copy()
        cameras[:, own] = x[: counts[0]].reshape(shape[0], -1)
        boards[free] = x[counts[0] : counts[0] + counts[1]].reshape(-1, BOARD)
        return Unknowns(cameras, boards, x[counts[0] + counts[1] :])

    def gaps(x: Array) -> Array:
        return (project(scene, unpack(x)) - scene.pixels).ravel()

    def slopes(x: Array) -> Array:
        # An observation knows one camera and one board: a parameter of all of them is varied at once.
        here = unpack(x)
        jacobian = np.zeros((2 * len(scene.points), len(x)))
        rows = np.arange(len(scene.points))
        for number in np.flatnonzero(own).tolist():
            step = _step(here.cameras[:, number], 1e-3 if number == NEARNESS else 1e-2)
            varied = [here.cameras.copy(), here.cameras.copy()]
            for sign, cameras in zip((1, -1), varied, strict=True):
                cameras[:, number] += sign * step
            up, down = (project(scene, replace(here, cameras=cameras)) for cameras in varied)
            _fill(jacobian, rows, camera_slots[scene.camera, number], (up - down) / (2 * step))
        for number in range(BOARD):
            step = 1e-6
            varied = [here.boards.copy(), here.boards.copy()]
            for sign, boards in zip((1, -1), varied, strict=True):
                boards[:, number] += sign * step
            up, down = (project(scene, replace(here, boards=boards)) for boards in varied)
            _fill(jacobian, rows, board_slots[scene.board, number], (up - down) / (2 * step))
        if len(here.distances):
            step = 1e-6
            up, down = (project(scene, replace(here, distances=here.distances + sign * step)) for sign in (1, -1))
            slots = np.where(scene.move >= 0, counts[0] + counts[1] + scene.move, -1)
            _fill(jacobian, rows, slots, (up - down) / (2 * step))
        return jacobian

    x0 = np.concatenate([start.cameras[:, own].ravel(), start.boards[free].ravel(), start.distances])
    x = _descend(gaps, slopes, x0)
    residual = gaps(x).reshape(-1, 2)
    jacobian = slopes(x)
    inliers = np.repeat(np.linalg.norm(residual, axis=1) < 4.0 * OUTLIER, 2)
    # Depths that no camera sees are the null space.
    rank = np.linalg.matrix_rank(jacobian[inliers] / (np.linalg.norm(jacobian[inliers], axis=0) + 1e-12), tol=1e-7)
    freedom = max(int(inliers.sum()) - int(rank), 1)
    scale = np.linalg.norm(jacobian[inliers], axis=0) + 1e-12
    scaled = jacobian[inliers] / scale
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12) / np.outer(scale, scale)
    full = (residual.ravel()[inliers] ** 2).sum() / freedom * inverse
    covariance = np.zeros((shape[0], CAMERA, CAMERA))
    for camera in range(shape[0]):
        slots = camera_slots[camera, own]
        covariance[camera][np.ix_(own, own)] = full[np.ix_(slots, slots)]
    return Adjusted(unpack(x), residual, covariance)


def _descend(gaps: Callable[[Array], Array], slopes: Callable[[Array], Array], x: Array) -> Array:
    """Levenberg and Marquardt's steps, points farther off than `OUTLIER` weighing less (Huber)."""

    def weighed(gap: Array) -> tuple[Array, float]:
        away = np.linalg.norm(gap.reshape(-1, 2), axis=1)
        weight = np.minimum(1.0, OUTLIER / np.maximum(away, 1e-12))
        cost = np.where(away < OUTLIER, away**2, 2.0 * OUTLIER * away - OUTLIER**2).sum()
        return np.repeat(weight, 2), float(cost)

    gap = gaps(x)
    weight, cost = weighed(gap)
    damping = 1e-3
    for _ in range(STEPS):
        jacobian = slopes(x)
        scale = np.sqrt((weight[:, None] * jacobian**2).sum(0)) + 1e-9
        scaled = jacobian / scale
        normal = scaled.T @ (weight[:, None] * scaled)
        right = -scaled.T @ (weight * gap)
        gained = 0.0
        for _ in range(12):
            step = np.linalg.solve(normal + (damping + 1e-10) * np.eye(len(x)), right) / scale
            tried = gaps(x + step)
            new_weight, new_cost = weighed(tried)
            if new_cost <= cost:
                gained = cost - new_cost
                x, gap, weight, cost = x + step, tried, new_weight, new_cost
                damping = max(0.1 * damping, 1e-10)
                break
            damping *= 10.0
        if gained <= 1e-8 * cost:
            break
    return x


def _step(values: Array, least: float) -> float:
    return 1e-6 * max(float(np.abs(values).max()), least)


def _fill(jacobian: Array, rows: NDArray[np.int64], slots: NDArray[np.int64], slope: Array) -> None:
    used = slots >= 0
    jacobian[2 * rows[used], slots[used]] = slope[used, 0]
    jacobian[2 * rows[used] + 1, slots[used]] = slope[used, 1]
