"""A rigid transform that puts dots on the surface of a body, by the iterative closest point method."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.description.still import Dots
from rafl.capture.description.undeformed import Shape, carry_back
from rafl.capture.registration.rigid import IDENTITY, RigidTransform

Array = NDArray[Any]

MAX_STEPS = 50
STEP_TOLERANCE = 1e-6  # [m]
MIN_SINGULAR_VALUE = 1e-3  # relative to the largest: motions that the dots tell less of are left out


def align_with_surface(shape: Shape, q: Array, dots: Dots, start: RigidTransform = IDENTITY) -> RigidTransform:
    """The transform near `start` that puts the dots on the body, with point-to-plane steps (Chen and Medioni, 1992).

    Motions along the faces that hold the dots change nothing, and are left at zero.

    Args:
        shape: of the undeformed body.
        q: its nodes as it is deformed [m], (N, 3).
        dots: to be moved.
        start: first guess.
    """
    pose, length = start, float(np.ptp(shape.mesh.vertices, axis=0).max())
    for _ in range(MAX_STEPS):
        moved = pose.apply(dots.position)
        carried = carry_back(shape, q, replace(dots, position=moved))
        distance = np.linalg.norm(carried.gap, axis=1)
        towards = np.where((distance > STEP_TOLERANCE)[:, None], carried.gap, carried.direction)
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        centre = moved.mean(axis=0)
        jacobian = np.column_stack([np.cross(moved - centre, towards) / length, towards])
        step = np.linalg.lstsq(jacobian, -(carried.gap * towards).sum(axis=1), rcond=MIN_SINGULAR_VALUE)[0]
        about_centre = RigidTransform(pose.rotation, pose.translation - centre)
        turned = about_centre.followed_by(np.concatenate([step[:3] / length, step[3:]]))
        pose = RigidTransform(turned.rotation, turned.translation + centre)
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return pose
