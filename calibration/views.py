"""Single views of a flat board: the affine map, the tilt, and the two rotations that the view allows.

An orthographic view of the board plane is affine: u = A [X, Y] + t with A = K2 R[:2, :2]. The larger singular value of
A is the scale; the ratio of the two is the cosine of the tilt. The sign of the tilt is ambiguous (Necker reversal).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.board import View
from rafl.common.errors import InputError

Array = NDArray[Any]

MIN_VIEWS = 4
MIN_TILT = np.radians(8.0)  # a view tilted less does not count as tilted
MIN_TILT_DIRECTIONS = 3
DIRECTION_SEPARATION = np.radians(20.0)  # tilt directions closer than this count as one


@dataclass(frozen=True)
class AffineView:
    """The affine map u = matrix [X, Y] + shift of one view, and the board rotations that explain it.

    Attributes:
        matrix: [px/m], (2, 2).
        shift: [px], (2).
        tilt: angle between the board and the image plane [rad].
        direction: direction in the image in which depth changes [rad], modulo pi.
        rotations: the two rotations (3, 3) from board to camera with this map, the more likely one first.
    """

    matrix: Array
    shift: Array
    tilt: float
    direction: float
    rotations: tuple[Array, Array]


def fit_affine(view: View, scale: float | None = None) -> AffineView:
    """Fit the affine map of a view. `scale` is the camera's scale [px/m]; None to estimate it from this view."""
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
    # The perspective of a real lens makes the farther side smaller; this decides which rotation is more likely.
    sign = 1.0 if depth @ _perspective_gradient(view) >= 0.0 else -1.0
    rotations = tuple(_nearest_rotation(block, side * depth) for side in (sign, -sign))
    return AffineView(matrix, shift, tilt, float(np.arctan2(along[1], along[0]) % np.pi), (rotations[0], rotations[1]))


def _perspective_gradient(view: View) -> Array:
    """Relative shrinkage of the image along the board axes [1/m], (2): the last row of the view's homography."""
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
    gradient: Array = h[6:8] / (h[8] * size)
    return gradient


def _nearest_rotation(block: Array, depth: Array) -> Array:
    """The rotation (3, 3) nearest to two columns with the upper parts `block` (2, 2) and last row `depth` (2)."""
    first, second = np.append(block[:, 0], depth[0]), np.append(block[:, 1], depth[1])
    guess = np.stack([first, second, np.cross(first, second)], axis=1)
    u, _, vt = np.linalg.svd(guess)
    rotation: Array = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation


def check_views(camera: str, views: list[View], model: str) -> None:
    """Check that a camera can be calibrated from its views.

    Tilts matter to the orthographic model. A pinhole camera is determined by perspective, which `solve_rig` checks.

    Raises:
        InputError: there are too few views, too few tilted views, or too few directions of tilt.
    """
    advice = "tilt the board by 10 to 40 degrees about three directions"
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"camera {camera}: expected at least {MIN_VIEWS} images that show the board, found {len(views)}; check the "
            f"pattern in board.yaml, and {advice}"
        )
    if model == "pinhole":
        return
    advice += ", or calibrate a camera near the board with --model pinhole"
    affines = [fit_affine(view) for view in views]
    tilted = [affine for affine in affines if affine.tilt > MIN_TILT]
    if len(tilted) < MIN_TILT_DIRECTIONS:
        raise InputError(
            f"camera {camera}: expected at least three views tilted by more than {np.degrees(MIN_TILT):.0f} degrees, "
            f"found tilts of {', '.join(f'{np.degrees(a.tilt):.0f}' for a in affines)} degrees; {advice}"
        )
    count = _count_directions([affine.direction for affine in tilted])
    if count < MIN_TILT_DIRECTIONS:
        raise InputError(
            f"camera {camera}: expected the board tilted about at least three directions "
            f"{np.degrees(DIRECTION_SEPARATION):.0f} degrees apart, found {count}; {advice}"
        )


def farther_edge(rotation: Array) -> tuple[int, float, str]:
    """Which edge of a board with this board-to-camera rotation (3, 3) is farther from the camera.

    Returns:
        +1 if the named edge is farther, -1 if it is nearer; the tilt [rad]; the name of the edge, right or lower.
    """
    depth = rotation[2, :2]
    along = rotation[:2, :2] @ depth
    axis = int(abs(along[1]) > abs(along[0]))
    tilt = float(np.arcsin(np.clip(np.linalg.norm(depth), 0.0, 1.0)))
    return int(np.sign(along[axis])), tilt, ("right", "lower")[axis]


def _count_directions(directions: list[float]) -> int:
    """Largest number of these directions [rad], modulo pi, that are `DIRECTION_SEPARATION` apart from each other."""
    most = 0
    for first in directions:
        kept = [first]
        for other in sorted((d - first) % np.pi for d in directions):
            angle = first + other
            gaps = [abs((angle - k + np.pi / 2) % np.pi - np.pi / 2) for k in kept]
            if min(gaps) >= DIRECTION_SEPARATION:
                kept.append(angle)
        most = max(most, len(kept))
    return most
