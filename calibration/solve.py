"""Solving a rig of cameras from views of flat boards.

Which way a board tilts a single orthographic view cannot tell, nor can any number of views of one camera: every
rig is solved from each of the mirrored starts, and one is taken only where the others do not explain the views.
"""

import itertools
from collections import ChainMap
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.board import BoardFile, View
from rafl.calibration.bundle import NEARNESS, Adjusted, Scene, adjust
from rafl.calibration.camera import Camera, OrthographicCamera, PinholeCamera, Plane, centre_and_half_diagonal
from rafl.calibration.initial_guess import Problem, rotation_starts, scene_of, start_from
from rafl.calibration.rig import PLANE_SIGMA_MM, Rig
from rafl.calibration.views import check_views, farther_edge
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError

Array = NDArray[Any]

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
    groups = [_solve_group(Problem.of(group, views, sizes, description), tilt_signs, model) for group in _groups(views)]
    cameras = dict(ChainMap(*(group.rig.cameras for group in groups)))
    return Solution(
        Rig({name: cameras[name] for name in views}),
        dict(ChainMap(*(group.view_residuals for group in groups))),
        dict(ChainMap(*(group.tilts for group in groups))),
        dict(ChainMap(*(group.nearness for group in groups))),
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


def _solve_group(problem: Problem, tilt_signs: dict[str, int], model: str) -> Solution:
    scene = scene_of(problem)
    candidates: list[Adjusted] = []
    for rotations in rotation_starts(problem):
        start = start_from(problem, rotations)
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


def _same(one: Adjusted, other: Adjusted) -> bool:
    turns = [Rotation.from_rotvec(found.unknowns.cameras[:, 3:6]) for found in (one, other)]
    return bool(((turns[0] * turns[1].inv()).magnitude() < SAME_WAY).all())


def _choose(problem: Problem, scene: Scene, candidates: list[Adjusted], tilt_signs: dict[str, int]) -> Adjusted:
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
    signs = [{_sign(problem, found, camera)[0] for found in likely} for camera in range(len(problem.names))]
    differs = int(np.argmax([len(of_camera) for of_camera in signs]))
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


def _sign(problem: Problem, found: Adjusted, camera: int) -> tuple[int, str, float, str]:
    """Which way the camera's reference board tilts, its view, the tilt, and the edge that is farther for +1."""
    view = problem.reference(camera)
    board = problem.boards.index(problem.owner(view))
    turn = Rotation.from_rotvec(found.unknowns.cameras[camera, 3:6]).as_matrix()
    turn = turn @ Rotation.from_rotvec(found.unknowns.boards[board, :3]).as_matrix()
    sign, tilt, edge = farther_edge(turn)
    return sign, view.name, tilt, edge


def _solution(
    problem: Problem, scene: Scene, found: Adjusted, nearness: dict[str, tuple[float, float]], model: str
) -> Solution:
    cameras: dict[str, Camera] = {}
    residuals, tilts = {}, {}
    first = 0
    for k, name in enumerate(problem.names):
        x = found.unknowns.cameras[k]
        gaps = found.residual[scene.camera == k]
        board = found.unknowns.boards[problem.boards.index(problem.owner(problem.reference(k)))]
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
