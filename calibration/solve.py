"""Solving an orthographic camera from views of a flat board.

A view of the board plane is affine, u = A [X, Y] + t with A = K2 R[:2, :2]: its larger singular value is
the scale, and the ratio of the two the cosine of the tilt. Bundle adjustment over all views follows.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.board import View, WorldPose
from calibration.camera import OrthographicCamera, Plane, centre_and_half_diagonal, distort
from calibration.rig import PLANE_SIGMA_MM
from groundwork import InputError

Array = NDArray[Any]

FEWEST_VIEWS = 4
LEAST_TILT = np.radians(8.0)
AMBIGUOUS_TILT = np.radians(3.0)
SHARED = 10  # mx, my, skew [px/mm], rotation vector, u0, v0, k1, k2


@dataclass(frozen=True)
class Solution:
    """A camera and how it was found.

    Attributes:
        camera: with residual, covariance and plane.
        view_residuals: root mean square of each view [px].
        tilts: of the board against the picture in each view [rad], (V).
    """

    camera: OrthographicCamera
    view_residuals: dict[str, float]
    tilts: dict[str, float]


def _affine(view: View) -> tuple[Array, Array]:
    design = np.column_stack([view.points, np.ones(len(view.points))])
    solution = np.linalg.lstsq(design, view.pixels, rcond=None)[0]
    return solution[:2].T, solution[2]


def _tilt_and_rotation(matrix: Array, scale: float) -> tuple[float, Array]:
    """Tilt and one of the two mirror rotations of a view with A = `matrix`."""
    block = matrix / scale
    block = block / max(1.0, float(np.linalg.norm(block, 2)))
    singular = np.linalg.svd(block)[1]
    values, vectors = np.linalg.eigh(np.eye(2) - block.T @ block)
    depth = np.sqrt(max(values[1], 0.0)) * vectors[:, 1]  # third row of R, up to its sign
    first = np.append(block[:, 0], depth[0])
    second = np.append(block[:, 1], depth[1])
    guess = np.stack([first, second, np.cross(first, second)], axis=1)
    u, _, vt = np.linalg.svd(guess)
    tilt = float(np.arccos(np.clip(singular[1] / singular[0], 0.0, 1.0)))
    return tilt, u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _world_points(view: View, pose: WorldPose) -> Array:
    return pose.origin + view.points @ pose.rotation[:, :2].T


def solve_camera(name: str, views: list[View], image_size: tuple[int, int]) -> Solution:
    """An orthographic camera from views of a board, some with known world pose.

    Where no view has a world pose, the board of the first view is the world frame. Plane: that of the
    first view with a world pose.

    Args:
        name: of the camera, for messages.
        views: of the board.
        image_size: width, height [px].

    Raises:
        InputError: too few views, tilts too small, or a mirror ambiguity the views leave open.
    """
    if len(views) < FEWEST_VIEWS:
        raise InputError(
            f"camera {name}: expected at least {FEWEST_VIEWS} pictures that show the board, found "
            f"{len(views)}; film the board at tilts of 10 to 40 degrees about three directions"
        )
    if not any(view.pose for view in views):
        here = WorldPose(origin_mm=(0, 0, 0), x_axis=(1, 0, 0), y_axis=(0, 1, 0))
        views = [View(v.name, v.points, v.pixels, here if v is views[0] else None) for v in views]
    affines = [_affine(view) for view in views]
    scale = float(np.max([np.linalg.norm(matrix, 2) for matrix, _ in affines]))
    tilts, rotations = zip(*(_tilt_and_rotation(matrix, scale) for matrix, _ in affines), strict=True)
    if sum(tilt > LEAST_TILT for tilt in tilts) < 3:
        raise InputError(
            f"camera {name}: expected at least three views tilted by more than "
            f"{np.degrees(LEAST_TILT):.0f} degrees, the tilts found are "
            f"{', '.join(f'{np.degrees(t):.0f}' for t in tilts)}; tilt the board by 10 to 40 degrees "
            "about three directions"
        )
    posed = [(view, view.pose) for view in views if view.pose is not None]
    free = [index for index, view in enumerate(views) if view.pose is None]
    rotation, offset = _start_of_camera(name, posed, affines, views, scale)
    start = np.concatenate(
        [
            [1e-3 * scale, 1e-3 * scale, 0.0],
            Rotation.from_matrix(rotation).as_rotvec(),
            offset,
            [0.0, 0.0],
            *(np.append(Rotation.from_matrix(rotations[i]).as_rotvec(), affines[i][1]) for i in free),
        ]
    )
    world = [_world_points(view, pose) for view, pose in posed]
    centre, half = centre_and_half_diagonal(image_size)

    def gaps(x: Array) -> list[Array]:
        k2 = 1e3 * np.array([[x[0], x[2]], [0.0, x[1]]])
        camera = k2 @ Rotation.from_rotvec(x[3:6]).as_matrix()[:2]
        ideals = [(view, points @ camera.T + x[6:8]) for (view, _), points in zip(posed, world, strict=True)]
        for number, index in enumerate(free):
            own = x[SHARED + 5 * number : SHARED + 5 * number + 5]
            board = k2 @ Rotation.from_rotvec(own[:3]).as_matrix()[:2, :2]
            ideals.append((views[index], views[index].points @ board.T + own[3:]))
        return [distort(ideal, (x[8], x[9]), centre, half) - view.pixels for view, ideal in ideals]

    result = least_squares(lambda x: np.concatenate(gaps(x)).ravel(), start, x_scale="jac", loss="huber", f_scale=0.5)
    final = gaps(result.x)
    flat = np.concatenate(final)
    residual = float(np.sqrt((flat**2).sum(1).mean() / 2))
    freedom = max(flat.size - len(result.x), 1)
    covariance = (flat**2).sum() / freedom * np.linalg.pinv(result.jac.T @ result.jac)[:SHARED, :SHARED]
    x = result.x.tolist()
    pose = posed[0][1]
    normal = pose.rotation[:, 2]
    camera = OrthographicCamera(
        image_size=image_size,
        scale=(1e3 * x[0], 1e3 * x[1]),
        skew=1e3 * x[2],
        rotation_vector=(x[3], x[4], x[5]),
        offset=(x[6], x[7]),
        distortion=(x[8], x[9]),
        plane=Plane(tuple(normal.tolist()), float(normal @ pose.origin), 1e-3 * PLANE_SIGMA_MM),
        residual=residual,
        covariance=tuple(map(tuple, covariance.tolist())),
    )
    names = [view.name for view, _ in posed] + [views[i].name for i in free]
    return Solution(
        camera,
        {key: float(np.sqrt((gap**2).sum(1).mean() / 2)) for key, gap in zip(names, final, strict=True)},
        {view.name: tilt for view, tilt in zip(views, tilts, strict=True)},
    )


def _start_of_camera(
    name: str,
    posed: list[tuple[View, WorldPose]],
    affines: list[tuple[Array, Array]],
    views: list[View],
    scale: float,
) -> tuple[Array, Array]:
    """World-to-camera rotation and offset, free of mirror ambiguity or refused."""
    points = np.concatenate([_world_points(view, pose) for view, pose in posed])
    pixels = np.concatenate([view.pixels for view, _ in posed])
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if spread[2] > 0.02 * spread[0]:  # boards in different planes: the affine camera is unique
        solution = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), pixels, rcond=None)[0]
        u, _, vt = np.linalg.svd(solution[:3].T, full_matrices=False)
        rows = u @ vt
        return np.vstack([rows, np.cross(rows[0], rows[1])]), solution[3]
    view, pose = posed[0]
    matrix, shift = affines[next(i for i, other in enumerate(views) if other is view)]
    tilt, on_board = _tilt_and_rotation(matrix, scale)
    if tilt > AMBIGUOUS_TILT:
        raise InputError(
            f"camera {name}: the board in {view.name} is tilted by {np.degrees(tilt):.1f} degrees, and one "
            "orthographic view cannot tell which way; take a second picture with the board moved along "
            "its normal by a known distance, and list both under `world` in board.yaml"
        )
    rotation = on_board @ pose.rotation.T
    return rotation, shift - scale * rotation[:2] @ pose.origin
