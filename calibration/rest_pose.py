"""A camera from one look at points in known places: a specimen at rest, whose marker layout is known.

Square pixels, no skew and a lens without distortion are taken for granted; one look cannot tell. Markers on one
face show, as a flat board does, the same from two mirrored cameras.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.board import View
from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import PLANE_SIGMA_MM
from rafl.calibration.solve import SAME_WAY, WORSE
from rafl.calibration.views import affine_of, farther_edge
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError

Array = NDArray[Any]

FEWEST_POINTS = 6
FLAT = 0.02  # of the points' extent: what stands out of a plane by less counts as lying in it
PLAIN = 9.2  # how much better, in variances of a residual, a tilted camera must explain the points than a square one
UNSEEN = 3.0  # residuals by which a tilt must shorten a face to be noticed
OUTLYING = 2.5  # standard deviations from which a point counts less


@dataclass(frozen=True)
class RestCamera:
    """A camera and how well it explains its one look.

    Attributes:
        camera: with residual, covariance and the points' plane.
        tilt: of the points' face against the picture [rad].
        unsure: a tilt that would not have shown [rad]; 0 where a tilt did show.
    """

    camera: OrthographicCamera
    tilt: float
    unsure: float


def camera_from_points(
    points: Array, pixels: Array, image_size: tuple[int, int], name: str, tilt_sign: int | None = None
) -> RestCamera:
    """The orthographic camera that sees points (P, 3) [m] at pixels (P, 2).

    Args:
        points: on the specimen, which is the world.
        pixels: where they are seen.
        image_size: [px].
        name: of the camera, for messages.
        tilt_sign: which of two mirrored cameras is meant: +1 where the right edge (or, where the face is tilted more
            about the horizontal, the lower edge) is farther away.

    Raises:
        InputError: too few points, or two mirrored cameras that explain them alike.
    """
    if len(points) < FEWEST_POINTS:
        raise InputError(
            f"camera {name}: expected at least {FEWEST_POINTS} markers in known places, found {len(points)}; see that "
            "the whole face is in the picture, or calibrate with a board"
        )
    middle = points.mean(0)
    _, extent, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extent[1] < FLAT * extent[0]:
        raise InputError(f"camera {name}: expected markers that span a plane, found all in one line; use a board")
    face = axes * [[1.0], [1.0], [np.linalg.det(axes)]]  # rows: two directions in the face, and its normal
    view = View(name, name, (points - middle) @ face[:2].T, pixels, None)
    starts = [rotation @ face for rotation in affine_of(view).rotations]
    if extent[2] > FLAT * extent[0]:
        rows = np.linalg.lstsq(points - middle, pixels - pixels.mean(0), rcond=None)[0].T
        u, _, vt = np.linalg.svd(rows, full_matrices=False)
        starts.insert(0, np.vstack([u @ vt, np.cross((u @ vt)[0], (u @ vt)[1])]))
    found: list[_Fit] = []
    for start in starts:
        fit = _Fit.of(points - middle, pixels, start, tilted=True)
        if not any((fit.turn * other.turn.inv()).magnitude() < SAME_WAY for other in found):
            found.append(fit)
    best = min(fit.size for fit in found)
    likely = [fit for fit in found if fit.size < WORSE * best + 1e-6]
    unsure = 0.0
    if len(likely) > 1:
        square = _Fit.of(points - middle, pixels, _square_on(likely[0].turn.as_matrix(), face[2]), tilted=False)
        freedom = 2 * len(points) - 6
        if square.size**2 < best**2 * (1.0 + PLAIN / freedom):
            # A tilt t shortens the face by t^2 / 2 of its extent: fewer residuals than these go unseen.
            unsure = float(np.sqrt(2.0 * UNSEEN * square.size / (square.values[0] * extent[1])))
            likely = [square]
    if len(likely) > 1:
        edges = [farther_edge(fit.turn.as_matrix() @ face.T) for fit in likely]
        chosen = [fit for fit, (sign, _, _) in zip(likely, edges, strict=True) if sign == tilt_sign]
        if len(chosen) != 1:
            _, tilt, edge = edges[0]
            raise InputError(
                f"camera {name}: the face of the specimen is tilted by {np.degrees(tilt):.1f} degrees, and one "
                "orthographic picture of markers in one plane cannot tell which way; say "
                f"--tilt-sign {name}=+ if the face's {edge} edge is farther from the camera, {name}=- if nearer, or "
                "calibrate with a board"
            )
        likely = chosen
    return _rest_camera(likely[0], middle, face, extent[2] <= FLAT * extent[0], image_size, unsure)


@dataclass(frozen=True)
class _Fit:
    """Least squares of a scaled, turned and shifted view; values: scale [px/m], turn vector (3), shift [px] (2)."""

    values: Array
    covariance: Array
    size: float

    @property
    def turn(self) -> Rotation:
        return Rotation.from_rotvec(self.values[1:4])

    @classmethod
    def of(cls, points: Array, pixels: Array, start: Array, tilted: bool) -> "_Fit":
        """From a rotation to start at (3, 3); where not `tilted`, it only turns about the line of sight."""
        base = Rotation.from_matrix(start)
        free = [0, 1, 2, 3, 4, 5] if tilted else [0, 3, 4, 5]
        spread = np.sqrt(((pixels - pixels.mean(0)) ** 2).sum() / ((points @ start[:2].T) ** 2).sum())

        def values(x: Array) -> Array:
            full = np.array([1.0, 0.0, 0.0, 0.0, *pixels.mean(0)])
            full[free] = x
            turn = Rotation.from_rotvec(full[1:4]) * base
            return np.concatenate([[full[0] * spread], turn.as_rotvec(), full[4:]])

        def gaps(x: Array) -> Array:
            full = values(x)
            turn = Rotation.from_rotvec(full[1:4]).as_matrix()
            return (full[0] * points @ turn[:2].T + full[4:] - pixels).ravel()

        first = least_squares(gaps, np.array([1.0, 0.0, 0.0, 0.0, *pixels.mean(0)])[free], x_scale="jac")
        scatter = 1.4826 * float(np.median(np.abs(first.fun))) + 1e-6
        last = least_squares(gaps, first.x, x_scale="jac", loss="huber", f_scale=OUTLYING * scatter)
        size = float(np.sqrt((last.fun**2).mean()))
        slopes = np.array([(values(last.x + h) - values(last.x - h)) / 2e-6 for h in 1e-6 * np.eye(len(free))]).T
        variance = (last.fun**2).sum() / (len(last.fun) - len(free))
        covariance = variance * slopes @ np.linalg.pinv(last.jac.T @ last.jac) @ slopes.T
        return cls(values(last.x), covariance, size)


def _square_on(turn: Array, normal: Array) -> Array:
    """The rotation nearest to `turn` that looks straight along the face's normal."""
    seen = turn @ normal
    straight = np.array([0.0, 0.0, np.sign(seen[2]) or 1.0])
    axis = np.cross(seen, straight)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return turn
    return Rotation.from_rotvec(np.arcsin(min(sine, 1.0)) * axis / sine).as_matrix() @ turn


def _rest_camera(
    fit: _Fit, middle: Array, face: Array, flat: bool, image_size: tuple[int, int], unsure: float
) -> RestCamera:
    scale, turn = float(fit.values[0]), fit.turn.as_matrix()
    offset = fit.values[4:] - scale * turn[:2] @ middle
    # Of mx, my, skew, turn, offset, k1, k2 in px/mm, rad and px; the offset is at the world's origin.
    slopes = np.zeros((10, 6))
    slopes[0, 0] = slopes[1, 0] = 1e-3
    slopes[3:6, 1:4] = np.eye(3)
    slopes[6:8, 4:] = np.eye(2)
    slopes[6:8, 0] = -turn[:2] @ middle
    for k, h in enumerate(1e-6 * np.eye(3)):
        moved = Rotation.from_rotvec(fit.values[1:4] + h).as_matrix()
        slopes[6:8, 1 + k] = -scale * (moved - turn)[:2] @ middle / 1e-6
    covariance = slopes @ fit.covariance @ slopes.T
    normal = face[2]
    plane = Plane(tuple(normal.tolist()), float(normal @ middle), 1e-3 * PLANE_SIGMA_MM) if flat else None
    camera = OrthographicCamera(
        image_size=image_size,
        scale=(scale, scale),
        rotation_vector=tuple(fit.values[1:4].tolist()),
        offset=tuple(offset.tolist()),
        plane=plane,
        residual=fit.size,
        covariance=tuple(map(tuple, covariance.tolist())),
    )
    tilt = float(np.arccos(np.clip(abs(turn[2] @ normal), 0.0, 1.0)))
    return RestCamera(camera, tilt, unsure)
