"""What single views of a flat board tell: an affine map, a tilt, and two rotations that look the same.

A view of the board plane is affine, u = A [X, Y] + t with A = K2 R[:2, :2]: its larger singular value is
the scale, and the ratio of the two the cosine of the tilt. Which way it tilts an orthographic view cannot
tell (Necker's reversal).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.board import View

from rafl.common.errors import InputError

Array = NDArray[Any]

FEWEST_VIEWS = 4
LEAST_TILT = np.radians(8.0)
DIRECTIONS = 3  # of tilt, this far apart:
APART = np.radians(20.0)


@dataclass(frozen=True)
class Affine:
    """One view's affine map u = matrix [X, Y] + shift, and what may lie behind it.

    Attributes:
        matrix: [px/m], (2, 2).
        shift: [px], (2).
        tilt: of the board against the picture [rad].
        direction: in the picture in which depth changes, up to half a turn [rad].
        rotations: the two from board to camera that show the same, the likelier first, (3, 3).
    """

    matrix: Array
    shift: Array
    tilt: float
    direction: float
    rotations: tuple[Array, Array]


def affine_of(view: View, scale: float | None = None) -> Affine:
    """The affine map of a view; `scale` [px/m] is the camera's, where all its views have told it."""
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
    return Affine(matrix, shift, tilt, float(np.arctan2(along[1], along[0]) % np.pi), (both[0], both[1]))


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
    affines = [affine_of(view) for view in views]
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


def farther_edge(turn: Array) -> tuple[int, float, str]:
    """Which way a flat board turned so (3, 3) tilts in the picture.

    Returns:
        +1 where the edge named is farther, -1 where it is nearer; the tilt [rad]; the edge, right or lower.
    """
    depth = turn[2, :2]
    along = turn[:2, :2] @ depth
    axis = int(abs(along[1]) > abs(along[0]))
    tilt = float(np.arcsin(np.clip(np.linalg.norm(depth), 0.0, 1.0)))
    return int(np.sign(along[axis])), tilt, ("right", "lower")[axis]


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
