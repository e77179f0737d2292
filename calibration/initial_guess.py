"""Initial guesses for the bundle adjustment: one for each mirrored rig that the views allow."""

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.calibration.board import BoardFile, View, WorldPose
from rafl.calibration.bundle import CAMERA_PARAMETERS, INVERSE_DISTANCE, Observations, Unknowns
from rafl.calibration.camera import centre_and_half_diagonal
from rafl.calibration.views import AffineView, fit_affine
from rafl.common.errors import InputError

Array = NDArray[Any]


@dataclass(frozen=True)
class CameraGroup:
    """Cameras connected by shared board poses, with the data for an initial guess.

    Attributes:
        names: names of the cameras.
        views: by camera.
        affines: affine maps of the views, by camera.
        scales: scales of the cameras [px/m].
        sizes: image sizes [px].
        pose_keys: keys of the board poses that are not defined by a move.
        known_poses: by key.
        moves: by key of a moved board's pose, the key of the pose it was moved from and the direction.
    """

    names: list[str]
    views: list[list[View]]
    affines: list[list[AffineView]]
    scales: list[float]
    sizes: list[tuple[int, int]]
    pose_keys: list[str]
    known_poses: dict[str, WorldPose]
    moves: dict[str, tuple[str, Array]]

    @classmethod
    def of(
        cls, names: list[str], views: dict[str, list[View]], sizes: dict[str, tuple[int, int]], description: BoardFile
    ) -> "CameraGroup":
        """Group some cameras of a rig. If no pose is known, the first whole board not moved is the world frame."""
        own = [views[name] for name in names]
        key_of = {view.name: view.pose_key for group in own for view in group}
        moves = {
            key_of[move.to]: (key_of[move.from_], np.asarray(move.along))
            for move in description.moved
            if move.to in key_of and move.from_ in key_of
        }
        keys = list(dict.fromkeys(view.pose_key for group in own for view in group if view.pose_key not in moves))
        poses = {view.pose_key: view.known_pose for group in own for view in group if view.known_pose is not None}
        if not poses.keys() & set(keys):
            first = next((view for group in own for view in group if view.origin_known and view.pose_key in keys), None)
            poses[first.pose_key if first else keys[0]] = WorldPose(
                origin_mm=(0, 0, 0), x_axis=(1, 0, 0), y_axis=(0, 1, 0)
            )
        scales = [max(float(np.linalg.norm(fit_affine(view).matrix, 2)) for view in group) for group in own]
        affines = [[fit_affine(view, scale) for view in group] for group, scale in zip(own, scales, strict=True)]
        return cls(names, own, affines, scales, [sizes[name] for name in names], keys, poses, moves)

    def base_key(self, view: View) -> str:
        """Key of the pose that the view's board was moved from, or of its own pose if it was not moved."""
        return self.moves[view.pose_key][0] if view.pose_key in self.moves else view.pose_key

    def reference_view(self, camera: int) -> View:
        """The view that defines a camera's tilt and plane: the first of known pose, or else the first."""
        return next((view for view in self.views[camera] if view.pose_key in self.known_poses), self.views[camera][0])


def collect_observations(group: CameraGroup) -> Observations:
    """All observations of a group, in the order of its cameras and views."""
    moved = list(group.moves)
    parts = [
        (
            view,
            camera,
            group.pose_keys.index(group.base_key(view)),
            moved.index(view.pose_key) if view.pose_key in moved else -1,
        )
        for camera, views in enumerate(group.views)
        for view in views
    ]
    counts = [len(view.points) for view, *_ in parts]
    return Observations(
        np.concatenate([view.points for view, *_ in parts]),
        np.concatenate([view.pixels for view, *_ in parts]),
        np.repeat([camera for _, camera, _, _ in parts], counts),
        np.repeat([pose for _, _, pose, _ in parts], counts),
        np.repeat([move for *_, move in parts], counts),
        np.array([direction for _, direction in group.moves.values()]).reshape(-1, 3),
        np.array([key in group.known_poses for key in group.pose_keys]),
        np.array(group.sizes),
    )


def initial_rotations(group: CameraGroup) -> list[list[Array]]:
    """Every combination of the cameras' world-to-camera rotations (3, 3) that the views allow."""
    per_camera: list[list[Array] | None] = []
    for views, affines in zip(group.views, group.affines, strict=True):
        known = [k for k, view in enumerate(views) if view.pose_key in group.known_poses]
        if not known:
            per_camera.append(None)
            continue
        unique = _rotation_from_known_poses([views[k] for k in known], group)
        first = group.known_poses[views[known[0]].pose_key].rotation
        per_camera.append([unique] if unique is not None else [r @ first.T for r in affines[known[0]].rotations])
    combinations: list[list[Array | None]] = [[]]
    for options in per_camera:
        choices: list[Array | None] = [None] if options is None else [*options]
        combinations = [[*combination, option] for combination in combinations for option in choices]
    result: list[list[Array]] = []
    for combination in combinations:
        result += _add_missing_rotations(group, combination)
    return result


def _rotation_from_known_poses(views: list[View], group: CameraGroup) -> Array | None:
    """Camera rotation from boards of known pose; None if all their points lie in one plane."""
    points = np.concatenate([_world_points(view, group.known_poses[view.pose_key]) for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    extent = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if extent[2] < 0.02 * extent[0]:
        return None
    solution = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), pixels, rcond=None)[0]
    u, _, vt = np.linalg.svd(solution[:3].T, full_matrices=False)
    rows = u @ vt
    return np.vstack([rows, np.cross(rows[0], rows[1])])


def _world_points(view: View, pose: WorldPose) -> Array:
    result: Array = pose.origin + view.points @ pose.rotation[:, :2].T
    return result


def _add_missing_rotations(group: CameraGroup, rotations: list[Array | None]) -> list[list[Array]]:
    """Complete the rotations of cameras that saw no board of known pose, from cameras that share poses with them."""
    missing = [k for k, rotation in enumerate(rotations) if rotation is None]
    if not missing:
        return [[r for r in rotations if r is not None]]
    for camera in missing:
        candidates: list[Array] = []
        for other, rotation in enumerate(rotations):
            if rotation is None:
                continue
            others = {
                view.pose_key: affine for view, affine in zip(group.views[other], group.affines[other], strict=True)
            }
            for view, own in zip(group.views[camera], group.affines[camera], strict=True):
                if view.pose_key in others:
                    pairs = itertools.product(own.rotations, others[view.pose_key].rotations)
                    candidates += [a @ b.T @ rotation for a, b in pairs]
        if candidates:
            completed = []
            for option in _main_clusters(candidates):
                completed += _add_missing_rotations(
                    group, [option if k == camera else r for k, r in enumerate(rotations)]
                )
            return completed
    raise InputError(
        f"camera {group.names[missing[0]]}: with several cameras expected an image in which the pose of the board is "
        "known, or an image taken at the same time as another camera's, found none; list one under `world` in "
        "board.yaml"
    )


def _main_clusters(rotations: list[Array]) -> list[Array]:
    """Mean rotations of the two largest clusters; the rotations of a cluster are within 6 degrees of its centre."""
    stack = np.array(rotations)
    result = []
    for _ in range(2):
        angles = np.arccos(np.clip((np.einsum("aij,bij->ab", stack, stack) - 1.0) / 2.0, -1.0, 1.0))
        near = angles < np.radians(6.0)
        best = int(near.sum(axis=1).argmax())
        result.append(Rotation.from_matrix(stack[near[best]]).mean().as_matrix())
        stack = stack[~near[best]]
        if not len(stack):
            break
    return result


def initial_unknowns(group: CameraGroup, rotations: list[Array]) -> Unknowns:
    """Cameras, board poses and move distances from the cameras' rotations and the affine maps of the views."""
    cameras = np.zeros((len(group.names), CAMERA_PARAMETERS))
    for k, rotation in enumerate(rotations):
        scale = group.scales[k]
        centre, _ = centre_and_half_diagonal(group.sizes[k])
        offsets = [
            affine.shift - scale * rotation[:2] @ group.known_poses[view.pose_key].origin
            for view, affine in zip(group.views[k], group.affines[k], strict=True)
            if view.pose_key in group.known_poses
        ]
        cameras[k, :2] = 1e-3 * scale
        cameras[k, 3:6] = Rotation.from_matrix(rotation).as_rotvec()
        cameras[k, 6:8] = (np.mean(offsets, axis=0) if offsets else centre) - centre
    poses = np.array([_initial_pose(group, key, rotations, cameras) for key in group.pose_keys])
    return Unknowns(cameras, poses, np.full(len(group.moves), 0.02))


def perspective_unknowns(group: CameraGroup) -> Unknowns | None:
    """Pinhole cameras, board poses and move distances from the homographies of the views.

    The focal lengths come from the homographies (Zhang, IEEE Trans. Pattern Analysis 22, 2000), the poses from OpenCV's
    solvePnP. None if a view shows no perspective.
    """
    boards = {key: (pose.rotation, pose.origin) for key, pose in group.known_poses.items()}
    cameras = np.zeros((len(group.names), CAMERA_PARAMETERS))
    left = set(range(len(group.names)))
    while left:
        seen = [k for k in left if any(view.pose_key in boards for view in group.views[k])]
        if not seen:
            return None
        k = seen[0]
        left.remove(k)
        local = _local_poses(group.views[k], group.sizes[k])
        if local is None:
            return None
        focal, poses = local
        reference = next(view.pose_key for view in group.views[k] if view.pose_key in boards)
        rotation = poses[reference][0] @ boards[reference][0].T
        translation = poses[reference][1] - rotation @ boards[reference][1]
        if not translation[2] > 0.0:
            return None
        cameras[k, :2] = 1e-3 * focal / translation[2]
        cameras[k, 3:6] = Rotation.from_matrix(rotation).as_rotvec()
        cameras[k, 6:8] = focal * translation[:2] / translation[2]
        cameras[k, INVERSE_DISTANCE] = 1.0 / translation[2]
        for key, (own, place) in poses.items():
            boards.setdefault(key, (rotation.T @ own, rotation.T @ (place - translation)))
    if not boards.keys() >= {*group.pose_keys, *group.moves}:
        return None
    free = [np.append(Rotation.from_matrix(boards[k][0]).as_rotvec(), boards[k][1]) for k in group.pose_keys]
    distances = [direction @ (boards[key][1] - boards[base][1]) for key, (base, direction) in group.moves.items()]
    return Unknowns(cameras, np.array(free), np.array(distances, dtype=float))


def _local_poses(views: list[View], size: tuple[int, int]) -> tuple[Array, dict[str, tuple[Array, Array]]] | None:
    """Focal lengths (2) [px] of a camera, and the pose of each board in its frame, by key: rotation, translation."""
    points = [np.column_stack([view.points, np.zeros(len(view.points))]).astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    matrix = cv2.initCameraMatrix2D(points, pixels, size, 0)
    focal = np.diag(matrix)[:2]
    if not (np.isfinite(focal).all() and (focal > 0.0).all()):
        return None
    centre, _ = centre_and_half_diagonal(size)
    matrix = np.array([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    poses = {}
    for view, own, seen in zip(views, points, pixels, strict=True):
        found, vector, translation = cv2.solvePnP(own, seen, matrix, None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            return None
        poses[view.pose_key] = (Rotation.from_rotvec(vector.ravel()).as_matrix(), translation.ravel())
    return focal, poses


def _initial_pose(group: CameraGroup, key: str, rotations: list[Array], cameras: Array) -> Array:
    """Rotation vector and position of a board, (6), from all views of this pose."""
    if key in group.known_poses:
        pose = group.known_poses[key]
        return np.concatenate([Rotation.from_matrix(pose.rotation).as_rotvec(), pose.origin])
    seen = [
        (camera, affine)
        for camera, (views, affines) in enumerate(zip(group.views, group.affines, strict=True))
        for view, affine in zip(views, affines, strict=True)
        if view.pose_key == key
    ]
    options = [rotations[camera].T @ rotation for camera, affine in seen for rotation in affine.rotations]

    def misfit(board: Array) -> float:
        return sum(
            float(np.linalg.norm(group.scales[c] * rotations[c][:2] @ board[:, :2] - a.matrix) / group.scales[c])
            for c, a in seen
        )

    board = options[0] if len({camera for camera, _ in seen}) == 1 else min(options, key=misfit)
    rows, right = [], []
    for camera, affine in seen:
        centre, _ = centre_and_half_diagonal(group.sizes[camera])
        rows.append(group.scales[camera] * rotations[camera][:2])
        right.append(affine.shift - centre - cameras[camera, 6:8])
    position = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return np.concatenate([Rotation.from_matrix(board).as_rotvec(), position])
