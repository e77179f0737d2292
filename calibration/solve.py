"""Calibration of a rig of cameras from views of flat boards.

Orthographic views of one camera do not determine the sign of the tilt of a board, however many there are. The bundle
adjustment therefore starts from every mirrored rig. A solution is accepted only if no other one explains the views.
"""

import itertools
from collections import ChainMap
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.calibration.board import BoardFile, View
from rafl.calibration.bundle import INVERSE_DISTANCE, LENS, Adjustment, Observations, adjust_bundle, move_points
from rafl.calibration.camera import (
    Camera,
    OrthographicCamera,
    Perspective,
    PinholeCamera,
    Plane,
    centre_and_half_diagonal,
)
from rafl.calibration.initial_guess import (
    CameraGroup,
    collect_observations,
    initial_rotations,
    initial_unknowns,
    perspective_unknowns,
)
from rafl.calibration.rig import PLANE_SIGMA_MM, Rig
from rafl.calibration.views import check_views, farther_edge
from rafl.common.errors import InputError

Array = NDArray[Any]

SAME_ROTATION = np.radians(0.5)  # rotations closer than this count as one solution
MAX_RESIDUAL_RATIO = 1.3  # a solution whose residual is this many times the best one is rejected
MIN_PERSPECTIVE_SIGMAS = 4.0  # an inverse distance of more sigmas shows perspective
BOARD_ROUNDS = 5  # of moving the points of the board and adjusting the rest; then the residual changes by 1 % a round
COVARIANCE_PARAMETERS = 10  # camera parameters in the covariance in calib.yaml


@dataclass(frozen=True)
class Solution:
    """A calibrated rig and its residuals.

    Attributes:
        rig: cameras with residual, covariance and plane.
        view_residuals: RMS residual of each view [px].
        tilts: angle between the board and the image plane in each view [rad].
        inverse_distances: of each camera, 1 / distance from the world origin and its sigma [1/m]; 0 for an
            orthographic lens.
        board_error: RMS distance of the board's points from where its description puts them [m], if the views show it.
    """

    rig: Rig
    view_residuals: dict[str, float]
    tilts: dict[str, float]
    inverse_distances: dict[str, tuple[float, float]]
    board_error: float = 0.0

    def perspective_bias(self, camera: str, depth: float) -> float:
        """Position error [m] from perspective, of a marker at the image border and `depth` [m] off its plane."""
        model = self.rig.cameras[camera]
        pixels_per_metre = float(np.linalg.norm(model.projection_jacobian(np.zeros(3))[0]))
        return abs(self.inverse_distances[camera][0]) * depth * 0.5 * max(model.image_size) / pixels_per_metre


def solve_rig(
    views: dict[str, list[View]],
    sizes: dict[str, tuple[int, int]],
    description: BoardFile,
    tilt_signs: dict[str, int],
    model: str = "orthographic",
) -> Solution:
    """Calibrate all cameras of a rig from their views of the board.

    Cameras that share board poses form a group. If no view of a group has a known pose, the board in its first view is
    the world frame. A camera's plane is the plane of its first board of known pose.

    Args:
        views: by camera.
        sizes: image size of each camera [px].
        description: the board and its known poses.
        tilt_signs: by camera, the choice between two mirrored solutions: +1 if the right edge of its reference board
            is farther away (or the lower edge, if the board is tilted more about the horizontal), else -1.
        model: `orthographic` or `pinhole`.

    Raises:
        InputError: the views do not determine the cameras, or leave a mirror ambiguity.
    """
    for name, own in views.items():
        check_views(name, own, model)
    solutions = [
        _solve_group(CameraGroup.of(names, views, sizes, description), tilt_signs, model)
        for names in _connected_cameras(views)
    ]
    cameras = dict(ChainMap(*(solution.rig.cameras for solution in solutions)))
    return Solution(
        Rig({name: cameras[name] for name in views}),
        dict(ChainMap(*(solution.view_residuals for solution in solutions))),
        dict(ChainMap(*(solution.tilts for solution in solutions))),
        dict(ChainMap(*(solution.inverse_distances for solution in solutions))),
        max(solution.board_error for solution in solutions),
    )


def _connected_cameras(views: dict[str, list[View]]) -> list[list[str]]:
    """Groups of cameras that are connected by shared board poses."""
    groups: list[list[str]] = []
    for name, own in views.items():
        keys = {view.pose_key for view in own}
        touching = [group for group in groups if any(keys & {v.pose_key for v in views[n]} for n in group)]
        groups = [group for group in groups if group not in touching]
        groups.append([*itertools.chain(*touching), name])
    return groups


def _solve_group(group: CameraGroup, tilt_signs: dict[str, int], model: str) -> Solution:
    observations = collect_observations(group)
    candidates: list[Adjustment] = []
    starts = [initial_unknowns(group, rotations) for rotations in initial_rotations(group)]
    near = perspective_unknowns(group) if model == "pinhole" else None
    for start in [near, *starts] if near else starts:
        found = adjust_bundle(observations, start, perspective=model == "pinhole")
        if (found.unknowns.distances < 0).any() or not np.isfinite(found.robust_rms):
            continue
        if not any(_same_rotations(found, other) for other in candidates):
            candidates.append(found)
    if not candidates:
        raise InputError(
            f"cameras {', '.join(group.names)}: expected views that one rig explains, found none; check the poses "
            "under `world` and the directions under `moved` in board.yaml"
        )
    chosen = _choose_solution(group, observations, candidates, tilt_signs)
    pinhole = chosen if model == "pinhole" else adjust_bundle(observations, chosen.unknowns, perspective=True)
    inverse_distances = _inverse_distances(group, pinhole)
    board_error = 0.0
    if model == "pinhole":
        for name, (inverse_distance, sigma) in inverse_distances.items():
            if not inverse_distance > MIN_PERSPECTIVE_SIGMAS * sigma:
                raise InputError(
                    f"camera {name}: expected views with enough perspective to determine the distance of the camera, "
                    "found too little; use the orthographic model, or tilt the board more"
                )
        chosen, board_error = _fit_board(observations, _fit_lens(observations, chosen))
        inverse_distances = _inverse_distances(group, chosen)
    solution = _build_solution(group, observations, chosen, inverse_distances, model)
    if model == "orthographic":
        solution = replace(solution, rig=_with_perspective(solution, observations, pinhole))
    return replace(solution, board_error=board_error)


def _with_perspective(solution: Solution, observations: Observations, pinhole: Adjustment) -> Rig:
    """The orthographic cameras with the perspective that a pinhole adjustment of the same views shows significantly."""
    cameras = dict(solution.rig.cameras)
    for k, (name, camera) in enumerate(solution.rig.cameras.items()):
        inverse_distance, sigma = solution.inverse_distances[name]
        assert isinstance(camera, OrthographicCamera)
        if inverse_distance > MIN_PERSPECTIVE_SIGMAS * sigma:
            # The pinhole's scale is that at the world origin, and falls with 1 + depth / distance.
            scale = 1e3 * pinhole.unknowns.cameras[k, :2].mean()
            depth = (scale / np.mean(camera.scale) - 1.0) / inverse_distance
            centre = observations.pixels[observations.camera == k].mean(axis=0)
            perspective = Perspective(1.0 / inverse_distance, float(depth), tuple(centre.tolist()))
            cameras[name] = replace(camera, perspective=perspective)
    return Rig(cameras)


def _inverse_distances(group: CameraGroup, found: Adjustment) -> dict[str, tuple[float, float]]:
    """Inverse distance [1/m] of each camera and its sigma, by name."""
    values = found.unknowns.cameras[:, INVERSE_DISTANCE]
    sigmas = np.sqrt(found.covariance[:, INVERSE_DISTANCE, INVERSE_DISTANCE])
    return {name: (float(values[k]), float(sigmas[k])) for k, name in enumerate(group.names)}


def _fit_lens(observations: Observations, simple: Adjustment) -> Adjustment:
    """A pinhole adjustment with the centres, p1, p2 and k3 free, if the views support these parameters."""
    found = adjust_bundle(observations, simple.unknowns, perspective=True, lens=True)
    parameters = len(simple.unknowns.cameras) * (LENS.stop - LENS.start)
    return found if _is_supported(observations, simple, found, parameters) else simple


def _fit_board(observations: Observations, simple: Adjustment) -> tuple[Adjustment, float]:
    """A pinhole adjustment with the points of the board free in its plane, if the views support that.

    Returns:
        The adjustment, and the RMS distance [m] of the points from where the description puts them; 0 if not supported.
    """
    described, names = np.unique(np.round(observations.points, 7), axis=0, return_inverse=True)
    moved, found = observations, simple
    lens = bool(simple.unknowns.cameras[:, LENS].any())
    for _ in range(BOARD_ROUNDS):
        moved = move_points(moved, found, names.ravel())
        found = adjust_bundle(moved, found.unknowns, perspective=True, lens=lens)
    if not _is_supported(observations, simple, found, 2 * len(described) - 6):
        return simple, 0.0
    return found, float(np.sqrt(((moved.points - observations.points) ** 2).sum(axis=1).mean()))


def _is_supported(observations: Observations, simple: Adjustment, found: Adjustment, parameters: int) -> bool:
    """Whether Bayes' information criterion (Schwarz, Annals of Statistics 6, 1978) is lower with more parameters."""
    count = observations.pixels.size
    gain = 2.0 * count * np.log(simple.robust_rms / max(found.robust_rms, 1e-12))
    return bool(gain > parameters * np.log(count))


def _same_rotations(one: Adjustment, other: Adjustment) -> bool:
    rotations = [Rotation.from_rotvec(found.unknowns.cameras[:, 3:6]) for found in (one, other)]
    return bool(((rotations[0] * rotations[1].inv()).magnitude() < SAME_ROTATION).all())


def _choose_solution(
    group: CameraGroup, observations: Observations, candidates: list[Adjustment], tilt_signs: dict[str, int]
) -> Adjustment:
    """The only solution that explains the views, or the one that the tilt signs select.

    Raises:
        InputError: several solutions remain.
    """
    plausible = _plausible(candidates)
    if len(plausible) > 1:
        # The perspective of a real lens may resolve an ambiguity of the orthographic model: only a solution in front of
        # the camera has a positive distance.
        pinhole = [adjust_bundle(observations, found.unknowns, perspective=True) for found in plausible]
        best = [found for found in _plausible(pinhole) if not _is_behind(found)]
        if len(best) == 1:
            plausible = [found for found, other in zip(plausible, pinhole, strict=True) if other is best[0]]
    for camera, name in enumerate(group.names):
        if name in tilt_signs and len(plausible) > 1:
            plausible = [found for found in plausible if _reference_tilt(group, found, camera)[0] == tilt_signs[name]]
    if len(plausible) == 1:
        return plausible[0]
    if not plausible:
        raise InputError("--tilt-sign: expected a sign that agrees with the views, found the opposite; leave it out")
    signs = [{_reference_tilt(group, found, camera)[0] for found in plausible} for camera in range(len(group.names))]
    ambiguous = int(np.argmax([len(of_camera) for of_camera in signs]))
    name = group.names[ambiguous]
    _, view, tilt, edge = _reference_tilt(group, plausible[0], ambiguous)
    raise InputError(
        f"camera {name}: the board in {view} is tilted by {np.degrees(tilt):.1f} degrees, and orthographic images do "
        "not show which way; take a second image with the board moved along its normal and list it under `world` "
        f"(distance known) or `moved` (direction known) in board.yaml, or give --tilt-sign {name}=+ if the {edge} edge "
        f"of the board is farther from the camera, {name}=- if it is nearer"
    )


def _is_behind(found: Adjustment) -> bool:
    """Whether perspective shows a board behind a camera: the mirror image of the true solution."""
    values = found.unknowns.cameras[:, INVERSE_DISTANCE]
    sigmas = np.sqrt(found.covariance[:, INVERSE_DISTANCE, INVERSE_DISTANCE])
    return bool((values < -MIN_PERSPECTIVE_SIGMAS * sigmas).any())


def _plausible(candidates: list[Adjustment]) -> list[Adjustment]:
    best = min(found.robust_rms for found in candidates)
    return [found for found in candidates if found.robust_rms < MAX_RESIDUAL_RATIO * best + 1e-6]


def _reference_tilt(group: CameraGroup, found: Adjustment, camera: int) -> tuple[int, str, float, str]:
    """Tilt of the camera's reference board: the sign, the view, the tilt [rad], and the edge that is farther at +1."""
    view = group.reference_view(camera)
    pose = group.pose_keys.index(group.base_key(view))
    rotation = Rotation.from_rotvec(found.unknowns.cameras[camera, 3:6]).as_matrix()
    rotation = rotation @ Rotation.from_rotvec(found.unknowns.poses[pose, :3]).as_matrix()
    sign, tilt, edge = farther_edge(rotation)
    return sign, view.name, tilt, edge


def _build_solution(
    group: CameraGroup,
    observations: Observations,
    found: Adjustment,
    inverse_distances: dict[str, tuple[float, float]],
    model: str,
) -> Solution:
    cameras: dict[str, Camera] = {}
    view_residuals, tilts = {}, {}
    first = 0
    for k, name in enumerate(group.names):
        x = found.unknowns.cameras[k]
        residuals = found.residual[observations.camera == k]
        pose = found.unknowns.poses[group.pose_keys.index(group.base_key(group.reference_view(k)))]
        normal = Rotation.from_rotvec(pose[:3]).as_matrix()[:, 2]
        plane = Plane(tuple(normal.tolist()), float(normal @ pose[3:]), 1e-3 * PLANE_SIGMA_MM)
        centre, half_diagonal = centre_and_half_diagonal(group.sizes[k])
        rms = float(np.sqrt((residuals**2).mean()))
        vector = tuple(x[3:6].tolist())
        if model == "orthographic":
            covariance = found.covariance[k][:COVARIANCE_PARAMETERS, :COVARIANCE_PARAMETERS]
            cameras[name] = OrthographicCamera(
                image_size=group.sizes[k],
                rotation_vector=vector,
                scale=(1e3 * x[0], 1e3 * x[1]),
                skew=1e3 * x[2],
                offset=tuple((centre + x[6:8]).tolist()),
                distortion=(float(x[8]), float(x[9])),
                plane=plane,
                residual=rms,
                covariance=tuple(map(tuple, covariance.tolist())),
            )
        else:
            focal = 1e3 * x[:2] / x[INVERSE_DISTANCE]
            ratio = focal.mean() / half_diagonal  # the pinhole model's distortion is in units of the focal length
            cameras[name] = PinholeCamera(
                image_size=group.sizes[k],
                rotation_vector=vector,
                focal=tuple(focal.tolist()),
                centre=tuple((centre + x[11:13]).tolist()),
                translation=(x[6] / (1e3 * x[0]), x[7] / (1e3 * x[1]), 1.0 / x[INVERSE_DISTANCE]),
                distortion=tuple((x[[8, 9, 13, 14, 15]] * ratio ** np.array([2, 4, 1, 1, 6])).tolist()),
                plane=plane,
                residual=rms,
            )
        for view, affine in zip(group.views[k], group.affines[k], strict=True):
            part = found.residual[first : first + len(view.points)]
            view_residuals[view.name] = float(np.sqrt((part**2).mean()))
            tilts[view.name] = affine.tilt
            first += len(view.points)
    return Solution(Rig(cameras), view_residuals, tilts, inverse_distances)
