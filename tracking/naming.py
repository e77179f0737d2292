"""Which dot is which marker of the layout."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from calibration.camera import Camera
from groundwork import InputError
from tracking.layout import MarkerLayout

Array = NDArray[Any]

NEAR = 0.4  # of the local spacing: how far a dot may be from where its neighbours put it
BEHIND = 0.3  # of the spacing: a marker nearer than this to one before it in the picture is covered
TURNS = np.radians(np.concatenate([[0], np.repeat(np.arange(15, 181, 15), 2) * np.tile([1, -1], 12)]))


def visible_markers(layout: MarkerLayout, camera: Camera) -> NDArray[np.int64]:
    """Indices of the markers on the side of the specimen that faces the camera.

    The sides are the flat parts of the layout's convex hull; of a layout in one plane all are seen that do not stand
    behind another.
    """
    points = layout.positions
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return _not_behind_others(layout, camera)
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    on = np.abs(points @ normals.T + offsets) < 1e-3 * np.ptp(points, axis=0).max()
    facing = normals @ camera.viewing_direction < -0.5
    return np.flatnonzero((on & facing).any(axis=1))


def _not_behind_others(layout: MarkerLayout, camera: Camera) -> NDArray[np.int64]:
    """Indices of the markers that no nearer marker covers."""
    pixels = camera.ideal(layout.positions)
    # Of a marker and its image on the far side the second nearest is a true neighbour.
    distances = cKDTree(pixels).query(pixels, min(3, len(pixels)))[0].reshape(len(pixels), -1)
    spacing = float(np.median(distances[:, -1]))
    kept: list[int] = []
    for marker in np.argsort(layout.positions @ camera.viewing_direction):
        if all(np.linalg.norm(pixels[marker] - pixels[other]) > BEHIND * spacing for other in kept):
            kept.append(int(marker))
    return np.sort(np.array(kept, dtype=np.int64))


def name_by_layout(dots: Array, layout: MarkerLayout, camera: Camera, what: str) -> list[int]:
    """The layout marker of each dot (-1 for none).

    A dot and a marker are taken to be the same, and names spread from there from neighbour to
    neighbour, each step trusting the local affine map; of all such beginnings the one that names
    most dots with the least bending wins. Only proper rotations are tried: a mirror image of the
    layout is no match.

    Args:
        dots: first frame [px], (D, 2).
        layout: of the whole specimen.
        camera: that filmed.
        what: video, for messages.

    Raises:
        InputError: fewer than three dots match the layout.
    """
    markers = visible_markers(layout, camera)
    if len(dots) > len(markers):  # the skin is hollow there, or spheres on stands are seen from behind
        markers = _not_behind_others(layout, camera)
    pixels = camera.undistort(dots)
    expected = camera.ideal(layout.positions[markers])
    size = max(float(np.ptp(expected, axis=0).max()), 1.0)
    best: tuple[float, dict[int, int]] = (-np.inf, {})
    complete = min(len(dots), len(markers))
    for turn in TURNS:
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        for matches in _beginnings(expected, pixels, rotation):
            # The calibrated position decides between a layout and its shifted copy.
            away = np.mean([np.linalg.norm(pixels[d] - expected[m]) for m, d in matches.items()])
            score = len(matches) - 0.3 * min(away / size, 1.0)
            if score > best[0]:
                best = (score, matches)
        if len(best[1]) == complete:
            break
    if len(best[1]) < 3:
        raise InputError(
            f"{what}: expected dots in the pattern of the specimen's markers, found {len(best[1])} of "
            f"{len(markers)} that match; check --specimen, and that calib.yaml belongs to this set-up"
        )
    names = [-1] * len(dots)
    for marker, dot in best[1].items():
        names[dot] = int(markers[marker])
    return names


def _beginnings(expected: Array, dots: Array, rotation: Array) -> list[dict[int, int]]:
    """Matches grown from every marker and its five likeliest dots."""
    turned = (expected - expected.mean(0)) @ rotation.T + expected.mean(0)
    likely = cKDTree(dots).query(turned, min(5, len(dots)))[1].reshape(len(expected), -1)
    grown = []
    for marker in range(0, len(expected), max(len(expected) // 8, 1)):
        for dot in likely[marker]:
            grown.append(_grow(expected, dots, rotation, marker, int(dot)))
            if len(grown[-1]) == min(len(dots), len(expected)):
                return grown
    return grown


def _grow(expected: Array, dots: Array, rotation: Array, marker: int, dot: int) -> dict[int, int]:
    tree = cKDTree(dots)
    between = np.linalg.norm(expected[:, None] - expected[None], axis=2)
    spacing = np.sort(between + np.diag(np.full(len(expected), np.inf)), axis=1)[:, 0]
    matches = {marker: dot}
    taken = {dot}
    rejected: set[int] = set()
    while len(matches) + len(rejected) < len(expected):
        known = np.array(list(matches))
        rest = [m for m in range(len(expected)) if m not in matches and m not in rejected]
        nearest = min(rest, key=lambda m: between[m, known].min())
        around = known[np.argsort(between[nearest, known])[:5]]
        prediction = _carried(expected, dots, rotation, matches, around, nearest)
        distance, found = tree.query(prediction)
        if distance < NEAR * spacing[nearest] and int(found) not in taken:
            matches[nearest] = int(found)
            taken.add(int(found))
        else:
            rejected.add(nearest)
    return matches


def _carried(
    expected: Array, dots: Array, rotation: Array, matches: dict[int, int], around: Array, marker: int
) -> Array:
    """Where the neighbours' affine map, drawn towards the start's rotation, puts a marker."""
    source = expected[around]
    target = dots[[matches[int(m)] for m in around]]
    weight = 1.0 / (1e-9 + np.linalg.norm(source - expected[marker], axis=1))
    weight /= weight.sum()
    source_mean, target_mean = weight @ source, weight @ target
    source, target = source - source_mean, target - target_mean
    size = (weight[:, None] * source**2).sum()
    ridge = 0.03 * size + 1e-9
    moment = (weight[:, None] * source).T @ source
    affine = ((weight[:, None] * target).T @ source + ridge * rotation) @ np.linalg.inv(moment + ridge * np.eye(2))
    return target_mean + affine @ (expected[marker] - source_mean)


def name_by_rows(dots: Array, late: int = 0) -> list[str]:
    """Names r1c1, r1c2, ... by row from the top and column from the left.

    Rows may be bent: each dot's neighbours say where the next of its row and column should be. Dots that
    stand in no such grid are ordered by their height, then from the left. The last `late` dots came into sight after
    the others: where they stand in no grid with them, they are a row of their own, after the others'.
    """
    places = _grid_places(dots)
    if places is None and late:
        names = name_by_rows(dots[:-late])
        last = max(int(name[1:].split("c")[0]) for name in names)
        return names + [f"r{last + 1}c{column + 1}" for column in range(late)]
    if places is None:
        spacing = float(np.median(cKDTree(dots).query(dots, 2)[0][:, 1]))
        order = np.argsort(dots[:, 1])
        row = np.empty(len(dots), dtype=int)
        row[order] = np.concatenate([[0], np.cumsum(np.diff(dots[order, 1]) > 0.4 * spacing)])
        column = np.empty(len(dots), dtype=int)
        for members in (np.flatnonzero(row == number) for number in range(row.max() + 1)):
            column[members[np.argsort(dots[members, 0])]] = np.arange(len(members))
        places = np.stack([row, column], axis=1)
    return [f"r{row + 1}c{column + 1}" for row, column in places]


def _grid_places(dots: Array) -> NDArray[np.int64] | None:
    """Row and column (D, 2) of dots in a grid, however bent; None where they are in none."""
    count = min(7, len(dots))
    tree = cKDTree(dots)
    nearest = tree.query(dots, count)[1][:, 1:]
    steps = (dots[nearest] - dots[:, None]).reshape(-1, 2)
    across, down = _grid_steps(steps)
    if across is None or down is None:
        return None
    places = np.full((len(dots), 2), np.iinfo(int).min)
    local = {}
    begin = int(np.argmin(np.linalg.norm(dots - dots.mean(0), axis=1)))
    places[begin] = 0
    local[begin] = (across, down)
    waiting = [begin]
    while waiting:
        dot = waiting.pop(0)
        for axis, sign in ((1, 1), (1, -1), (0, 1), (0, -1)):
            step = local[dot][0] if axis == 1 else local[dot][1]
            distance, other = tree.query(dots[dot] + sign * step)
            if distance > NEAR * np.linalg.norm(step):
                continue
            place = places[dot].copy()
            place[axis] += sign
            if other in local:
                if (places[other] != place).any():
                    return None
                continue
            places[other] = place
            found = sign * (dots[other] - dots[dot])
            # The grid turns from dot to dot: half of what this step says is believed.
            turned = 0.5 * (step + found)
            angle = np.arctan2(turned[1], turned[0]) - np.arctan2(step[1], step[0])
            spin = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            rest = spin @ (local[dot][1] if axis == 1 else local[dot][0])
            local[other] = (turned, rest) if axis == 1 else (rest, turned)
            waiting.append(other)
    if len(local) < len(dots) or len(np.unique(places, axis=0)) < len(dots):
        return None
    return places - places.min(axis=0)


def _grid_steps(steps: Array) -> tuple[Array | None, Array | None]:
    """The most frequent short steps along a row, to the right, and along a column, downwards."""
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
