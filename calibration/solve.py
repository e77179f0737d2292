"""Solving a rig of cameras from views of flat boards.

A view of the board plane is affine, u = A [X, Y] + t with A = K2 R[:2, :2]: its larger singular value is
the scale, and the ratio of the two the cosine of the tilt. Which way it tilts a single orthographic view
cannot tell (Necker's reversal), nor can any number of views of one camera: every rig is solved from
each of the mirrored starts, and one is taken only where the others do not explain the views.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibration.board import BoardFile, View, WorldPose
from calibration.bundle import CAMERA, NEARNESS, Adjusted, Scene, Unknowns, adjust
from calibration.camera import Camera, OrthographicCamera, PinholeCamera, Plane, centre_and_half_diagonal
from calibration.rig import PLANE_SIGMA_MM, Rig
from groundwork import InputError

Array = NDArray[Any]

FEWEST_VIEWS = 4
LEAST_TILT = np.radians(8.0)
DIRECTIONS = 3  # of tilt, this far apart:
APART = np.radians(20.0)
SAME_WAY = np.radians(0.5)  # camera rotations closer than this are one
WORSE = 1.3  # times the residual: what a mirrored solution must have to be dismissed
PERSPECTIVE = 4.0  # standard deviations of nearness that count as a lens's perspective
WIDE_COVARIANCE = 10  # parameters in calib.yaml's covariance


@dataclass(frozen=True)
class Solution:
    """A rig and how well it explains its views.

    Attributes:
        rig: cameras with residual, covariance and plane.
        view_residuals: root mean square of each view [px].
        tilts: of the board against the picture in each view [rad].
        nearness: of each camera, one over its distance from the world's origin, and its standard
            deviation [1/m]: 0 for an orthographic lens.
    """

    rig: Rig
    view_residuals: dict[str, float]
    tilts: dict[str, float]
    nearness: dict[str, tuple[float, float]]

    def bias(self, camera: str, depth: float) -> float:
        """How far off the picture's edge a marker seems that stands `depth` [m] off its plane [m]."""
        model = self.rig.cameras[camera]
        per_metre = float(np.linalg.norm(model.slopes(np.zeros(3))[0]))
        return abs(self.nearness[camera][0]) * depth * 0.5 * max(model.image_size) / per_metre


@dataclass(frozen=True)
class _Affine:
    """One view's affine map, its tilt, and the two rotations board to camera that it may come from."""

    matrix: Array
    shift: Array
    tilt: float
    direction: float  # of increasing depth in the picture, up to half a turn [rad]
    rotations: tuple[Array, Array]


def _affine(view: View, scale: float | None) -> _Affine:
    design = np.column_stack([view.points, np.ones(len(view.points))])
    solution = np.linalg.lstsq(design, view.pixels, rcond=None)[0]
    matrix, shift = solution[:2].T, solution[2]
    block = matrix / (scale or float(np.linalg.norm(matrix, 2)))
    block = block / max(1.0, float(np.linalg.norm(block, 2)))
    singular = np.linalg.svd(matrix, compute_uv=False)
    values, vectors = np.linalg.eigh(np.eye(2) - block.T @ block)
    depth = np.sqrt(max(values[1], 0.0)) * vectors[:, 1]  # third row of R, up to its sign
    along = matrix @ vectors[:, 1]
    tilt = float(np.arccos(np.clip(singular[1] / singular[0], 0.0, 1.0)))
    # In a real lens the farther side is smaller: the likelier rotation comes first.
    sign = 1.0 if depth @ _vanishing(view) >= 0.0 else -1.0
    both = tuple(_nearest_rotation(block, side * depth) for side in (sign, -sign))
    return _Affine(matrix, shift, tilt, float(np.arctan2(along[1], along[0]) % np.pi), (both[0], both[1]))


def _vanishing(view: View) -> Array:
    """How an image shrinks along the board's axes, (2): the last row of its homography [1/m]."""
    size = float(np.abs(view.points).max())
    middle, spread = view.pixels.mean(0), float(view.pixels.std())
    x, y = (view.points / size).T
    u, v = ((view.pixels - middle) / spread).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    h = np.linalg.svd(rows, full_matrices=False)[2][-1]
    return h[6:8] / (h[8] * size)


def _nearest_rotation(block: Array, depth: Array) -> Array:
    first, second = np.append(block[:, 0], depth[0]), np.append(block[:, 1], depth[1])
    guess = np.stack([first, second, np.cross(first, second)], axis=1)
    u, _, vt = np.linalg.svd(guess)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def check_views(camera: str, views: list[View]) -> None:
    """Refuses views from which a camera cannot be solved, saying what to film.

    Raises:
        InputError: too few, too flat, or all tilted alike.
    """
    advice = "tilt the board by 10 to 40 degrees about three directions"
    if len(views) < FEWEST_VIEWS:
        raise InputError(
            f"camera {camera}: expected at least {FEWEST_VIEWS} pictures that show the board, found {len(views)}; "
            f"{advice}"
        )
    affines = [_affine(view, None) for view in views]
    tilted = [affine for affine in affines if affine.tilt > LEAST_TILT]
    if len(tilted) < DIRECTIONS:
        raise InputError(
            f"camera {camera}: expected at least three views tilted by more than {np.degrees(LEAST_TILT):.0f} degrees, "
            f"the tilts found are {', '.join(f'{np.degrees(a.tilt):.0f}' for a in affines)}; {advice}"
        )
    found = _different([affine.direction for affine in tilted])
    if found < DIRECTIONS:
        raise InputError(
            f"camera {camera}: expected the board tilted about at least three directions "
            f"{np.degrees(APART):.0f} degrees apart, found {found}; {advice}"
        )


def _different(directions: list[float]) -> int:
    """How many of these (modulo half a turn) are `APART` from one another, at most."""
    most = 0
    for first in directions:
        kept = [first]
        for other in sorted((d - first) % np.pi for d in directions):
            angle = first + other
            gaps = [abs((angle - k + np.pi / 2) % np.pi - np.pi / 2) for k in kept]
            if min(gaps) >= APART:
                kept.append(angle)
        most = max(most, len(kept))
    return most


@dataclass(frozen=True)
class _Problem:
    """Cameras that see boards in common, with everything a start needs."""

    names: list[str]
    views: list[list[View]]
    affines: list[list[_Affine]]
    scales: list[float]
    sizes: list[tuple[int, int]]
    boards: list[str]  # that may stand anywhere, by key
    poses: dict[str, WorldPose]
    moves: dict[str, tuple[str, Array]]  # moved board: from which, along which direction

    def owner(self, view: View) -> str:
        """The board a view's board was moved from, or itself."""
        return self.moves[view.board][0] if view.board in self.moves else view.board


def solve_rig(
    views: dict[str, list[View]],
    sizes: dict[str, tuple[int, int]],
    description: BoardFile,
    tilt_signs: dict[str, int],
    model: str = "orthographic",
) -> Solution:
    """All cameras of a rig from their views of the board.

    Where no view has a world pose, the board of the first view of each group of cameras that see
    boards in common is the world frame. A camera's plane is that of its first board of known pose.

    Args:
        views: by camera.
        sizes: of each camera's pictures [px].
        description: what the board is and where it stood.
        tilt_signs: by camera, which of two mirrored solutions is meant: +1 where the right edge (or, where
            it is tilted more about the horizontal, the lower edge) of its reference board is farther away.
        model: `orthographic` or `pinhole`.

    Raises:
        InputError: views that cannot tell, or a mirror ambiguity they leave open.
    """
    for name, own in views.items():
        check_views(name, own)
    solutions = [
        _solve_group(_problem(group, views, sizes, description), tilt_signs, model) for group in _groups(views)
    ]
    return Solution(
        Rig(
            {
                name: solution.rig.cameras[name]
                for name in views
                for solution in solutions
                if name in solution.rig.cameras
            }
        ),
        {key: value for solution in solutions for key, value in solution.view_residuals.items()},
        {key: value for solution in solutions for key, value in solution.tilts.items()},
        {key: value for solution in solutions for key, value in solution.nearness.items()},
    )


def _groups(views: dict[str, list[View]]) -> list[list[str]]:
    """Cameras connected by boards they see together."""
    groups: list[list[str]] = []
    for name, own in views.items():
        boards = {view.board for view in own}
        touching = [group for group in groups if any(boards & {v.board for v in views[n]} for n in group)]
        groups = [group for group in groups if group not in touching]
        groups.append([*itertools.chain(*touching), name])
    return groups


def _problem(
    names: list[str], views: dict[str, list[View]], sizes: dict[str, tuple[int, int]], description: BoardFile
) -> _Problem:
    own = [views[name] for name in names]
    poses = {view.board: view.pose for group in own for view in group if view.pose is not None}
    if not poses:
        poses = {own[0][0].board: WorldPose(origin_mm=(0, 0, 0), x_axis=(1, 0, 0), y_axis=(0, 1, 0))}
    seen = {view.name: view.board for group in own for view in group}
    moves = {
        seen[move.to]: (seen[move.from_], np.asarray(move.along, dtype=float))
        for move in description.moved
        if move.to in seen and move.from_ in seen
    }
    scales = [max(float(np.linalg.norm(_affine(view, None).matrix, 2)) for view in group) for group in own]
    affines = [[_affine(view, scale) for view in group] for group, scale in zip(own, scales, strict=True)]
    boards = list(dict.fromkeys(view.board for group in own for view in group if view.board not in moves))
    return _Problem(names, own, affines, scales, [sizes[name] for name in names], boards, poses, moves)


def _solve_group(problem: _Problem, tilt_signs: dict[str, int], model: str) -> Solution:
    scene = _scene(problem)
    candidates: list[Adjusted] = []
    for rotations in _starts(problem):
        start = _start(problem, scene, rotations)
        found = adjust(scene, start, perspective=model == "pinhole")
        if (found.unknowns.distances < 0).any() or not np.isfinite(found.size):
            continue
        if not any(_same(found, other) for other in candidates):
            candidates.append(found)
    if not candidates:
        raise InputError(
            f"cameras {', '.join(problem.names)}: expected views that one rig explains, found none; check the poses "
            "under `world` and the directions under `moved` in board.yaml"
        )
    chosen = _choose(problem, scene, candidates, tilt_signs)
    nearness = {name: (0.0, np.inf) for name in problem.names}
    bent = chosen if model == "pinhole" else adjust(scene, chosen.unknowns, perspective=True)
    for k, name in enumerate(problem.names):
        sigma = float(np.sqrt(bent.covariance[k, NEARNESS, NEARNESS]))
        nearness[name] = (float(bent.unknowns.cameras[k, NEARNESS]), sigma)
        if model == "pinhole" and not nearness[name][0] > PERSPECTIVE * sigma:
            raise InputError(
                f"camera {name}: expected views whose perspective shows how far the camera stands, found none to speak "
                "of; use the orthographic model, or tilt the board more"
            )
    return _solution(problem, scene, chosen, nearness, model)


def _scene(problem: _Problem) -> Scene:
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


def _starts(problem: _Problem) -> list[list[Array]]:
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


def _from_planes(views: list[View], problem: _Problem) -> Array | None:
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


def _completed(problem: _Problem, start: list[Array | None]) -> list[list[Array]]:
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


def _start(problem: _Problem, scene: Scene, rotations: list[Array]) -> Unknowns:
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


def _board_start(problem: _Problem, key: str, rotations: list[Array], cameras: Array) -> Array:
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


def _same(one: Adjusted, other: Adjusted) -> bool:
    turns = [Rotation.from_rotvec(found.unknowns.cameras[:, 3:6]) for found in (one, other)]
    return bool(((turns[0] * turns[1].inv()).magnitude() < SAME_WAY).all())


def _choose(problem: _Problem, scene: Scene, candidates: list[Adjusted], tilt_signs: dict[str, int]) -> Adjusted:
    """The one solution that explains the views, or that the user names.

    Raises:
        InputError: several explain them.
    """
    likely = _likely(candidates)
    if len(likely) > 1:
        # A real lens's own perspective may tell what an orthographic one could not.
        bent = [adjust(scene, found.unknowns, perspective=True) for found in likely]
        best = _likely(bent)
        if len(best) == 1 and (best[0].unknowns.cameras[:, NEARNESS] > -1e-9).all():
            likely = [found for found, other in zip(likely, bent, strict=True) if other is best[0]]
    for camera, name in enumerate(problem.names):
        if name in tilt_signs and len(likely) > 1:
            likely = [found for found in likely if _sign(problem, found, camera)[0] == tilt_signs[name]]
    if len(likely) == 1:
        return likely[0]
    if not likely:
        raise InputError("--tilt-sign: expected a sign that the views allow, found one they contradict; leave it out")
    differs = next(
        camera
        for camera in range(len(problem.names))
        if len({_sign(problem, found, camera)[0] for found in likely}) > 1
    )
    name = problem.names[differs]
    _, view, tilt, edge = _sign(problem, likely[0], differs)
    raise InputError(
        f"camera {name}: the board in {view} is tilted by {np.degrees(tilt):.1f} degrees, and orthographic pictures "
        f"cannot tell which way; take a second picture with the board moved along its normal and list it under `world` "
        f"(distance known) or `moved` (direction known) in board.yaml, or say --tilt-sign {name}=+ if the board's "
        f"{edge} edge is farther from the camera, {name}=- if nearer"
    )


def _likely(candidates: list[Adjusted]) -> list[Adjusted]:
    best = min(found.size for found in candidates)
    return [found for found in candidates if found.size < WORSE * best + 1e-6]


def _sign(problem: _Problem, found: Adjusted, camera: int) -> tuple[int, str, float, str]:
    """Which way the camera's reference board tilts, its view, the tilt, and the edge that is farther for +1."""
    views = problem.views[camera]
    view = next((view for view in views if view.board in problem.poses), views[0])
    board = problem.boards.index(problem.owner(view))
    turn = Rotation.from_rotvec(found.unknowns.cameras[camera, 3:6]).as_matrix()
    turn = turn @ Rotation.from_rotvec(found.unknowns.boards[board, :3]).as_matrix()
    depth = turn[2, :2]
    along = turn[:2, :2] @ depth
    axis = int(abs(along[1]) > abs(along[0]))
    tilt = float(np.arcsin(np.clip(np.linalg.norm(depth), 0.0, 1.0)))
    return int(np.sign(along[axis])), view.name, tilt, ("right", "lower")[axis]


def _solution(
    problem: _Problem, scene: Scene, found: Adjusted, nearness: dict[str, tuple[float, float]], model: str
) -> Solution:
    cameras: dict[str, Camera] = {}
    residuals, tilts = {}, {}
    first = 0
    for k, name in enumerate(problem.names):
        x = found.unknowns.cameras[k]
        gaps = found.residual[scene.camera == k]
        view = next((view for view in problem.views[k] if view.board in problem.poses), None)
        board = found.unknowns.boards[problem.boards.index(problem.owner(view or problem.views[k][0]))]
        normal = Rotation.from_rotvec(board[:3]).as_matrix()[:, 2]
        plane = Plane(tuple(normal.tolist()), float(normal @ board[3:]), 1e-3 * PLANE_SIGMA_MM)
        centre, half = centre_and_half_diagonal(problem.sizes[k])
        residual = float(np.sqrt((gaps**2).mean()))
        vector = tuple(x[3:6].tolist())
        if model == "orthographic":
            wide = found.covariance[k][:WIDE_COVARIANCE, :WIDE_COVARIANCE]
            cameras[name] = OrthographicCamera(
                image_size=problem.sizes[k],
                rotation_vector=vector,
                scale=(1e3 * x[0], 1e3 * x[1]),
                skew=1e3 * x[2],
                offset=tuple((centre + x[6:8]).tolist()),
                distortion=(float(x[8]), float(x[9])),
                plane=plane,
                residual=residual,
                covariance=tuple(map(tuple, wide.tolist())),
            )
        else:
            focal = 1e3 * x[:2] / x[NEARNESS]
            cameras[name] = PinholeCamera(
                image_size=problem.sizes[k],
                rotation_vector=vector,
                focal=tuple(focal.tolist()),
                centre=tuple(centre.tolist()),
                translation=(x[6] / (1e3 * x[0]), x[7] / (1e3 * x[1]), 1.0 / x[NEARNESS]),
                # In units of the focal length, not of half the diagonal.
                distortion=(x[8] * (focal.mean() / half) ** 2, x[9] * (focal.mean() / half) ** 4, 0.0, 0.0, 0.0),
                plane=plane,
                residual=residual,
            )
        for view, affine in zip(problem.views[k], problem.affines[k], strict=True):
            part = found.residual[first : first + len(view.points)]
            residuals[view.name] = float(np.sqrt((part**2).mean()))
            tilts[view.name] = affine.tilt
            first += len(view.points)
    return Solution(Rig(cameras), residuals, tilts, nearness)
