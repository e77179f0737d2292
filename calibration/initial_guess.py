"""Where a bundle adjustment may begin: each of the mirrored rigs that the views allow."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.board import BoardFile, View, WorldPose
from rafl.calibration.bundle import CAMERA, Scene, Unknowns
from rafl.calibration.camera import centre_and_half_diagonal
from rafl.calibration.views import Affine, affine_of
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError

Array = NDArray[Any]


@dataclass(frozen=True)
class Problem:
    """Cameras that see boards in common, with everything a start needs.

    Attributes:
        names: of the cameras.
        views: by camera.
        affines: of the views.
        scales: of the cameras [px/m].
        sizes: of their pictures [px].
        boards: keys of those that stand by themselves.
        poses: of boards in known places.
        moves: of each moved board, from which and along which direction.
    """

    names: list[str]
    views: list[list[View]]
    affines: list[list[Affine]]
    scales: list[float]
    sizes: list[tuple[int, int]]
    boards: list[str]
    poses: dict[str, WorldPose]
    moves: dict[str, tuple[str, Array]]

    @classmethod
    def of(
        cls, names: list[str], views: dict[str, list[View]], sizes: dict[str, tuple[int, int]], description: BoardFile
    ) -> "Problem":
        """That of some cameras of a rig; without any known place the first board that was not moved is the world."""
        own = [views[name] for name in names]
        seen = {view.name: view.board for group in own for view in group}
        moves = {
            seen[move.to]: (seen[move.from_], np.asarray(move.along))
            for move in description.moved
            if move.to in seen and move.from_ in seen
        }
        boards = list(dict.fromkeys(view.board for group in own for view in group if view.board not in moves))
        poses = {view.board: view.pose for group in own for view in group if view.pose is not None}
        if not poses.keys() & set(boards):
            poses[boards[0]] = WorldPose(origin_mm=(0, 0, 0), x_axis=(1, 0, 0), y_axis=(0, 1, 0))
        scales = [max(float(np.linalg.norm(affine_of(view).matrix, 2)) for view in group) for group in own]
        affines = [[affine_of(view, scale) for view in group] for group, scale in zip(own, scales, strict=True)]
        return cls(names, own, affines, scales, [sizes[name] for name in names], boards, poses, moves)

    def owner(self, view: View) -> str:
        """The board a view's board was moved from, or itself."""
        return self.moves[view.board][0] if view.board in self.moves else view.board

    def reference(self, camera: int) -> View:
        """The view by whose board a camera's tilt and plane are told: the first in a known place."""
        return next((view for view in self.views[camera] if view.board in self.poses), self.views[camera][0])


def scene_of(problem: Problem) -> Scene:
    """All observations, as the bundle adjustment wants them."""
    moved = list(problem.moves)
    parts = [
        (
            view,
            camera,
            problem.boards.index(problem.owner(view)),
            moved.index(view.board) if view.board in moved else -1,
        )
        for camera, group in enumerate(problem.views)
        for view in group
    ]
    counts = [len(view.points) for view, *_ in parts]
    return Scene(
        np.concatenate([view.points for view, *_ in parts]),
        np.concatenate([view.pixels for view, *_ in parts]),
        np.repeat([camera for _, camera, _, _ in parts], counts),
        np.repeat([board for _, _, board, _ in parts], counts),
        np.repeat([move for *_, move in parts], counts),
        np.array([direction for _, direction in problem.moves.values()]).reshape(-1, 3),
        np.array([board in problem.poses for board in problem.boards]),
        np.array(problem.sizes),
    )


def rotation_starts(problem: Problem) -> list[list[Array]]:
    """Every combination of the cameras' world-to-camera rotations that the views allow."""
    per_camera: list[list[Array] | None] = []
    for views, affines in zip(problem.views, problem.affines, strict=True):
        posed = [k for k, view in enumerate(views) if view.board in problem.poses]
        if not posed:
            per_camera.append(None)
            continue
        unique = _from_planes([views[k] for k in posed], problem)
        first = problem.poses[views[posed[0]].board].rotation
        per_camera.append([unique] if unique is not None else [r @ first.T for r in affines[posed[0]].rotations])
    starts: list[list[Array | None]] = [[]]
    for options in per_camera:
        choices: list[Array | None] = [None] if options is None else [*options]
        starts = [[*start, option] for start in starts for option in choices]
    result: list[list[Array]] = []
    for start in starts:
        result += _completed(problem, start)
    return result


def _from_planes(views: list[View], problem: Problem) -> Array | None:
    """The rotation from boards in known places that do not lie in one plane; None where they do."""
    points = np.concatenate([_world(view, problem.poses[view.board]) for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if spread[2] < 0.02 * spread[0]:
        return None
    solution = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), pixels, rcond=None)[0]
    u, _, vt = np.linalg.svd(solution[:3].T, full_matrices=False)
    rows = u @ vt
    return np.vstack([rows, np.cross(rows[0], rows[1])])


def _world(view: View, pose: WorldPose) -> Array:
    return pose.origin + view.points @ pose.rotation[:, :2].T


def _completed(problem: Problem, start: list[Array | None]) -> list[list[Array]]:
    """Adds the rotations of cameras that saw no board of known pose, from those they share boards with."""
    missing = [k for k, rotation in enumerate(start) if rotation is None]
    if not missing:
        return [[r for r in start if r is not None]]
    for camera in missing:
        votes: list[Array] = []
        for other, rotation in enumerate(start):
            if rotation is None:
                continue
            theirs = {
                view.board: affine for view, affine in zip(problem.views[other], problem.affines[other], strict=True)
            }
            for view, mine in zip(problem.views[camera], problem.affines[camera], strict=True):
                if view.board in theirs:
                    pairs = itertools.product(mine.rotations, theirs[view.board].rotations)
                    votes += [a @ b.T @ rotation for a, b in pairs]
        if votes:
            filled = []
            for option in _clusters(votes):
                filled += _completed(problem, [option if k == camera else r for k, r in enumerate(start)])
            return filled
    raise InputError(
        f"camera {problem.names[missing[0]]}: with several cameras expected a picture with a known place of the board, "
        "or one taken together with another camera's, found none; list one under `world` in board.yaml"
    )


def _clusters(votes: list[Array]) -> list[Array]:
    """The two rotations that most votes gather about."""
    stack = np.array(votes)
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


def start_from(problem: Problem, rotations: list[Array]) -> Unknowns:
    """Cameras and boards from the cameras' rotations and the views' affine maps."""
    cameras = np.zeros((len(problem.names), CAMERA))
    for k, rotation in enumerate(rotations):
        scale = problem.scales[k]
        centre, _ = centre_and_half_diagonal(problem.sizes[k])
        offsets = [
            affine.shift - scale * rotation[:2] @ problem.poses[view.board].origin
            for view, affine in zip(problem.views[k], problem.affines[k], strict=True)
            if view.board in problem.poses
        ]
        cameras[k, :2] = 1e-3 * scale
        cameras[k, 3:6] = Rotation.from_matrix(rotation).as_rotvec()
        cameras[k, 6:8] = (np.mean(offsets, axis=0) if offsets else centre) - centre
    boards = np.array([_board_start(problem, key, rotations, cameras) for key in problem.boards])
    return Unknowns(cameras, boards, np.full(len(problem.moves), 0.02))


def _board_start(problem: Problem, key: str, rotations: list[Array], cameras: Array) -> Array:
    """Rotation vector and position of a board, as its views together have it."""
    if key in problem.poses:
        pose = problem.poses[key]
        return np.concatenate([Rotation.from_matrix(pose.rotation).as_rotvec(), pose.origin])
    seen = [
        (camera, affine)
        for camera, (views, affines) in enumerate(zip(problem.views, problem.affines, strict=True))
        for view, affine in zip(views, affines, strict=True)
        if view.board == key
    ]
    options = [rotations[camera].T @ rotation for camera, affine in seen for rotation in affine.rotations]

    def misfit(turn: Array) -> float:
        return sum(
            float(np.linalg.norm(problem.scales[c] * rotations[c][:2] @ turn[:, :2] - a.matrix) / problem.scales[c])
            for c, a in seen
        )

    turn = options[0] if len({camera for camera, _ in seen}) == 1 else min(options, key=misfit)
    rows, right = [], []
    for camera, affine in seen:
        centre, _ = centre_and_half_diagonal(problem.sizes[camera])
        rows.append(problem.scales[camera] * rotations[camera][:2])
        right.append(affine.shift - centre - cameras[camera, 6:8])
    place = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), place])
