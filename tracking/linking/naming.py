"""Which dot is which marker of the layout."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.camera import Camera
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.matching import Pattern, match_shape
from scipy.spatial import ConvexHull, QhullError, cKDTree

from rafl.common.errors import InputError

Array = NDArray[Any]

FEWEST = 3  # dots that make a pattern
NEAR = 0.4  # of the local spacing: how far a dot may be from where its neighbours put it
BEHIND = 0.3  # of the spacing: a marker nearer than this to one before it in the picture is covered
FAR = 0.05  # of a dot: what one that stands a spacing from its guessed place counts less
ENOUGH, SURE = 0.9, 1.07  # of all that may match: a score that ends the search, and, times that, ends it at once
BENDS = np.radians(np.repeat(np.arange(15, 121, 15), 2) * np.tile([1, -1], 8))
TURNS = np.radians(np.repeat(np.arange(15, 181, 15), 2) * np.tile([1, -1], 12))
COMPACT = 0.6  # ratio of a layout's width and length, beyond which it may bend about either


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

    The specimen may be bent far and filmed from any side: from many guesses of how it stands, names spread from dot to
    dot (`rafl.tracking.linking.matching`), and the guess wins that names most dots with the least strain, nearest to where it puts
    them. Only proper rotations are tried: a mirror image of the layout is no match.

    Args:
        dots: first frame [px], (D, 2).
        layout: of the whole specimen.
        camera: that filmed.
        what: video, for messages.

    Raises:
        InputError: fewer than three dots match the layout.
    """
    markers, pixels = visible_markers(layout, camera), camera.undistort(dots)
    names = _named(pixels, layout, camera, markers)
    if len(dots) > len(markers):  # marks on the frame; or the skin is hollow, or spheres on stands are seen from behind
        more = _not_behind_others(layout, camera)
        wider = _named(pixels, layout, camera, more)
        named, left = names >= 0, names < 0
        agreeing = (wider[named] == names[named]).mean() > ENOUGH if named.any() else True
        if (agreeing or left.sum() > named.sum()) and (wider[left] >= 0).sum() > 0.5 * left.sum():
            names, markers = wider, more
    matched = int((names >= 0).sum())
    if matched < FEWEST:
        raise InputError(
            f"{what}: expected dots in the pattern of the specimen's markers, found {matched} of "
            f"{len(markers)} that match; check --specimen, and that calib.yaml belongs to this set-up"
        )
    return names.tolist()


def _named(pixels: Array, layout: MarkerLayout, camera: Camera, markers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which of some of the layout's markers each dot (D, 2) is, (D), -1 for none."""
    expected = camera.ideal(layout.positions[markers])
    best: tuple[float, Array] = (-np.inf, np.full(len(markers), -1))
    enough = ENOUGH * min(len(pixels), len(markers))
    apart = len(markers) >= FEWEST and np.ptp(expected, axis=0).max() > 1.0
    for shapes in _guesses(expected) if apart else []:
        for shape in shapes:
            found = match_shape(Pattern.of(shape), pixels, FAR)
            best = max(best, found, key=lambda pair: pair[0])
            if shape is expected and best[0] > SURE * enough:
                break
        if best[0] > enough:
            break
    names = np.full(len(pixels), -1)
    names[best[1][best[1] >= 0]] = markers[best[1] >= 0]
    return names


def _guesses(expected: Array) -> Iterator[list[Array]]:
    """How the markers may stand in the picture, (M, 2) each: first bent more or less, then turned, then both."""
    bends = [expected, *_bent(expected, BENDS)]
    yield bends
    turned = [_turned(expected, turn) for turn in TURNS]
    yield turned
    yield [_turned(shape, turn) for turn in TURNS[1::2] for shape in _bent(expected, BENDS[1::3])]


def _turned(places: Array, turn: float) -> Array:
    middle = places.mean(axis=0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return (places - middle) @ rotation.T + middle


def _bent(places: Array, angles: Array) -> list[Array]:
    """Places on a body that is held at either end and bent in the picture, or out of it, by angles at the other."""
    middle = places.mean(axis=0)
    _, size, axes = np.linalg.svd(places - middle, full_matrices=False)
    shapes = []
    for along in axes[: 2 if size[1] > COMPACT * size[0] else 1]:
        across = np.array([-along[1], along[0]])
        s, h = (places - middle) @ along, (places - middle) @ across
        for end, way in ((s.min(), 1.0), (s.max(), -1.0)):
            length = np.ptp(s)
            u = np.linspace(0.0, 1.0, 101)
            mine = way * (s - end) / length
            for angle in angles:
                for form in (2.0 * u - u**2, u):  # a load at the tip, and a pure moment
                    slope = angle * form
                    steps = np.stack([np.cos(slope), np.sin(slope)], axis=1) * length / (len(u) - 1)
                    line = np.concatenate([[[0.0, 0.0]], np.cumsum(steps[:-1], axis=0)])
                    x, y, own = (np.interp(mine, u, values) for values in (*line.T, slope))
                    turning = (x - h * way * np.sin(own), y + h * way * np.cos(own))
                    upright = (x, y + h * way)  # seen aslant, sections do not seem to turn
                    out_of_it = (x, h * way)
                    for forth, side in (turning, upright, out_of_it):
                        shapes.append(middle + (end + way * forth)[:, None] * along + (way * side)[:, None] * across)
    return shapes


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
