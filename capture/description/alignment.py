"""Rigid transforms that put dots on the surface of a body, by the iterative closest point method."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.description.still import Dots
from rafl.capture.description.undeformed import Shape, carry_back
from rafl.capture.registration.rigid import IDENTITY, RigidTransform

Array = NDArray[Any]

MAX_STEPS = 50
STEP_TOLERANCE = 1e-5  # [m]; the alignment ends with smaller steps
# Singular values, relative to the largest, of motions that are left out: of those that the dots do not tell, and of
# those too that they tell only through the slight curvature of faces under load.
UNTOLD, HARDLY_TOLD = 1e-3, 2e-2
FACE_SIGMA = 1e-4  # of a face from where the size of the body says it is, at least [m]
# Rotations from the frame of a recording to one with z up: motion capture has z up, or y.
UPRIGHT = (np.eye(3), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))


@dataclass(frozen=True)
class Alignment:
    """Dots moved onto the surface of a body.

    Attributes:
        pose: from the frame of the dots to that of the body.
        distance: root mean square distance of the moved dots from the body [m].
        sigma: standard deviation of the place of each dot that the pose leaves [m], (M).
    """

    pose: RigidTransform
    distance: float
    sigma: Array


def align_with_surface(
    shape: Shape, q: Array, dots: Dots, start: RigidTransform = IDENTITY, least: float = UNTOLD
) -> Alignment:
    """The transform near `start` that puts the dots on the body, with point-to-plane steps (Chen and Medioni, 1992).

    Motions along all faces that hold dots are left at zero, and their standard deviation is infinite.

    Args:
        shape: of the undeformed body.
        q: its nodes as it is deformed [m], (N, 3).
        dots: to be moved.
        start: first guess.
        least: singular value, relative to the largest, of the motions that are allowed.
    """
    pose, length = start, float(np.ptp(shape.mesh.vertices, axis=0).max())
    for _ in range(MAX_STEPS):
        moved = dots.moved(pose)
        gap, towards = _gaps(shape, q, moved)
        middle = moved.position.mean(axis=0)
        arm = (moved.position - middle) / length
        jacobian = np.column_stack([np.cross(arm, towards), towards])
        step = np.linalg.lstsq(jacobian, -gap, rcond=least)[0]
        centred = RigidTransform(pose.rotation, pose.translation - middle)
        turned = centred.followed_by(np.concatenate([step[:3] / length, step[3:]]))
        pose = RigidTransform(turned.rotation, turned.translation + middle)
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    distance = float(np.sqrt(np.mean(_gaps(shape, q, dots.moved(pose))[0] ** 2)))
    _, values, motions = np.linalg.svd(jacobian)
    values = np.where(values > least * values[0], values, 0.0)
    motion = np.cross(motions[:, None, :3], arm) + motions[:, None, 3:]  # of each dot, (6, M, 3)
    with np.errstate(divide="ignore"):
        spread = max(distance, FACE_SIGMA) / values
    sigma = np.where(np.abs(motion) > 1e-9, spread[:, None, None] * np.abs(motion), 0.0)
    return Alignment(pose, distance, np.linalg.norm(sigma, axis=(0, 2)))


def _gaps(shape: Shape, q: Array, dots: Dots) -> tuple[Array, Array]:
    """Signed distances of dots from the body [m], (M), and the unit vectors along which they are taken, (M, 3)."""
    carried = carry_back(shape, q, dots)
    distance = np.linalg.norm(carried.gap, axis=1)
    towards = np.where((distance > STEP_TOLERANCE)[:, None], carried.gap, carried.direction)
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return (carried.gap * towards).sum(axis=1), towards


def find_pose(shape: Shape, q: Array, dots: Dots) -> Alignment:
    """The transform that puts dots on a body from any frame with z or y up.

    The longest direction of the dots across the vertical is tried along that of the body, either way round.

    Args:
        shape: of the undeformed body.
        q: its nodes as it is deformed [m], (N, 3).
        dots: in any frame.
    """
    surface = q[np.unique(shape.mesh.surface)]
    found = []
    for upright in UPRIGHT:
        own = dots.position @ upright.T
        angle = _heading(surface) - _heading(own)
        for turn in (angle, angle + np.pi):
            c, s = np.cos(turn), np.sin(turn)
            rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ upright
            start = RigidTransform(rotation, surface.mean(axis=0) - rotation @ dots.position.mean(axis=0))
            found.append(align_with_surface(shape, q, dots, start))
    return min(found, key=lambda alignment: alignment.distance)


def _heading(points: Array) -> float:
    """Angle about z of the longest horizontal direction of points (M, 3) [rad]."""
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    x, y = np.linalg.svd(flat, full_matrices=False)[2][0]
    return float(np.arctan2(y, x))
