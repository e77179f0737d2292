"""Assigning marker names to the dots of a first frame, by the specimen's layout or by row and column."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from rafl.calibration.camera import Camera, PinholeCamera, Plane
from rafl.calibration.rig import PLANE_SIGMA_MM, Rig
from rafl.common.errors import InputError
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.matching import MarkerPattern, match_at_rest

Array = NDArray[Any]

MIN_MATCHED_DOTS = 3
NEIGHBOUR_GATE = 0.4  # most distance of a dot from its predicted grid position [length of the grid step]
ON_FACE = 1e-3  # most distance of a marker from the face of a box that it lies on [m]
GRAZING = 0.17  # cosine of 80 degrees: a camera that looks along a face at less than 10 degrees does not see its dots
COVERED_SPACINGS = 0.3  # a marker nearer than this to one in front of it in the image is hidden
DISTANCE_COST = 0.05  # score lost by a dot one spacing from its position in the tried shape; a match scores 1
# Scores, relative to the largest possible one: the search ends after a group of shapes with GOOD_SCORE, and at once
# if the unbent shape reaches CERTAIN_FACTOR times that.
GOOD_SCORE, CERTAIN_FACTOR = 0.9, 1.07
TRIED_BENDS = np.radians(np.repeat(np.arange(15, 121, 15), 2) * np.tile([1, -1], 8))
TRIED_ROTATIONS = np.radians(np.repeat(np.arange(15, 181, 15), 2) * np.tile([1, -1], 12))
COMPACT_RATIO = 0.6  # layouts with a larger ratio of width to length are tried bent about either axis


def visible_markers(layout: MarkerLayout, camera: Camera) -> NDArray[np.int64]:
    """Indices of the markers on the side of the specimen that faces the camera.

    The sides are the flat parts of the layout's convex hull. If the layout lies in one plane, all markers are visible
    that no other one covers.
    """
    sides = _flat_sides(layout)
    if sides is None:
        return _uncovered_markers(layout, camera)
    normals, on = sides
    facing = normals @ camera.viewing_direction < -0.5
    return np.flatnonzero((on & facing).any(axis=1))


def _flat_sides(layout: MarkerLayout) -> tuple[Array, NDArray[np.bool_]] | None:
    """Outward normals (F, 3) of the layout's convex hull, and which markers lie on which of its flat parts, (M, F).

    None if the layout lies in one plane.
    """
    points = layout.positions
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    return normals, np.abs(points @ normals.T + offsets) < 1e-3 * np.ptp(points, axis=0).max()


def averted_markers(layout: MarkerLayout, cameras: Iterable[Camera]) -> dict[str, list[str]]:
    """Markers of the undeformed specimen whose faces look away from every camera: names by face, such as `y-max`.

    The faces are those of the box, or else the flat parts of the layout's convex hull, each named after the side that
    it looks to most. A marker that lies on none, or on one that a camera sees, is in none of the lists.
    """
    if layout.box is not None:
        normals = np.concatenate([-np.eye(3), np.eye(3)])
        outside = layout.positions @ normals.T - np.concatenate([np.zeros(3), layout.box])
        on = np.abs(outside) < ON_FACE
    elif (sides := _flat_sides(layout)) is not None:
        normals, on = sides
    else:
        return {}
    away = np.full(on.shape, np.inf)  # least cosine of the angle between a line of sight and a normal
    for camera in cameras:
        away = np.minimum(away, _lines_of_sight(camera, layout.positions) @ normals.T)
    averted = on.any(axis=1) & (~on | (away > -GRAZING)).all(axis=1)
    result: dict[str, list[str]] = {}
    for marker, face in enumerate(np.where(on, away, -np.inf).argmax(axis=1)):
        if averted[marker]:
            axis = int(np.abs(normals[face]).argmax())
            side = f"{'xyz'[axis]}-{'max' if normals[face, axis] > 0.0 else 'min'}"
            result.setdefault(side, []).append(layout.names[marker])
    return result


def _lines_of_sight(camera: Camera, points: Array) -> Array:
    """Unit vectors away from the camera along the lines of sight through points (M, 3) [m], (M, 3)."""
    slope = camera.projection_jacobian(points)
    along = np.cross(slope[:, 0], slope[:, 1])
    along *= np.sign(along @ camera.viewing_direction)[:, None]
    result: Array = along / np.linalg.norm(along, axis=1, keepdims=True)
    return result


def with_face_planes(rig: Rig, layout: MarkerLayout) -> Rig:
    """The rig with planes for cameras that have none and see markers that no other camera sees.

    The plane is that of the markers on the side of the undeformed specimen that faces the camera, if they lie in one.

    Raises:
        InputError: a pinhole camera has the specimen behind it, or wholly outside its image.
    """
    visible = {}
    for name, camera in rig.cameras.items():
        if isinstance(camera, PinholeCamera):
            _check_in_view(name, camera, layout)
        visible[name] = visible_markers(layout, camera)
    cameras = dict(rig.cameras)
    for name, camera in rig.cameras.items():
        shared = any(np.isin(visible[name], own).any() for other, own in visible.items() if other != name)
        if camera.plane is None and not shared and len(visible[name]) >= MIN_MATCHED_DOTS:
            points = layout.positions[visible[name]]
            middle = points.mean(axis=0)
            normal = np.linalg.svd(points - middle)[2][2]
            normal *= -np.sign(normal @ camera.viewing_direction)  # towards the camera
            if np.abs((points - middle) @ normal).max() <= 1e-3 * PLANE_SIGMA_MM:
                plane = Plane(tuple(normal.tolist()), float(normal @ middle), 1e-3 * PLANE_SIGMA_MM)
                cameras[name] = replace(camera, plane=plane)
    return Rig(cameras)


def _check_in_view(name: str, camera: PinholeCamera, layout: MarkerLayout) -> None:
    """Refuse a camera that cannot see the undeformed specimen: then the world is not the specimen frame."""
    depth = layout.positions @ camera.rotation[2] + camera.translation[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = camera.project_undistorted(layout.positions)
    inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < camera.image_size).all(axis=1)
    if not inside.any():
        raise InputError(
            f"camera {name}: expected the specimen in its image, found none of its markers there; the world of the "
            "calibration is not the specimen frame: place it with rafl-calibrate --from-rest REST --calib CALIBRATION"
        )


def _uncovered_markers(layout: MarkerLayout, camera: Camera) -> NDArray[np.int64]:
    """Indices of the markers that no marker nearer to the camera covers."""
    pixels = camera.project_undistorted(layout.positions)
    # The nearest may be the same marker's counterpart on the far side; the second nearest is a true neighbour.
    distances = cKDTree(pixels).query(pixels, min(3, len(pixels)))[0].reshape(len(pixels), -1)
    spacing = float(np.median(distances[:, -1]))
    kept: list[int] = []
    for marker in np.argsort(layout.positions @ camera.viewing_direction):
        if all(np.linalg.norm(pixels[marker] - pixels[other]) > COVERED_SPACINGS * spacing for other in kept):
            kept.append(int(marker))
    return np.sort(np.array(kept, dtype=np.int64))


def name_by_layout(dots: Array, layout: MarkerLayout, camera: Camera, source: str) -> list[int]:
    """The layout marker of each dot (-1 for none).

    The specimen may be strongly bent and filmed from any side. So many shapes and rotations of the layout are tried.
    From each, a match spreads from dot to dot (`rafl.tracking.linking.matching`). The best match names most dots with
    the least misfit, nearest to the shape tried. Only proper rotations are tried: a mirror image of the layout is no
    match.

    Args:
        dots: first frame [px], (D, 2).
        layout: of the whole specimen.
        camera: that filmed.
        source: name of the video, for messages.

    Raises:
        InputError: fewer than three dots match the layout, or the calibration gives no position for some.
    """
    markers, pixels = visible_markers(layout, camera), camera.undistort(dots)
    if not np.isfinite(pixels).all():
        raise InputError(
            f"{source}: expected a calibration whose distortion can be removed from every dot, found one that sends "
            "dots to infinity; check calib.yaml"
        )
    names = _match_layout(pixels, layout, camera, markers)
    if len(dots) > len(markers):  # static dots, a hollow body, or spheres on stands that are visible from behind
        more = _uncovered_markers(layout, camera)
        wider = _match_layout(pixels, layout, camera, more)
        named, unnamed = names >= 0, names < 0
        agreeing = (wider[named] == names[named]).mean() > GOOD_SCORE if named.any() else True
        if (agreeing or unnamed.sum() > named.sum()) and (wider[unnamed] >= 0).sum() > 0.5 * unnamed.sum():
            names, markers = wider, more
    matched = int((names >= 0).sum())
    if matched < MIN_MATCHED_DOTS:
        raise InputError(
            f"{source}: expected dots in the pattern of the specimen's markers, found {matched} of "
            f"{len(markers)} that match; check --specimen, and that calib.yaml belongs to this set-up "
            "(compare the images in rafl-review calib.yaml with the film)"
        )
    indices: list[int] = names.tolist()
    return indices


def _match_layout(pixels: Array, layout: MarkerLayout, camera: Camera, markers: NDArray[np.int64]) -> NDArray[np.int64]:
    """The layout marker, out of `markers`, of each dot (D, 2); (D), -1 for none."""
    expected = camera.project_undistorted(layout.positions[markers])
    best: tuple[float, Array] = (-np.inf, np.full(len(markers), -1))
    good_score = GOOD_SCORE * min(len(pixels), len(markers))
    distinct = len(markers) >= MIN_MATCHED_DOTS and np.ptp(expected, axis=0).max() > 1.0
    for shapes in _candidate_shapes(expected) if distinct else []:
        for shape in shapes:
            found = match_at_rest(MarkerPattern.of(shape), pixels, DISTANCE_COST)
            best = max(best, found, key=lambda pair: pair[0])
            if shape is expected and best[0] > CERTAIN_FACTOR * good_score:
                break
        if best[0] > good_score:
            break
    names = np.full(len(pixels), -1)
    names[best[1][best[1] >= 0]] = markers[best[1] >= 0]
    return names


def _candidate_shapes(expected: Array) -> Iterator[list[Array]]:
    """Tried positions of the markers in the image, (M, 2) each, in groups: bent; then rotated; then both."""
    bent = [expected, *_bend(expected, TRIED_BENDS)]
    yield bent
    rotated = [_rotate(expected, angle) for angle in TRIED_ROTATIONS]
    yield rotated
    yield [_rotate(shape, angle) for angle in TRIED_ROTATIONS[1::2] for shape in _bend(expected, TRIED_BENDS[1::3])]


def _rotate(positions: Array, angle: float) -> Array:
    """Positions (M, 2) rotated about their mean."""
    middle = positions.mean(axis=0)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rotated: Array = (positions - middle) @ rotation.T + middle
    return rotated


def _bend(positions: Array, angles: Array) -> list[Array]:
    """Positions (M, 2) on a body clamped at either end and bent, in or out of the image plane.

    `angles` [rad] are the slopes at the free end.
    """
    middle = positions.mean(axis=0)
    _, size, axes = np.linalg.svd(positions - middle, full_matrices=False)
    shapes = []
    for along in axes[: 2 if size[1] > COMPACT_RATIO * size[0] else 1]:
        across = np.array([-along[1], along[0]])
        s, h = (positions - middle) @ along, (positions - middle) @ across
        for end, direction in ((s.min(), 1.0), (s.max(), -1.0)):
            length = np.ptp(s)
            u = np.linspace(0.0, 1.0, 101)
            marker_u = direction * (s - end) / length
            for angle in angles:
                for profile in (2.0 * u - u**2, u):  # a load at the tip, and a pure moment
                    slope = angle * profile
                    steps = np.stack([np.cos(slope), np.sin(slope)], axis=1) * length / (len(u) - 1)
                    line = np.concatenate([[[0.0, 0.0]], np.cumsum(steps[:-1], axis=0)])
                    x, y, own = (np.interp(marker_u, u, values) for values in (*line.T, slope))
                    rotating = (x - h * direction * np.sin(own), y + h * direction * np.cos(own))
                    upright = (x, y + h * direction)  # in an oblique view, sections do not seem to rotate
                    out_of_plane = (x, h * direction)
                    for forth, side in (rotating, upright, out_of_plane):
                        offset = (end + direction * forth)[:, None] * along
                        shapes.append(middle + offset + (direction * side)[:, None] * across)
    return shapes


def name_by_rows(dots: Array, late_count: int = 0) -> list[str]:
    """Names r1c1, r1c2, ... by row from the top and column from the left.

    Rows may be bent: each dot's neighbours predict the next dot of its row and column. Dots that form no such grid are
    ordered by height, then from the left.

    Args:
        dots: [px], (D, 2).
        late_count: number of late-detected markers, the last dots. If these form no grid with the others, they get a
            row of their own after the others'.
    """
    indices = _grid_indices(dots)
    if indices is None and late_count:
        names = name_by_rows(dots[:-late_count])
        last = max(int(name[1:].split("c")[0]) for name in names)
        return names + [f"r{last + 1}c{column + 1}" for column in range(late_count)]
    return [f"r{row + 1}c{column + 1}" for row, column in rows_and_columns(dots)]


def is_row_name(name: str) -> bool:
    """Whether a marker's name is one of row and column, perhaps after a camera's: r1c2, left-r1c2."""
    return re.fullmatch(r"(.+-)?r\d+c\d+", name) is not None


def rows_and_columns(dots: Array) -> NDArray[np.int64]:
    """Row and column, from 0, of dots (D, 2), whose first coordinate grows along rows and the second from row to row.

    Dots that form no grid, which may be bent, are ordered by the second coordinate, then by the first.
    """
    if len(dots) == 1:
        return np.zeros((1, 2), dtype=np.int64)
    indices = _grid_indices(dots)
    if indices is None:
        spacing = float(np.median(cKDTree(dots).query(dots, 2)[0][:, 1]))
        order = np.argsort(dots[:, 1])
        row = np.empty(len(dots), dtype=int)
        row[order] = np.concatenate([[0], np.cumsum(np.diff(dots[order, 1]) > 0.4 * spacing)])
        column = np.empty(len(dots), dtype=int)
        for members in (np.flatnonzero(row == number) for number in range(row.max() + 1)):
            column[members[np.argsort(dots[members, 0])]] = np.arange(len(members))
        indices = np.stack([row, column], axis=1)
    return indices


def _grid_indices(dots: Array) -> NDArray[np.int64] | None:
    """Row and column (D, 2) of dots in a grid, which may be bent; None if they form no grid."""
    count = min(7, len(dots))
    tree = cKDTree(dots)
    nearest = tree.query(dots, count)[1][:, 1:]
    steps = (dots[nearest] - dots[:, None]).reshape(-1, 2)
    across, down = _grid_steps(steps)
    if across is None or down is None:
        return None
    indices = np.full((len(dots), 2), np.iinfo(int).min)
    local_steps = {}
    begin = int(np.argmin(np.linalg.norm(dots - dots.mean(0), axis=1)))
    indices[begin] = 0
    local_steps[begin] = (across, down)
    waiting = [begin]
    while waiting:
        dot = waiting.pop(0)
        for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):
            step = local_steps[dot][0] if axis == 1 else local_steps[dot][1]
            distance, other = tree.query(dots[dot] + sign * step)
            if distance > NEIGHBOUR_GATE * np.linalg.norm(step):
                continue
            index = indices[dot].copy()
            index[axis] += sign
            if other in local_steps:
                if (indices[other] != index).any():
                    return None
                continue
            indices[other] = index
            found = sign * (dots[other] - dots[dot])
            # The grid turns from dot to dot: average the former step and the one found.
            turned = 0.5 * (step + found)
            angle = np.arctan2(turned[1], turned[0]) - np.arctan2(step[1], step[0])
            rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            other_step = rotation @ (local_steps[dot][1] if axis == 1 else local_steps[dot][0])
            local_steps[other] = (turned, other_step) if axis == 1 else (other_step, turned)
            waiting.append(other)
    if len(local_steps) < len(dots) or len(np.unique(indices, axis=0)) < len(dots):
        return None
    grid: NDArray[np.int64] = indices - indices.min(axis=0)
    return grid


def _grid_steps(steps: Array) -> tuple[Array | None, Array | None]:
    """The typical step along a row, to the right, and along a column, downwards [px]; None if there are too few.

    `steps` (N, 2) are those from every dot to its nearest ones. The median of the shortest ones is taken.
    """
    result: list[Array | None] = []
    for axis in (0, 1):
        along = steps[np.abs(steps[:, axis]) > 1.2 * np.abs(steps[:, 1 - axis])]
        along = along * np.sign(along[:, axis : axis + 1])
        if len(along) < 2:
            result.append(None)
            continue
        length = np.linalg.norm(along, axis=1)
        short = along[length < 1.4 * np.quantile(length, 0.1)]
        result.append(np.median(short, axis=0))
    return result[0], result[1]
