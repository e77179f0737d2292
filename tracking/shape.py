"""Recognising the markers' pattern after the body that carries them has moved and bent.

Dots all look alike, and from one picture to the next they may move farther than they stand apart: the
nearest dot is often another marker's. But the markers sit on one smooth body. So a marker and a dot are
taken to be the same, and the match spreads from neighbour to neighbour, each step trusting the affine map
of the matches around it. Of all such beginnings the one wins that explains most dots and is nearest to
where motion puts them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracking.affine import STIFFNESS

Array = NDArray[Any]

NEIGHBOURS = 8
GATE = 0.36  # of a marker's spacing: how far from where its neighbours put it a dot may be
FAR = 0.12  # of a marker: what a dot one spacing from its expected place costs, where motion is known
TURNS = np.radians([0.0, 15.0, -15.0, 30.0, -30.0, 45.0, -45.0])  # tried where the body is lost
SEED_MARKERS, SEED_DOTS = 8, 5  # from how many markers, and how many dots of each, a match may begin
AMBIGUOUS = 0.75  # of a marker: a match that explains less than so much less may be right as well
QUESTIONED = 12  # dots of which it is asked whether they could be another marker's
ROUGH = 0.5  # of a marker: what a dot at the gate's edge costs
STILL = 0.01  # spacings: a dot that keeps its place so exactly may be a mark on the frame that holds the body
PINNED = 0.1  # spacings: how far from its place what is known to be a mark may seem to be


@dataclass(frozen=True)
class Pattern:
    """Markers at rest in the picture and who stands beside whom.

    Attributes:
        rest: [px], (M, 2).
        spacing: of each marker from its nearest neighbour, at least half the median [px], (M).
        neighbours: nearest first, (M, K); -1 where there are fewer.
    """

    rest: Array
    spacing: Array
    neighbours: NDArray[np.int64]

    @classmethod
    def of(cls, rest: Array) -> "Pattern":
        """From positions at rest (M, 2)."""
        count = min(NEIGHBOURS + 1, len(rest))
        distance, nearest = cKDTree(rest).query(rest, count)
        neighbours = np.full((len(rest), NEIGHBOURS), -1)
        neighbours[:, : count - 1] = nearest[:, 1:]
        spacing = distance[:, 1]
        return cls(rest, np.maximum(spacing, 0.5 * np.median(spacing)), neighbours)


@njit(cache=True, nogil=True)
def _predicted(marker, shape, linear, spacing, neighbours, dots, match):  # type: ignore[no-untyped-def]
    """Where a marker's matched neighbours put it: their affine map, drawn towards the expected one."""
    sw = sx = sy = tx = ty = 0.0  # sums over neighbours, places taken from the marker's own
    mxx = mxy = myy = nxx = nxy = nyx = nyy = 0.0
    for k in range(neighbours.shape[1]):
        other = neighbours[marker, k]
        if other >= 0 and match[other] >= 0:
            ux, uy = shape[other, 0] - shape[marker, 0], shape[other, 1] - shape[marker, 1]
            vx, vy = dots[match[other], 0] - shape[marker, 0], dots[match[other], 1] - shape[marker, 1]
            g = 1.0 / (np.hypot(ux, uy) + 1e-9)
            sw += g
            sx += g * ux
            sy += g * uy
            tx += g * vx
            ty += g * vy
            mxx += g * ux * ux
            mxy += g * ux * uy
            myy += g * uy * uy
            nxx += g * vx * ux
            nxy += g * vx * uy
            nyx += g * vy * ux
            nyy += g * vy * uy
    if sw == 0.0:  # apart from all that is matched: from the nearest matched marker
        nearest = np.inf
        for other in range(shape.shape[0]):
            if match[other] >= 0:
                ux, uy = shape[other, 0] - shape[marker, 0], shape[other, 1] - shape[marker, 1]
                gap = np.hypot(ux, uy)
                if gap < nearest:
                    nearest = gap
                    sx, sy = ux, uy
                    tx, ty = dots[match[other], 0] - shape[marker, 0], dots[match[other], 1] - shape[marker, 1]
    else:
        sx, sy, tx, ty = sx / sw, sy / sw, tx / sw, ty / sw
        mxx, mxy, myy = mxx / sw - sx * sx, mxy / sw - sx * sy, myy / sw - sy * sy
        nxx, nxy, nyx, nyy = nxx / sw - tx * sx, nxy / sw - tx * sy, nyx / sw - ty * sx, nyy / sw - ty * sy
    ridge = STIFFNESS * (mxx + myy) + 1e-3 * spacing[marker] ** 2
    nxx += ridge * linear[marker, 0, 0]
    nxy += ridge * linear[marker, 0, 1]
    nyx += ridge * linear[marker, 1, 0]
    nyy += ridge * linear[marker, 1, 1]
    mxx += ridge
    myy += ridge
    inverse = 1.0 / (mxx * myy - mxy * mxy)
    px = (mxy * sy - myy * sx) * inverse
    py = (mxy * sx - mxx * sy) * inverse
    return shape[marker, 0] + tx + nxx * px + nxy * py, shape[marker, 1] + ty + nyx * px + nyy * py


@njit(cache=True, nogil=True)
def _nearest_free(x, y, gate, dots, taken, buckets, cell, origin):  # type: ignore[no-untyped-def]
    """The nearest dot not taken within the gate of (x, y), -1 for none."""
    found = -1
    nearest = gate
    column, row = int((x - origin[0]) / cell), int((y - origin[1]) / cell)
    for r in range(max(row - 1, 0), min(row + 2, buckets.shape[0])):
        for c in range(max(column - 1, 0), min(column + 2, buckets.shape[1])):
            for k in range(buckets.shape[2]):
                dot = buckets[r, c, k]
                if dot < 0:
                    break
                gap = np.hypot(dots[dot, 0] - x, dots[dot, 1] - y)
                if gap < nearest and not taken[dot]:
                    nearest = gap
                    found = dot
    return found


@njit(cache=True, nogil=True)
def _settle(shape, linear, spacing, neighbours, dots, buckets, cell, origin, taken, match):  # type: ignore[no-untyped-def]
    """Gives up matches that their neighbours contradict, and looks again for markers that found none."""
    for _ in range(2):
        for marker in range(shape.shape[0]):
            own = match[marker]
            around = 0
            for k in range(neighbours.shape[1]):
                other = neighbours[marker, k]
                if other >= 0 and match[other] >= 0:
                    around += 1
            if around < 3:
                continue
            match[marker] = -1
            x, y = _predicted(marker, shape, linear, spacing, neighbours, dots, match)
            if own >= 0:
                if np.hypot(dots[own, 0] - x, dots[own, 1] - y) < 1.3 * GATE * spacing[marker]:
                    match[marker] = own
                else:
                    taken[own] = False
            else:
                found = _nearest_free(x, y, GATE * spacing[marker], dots, taken, buckets, cell, origin)
                if found >= 0:
                    match[marker] = found
                    taken[found] = True


@njit(cache=True, nogil=True)
def _grow(shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, sure, seed, match):  # type: ignore[no-untyped-def]
    """Spread the match of a seed, one marker and one dot, and of sure ones (M), -1 for none; fills match (M) likewise.

    Returns the match's score; a marker counts up to 1 + steady (M) where it is expected. buckets (R, C, B): dots by
    square of side `cell` from `origin`, -1 filled.
    """
    count = shape.shape[0]
    visited = sure >= 0
    taken = np.zeros(dots.shape[0], np.bool_)
    ready = np.zeros(count, np.int64)  # matched neighbours
    match[:] = sure
    for marker in range(count):
        if sure[marker] >= 0:
            taken[sure[marker]] = True
            for k in range(neighbours.shape[1]):
                if neighbours[marker, k] >= 0:
                    ready[neighbours[marker, k]] += 1
    marker, found = seed[0], seed[1]
    while True:
        visited[marker] = True
        if found >= 0:
            match[marker] = found
            taken[found] = True
            for k in range(neighbours.shape[1]):
                if neighbours[marker, k] >= 0:
                    ready[neighbours[marker, k]] += 1
        best = -1
        for other in range(count):
            if not visited[other] and (best < 0 or ready[other] > ready[best]):
                best = other
        if best < 0:
            break
        marker = best
        x, y = _predicted(marker, shape, linear, spacing, neighbours, dots, match)
        found = _nearest_free(x, y, GATE * spacing[marker], dots, taken, buckets, cell, origin)
    _settle(shape, linear, spacing, neighbours, dots, buckets, cell, origin, taken, match)
    score = 0.0
    total = (match >= 0).sum()
    for marker in range(count):
        found = match[marker]
        if found < 0:
            continue
        score += 1.0
        if total > 1:
            match[marker] = -1
            x, y = _predicted(marker, shape, linear, spacing, neighbours, dots, match)
            match[marker] = found
            misfit = np.hypot(dots[found, 0] - x, dots[found, 1] - y) / (GATE * spacing[marker])
            score -= ROUGH * min(misfit * misfit, 1.5)
        away = np.hypot(dots[found, 0] - expected[marker, 0], dots[found, 1] - expected[marker, 1])
        score -= far * min(away / spacing[marker], 3.0)
        score += steady[marker] * max(1.0 - away / spacing[marker], 0.0)
    return score


@njit(cache=True, nogil=True)
def _best_growth(  # type: ignore[no-untyped-def]
    shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, seeds, enough, best
):  # fmt: skip
    """Tries seeds (S, 2) of marker and dot until a score reaches `enough`; fills best (M)."""
    match, nobody = np.empty(shape.shape[0], np.int64), np.full(shape.shape[0], -1)
    highest = -np.inf
    for s in range(seeds.shape[0]):
        # A pair that the best match already holds would grow into the same.
        if highest > -np.inf and best[seeds[s, 0]] == seeds[s, 1]:
            continue
        score = _grow(
            shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, nobody, seeds[s],
            match,
        )  # fmt: skip
        if score > highest:
            highest = score
            best[:] = match
        if highest >= enough:
            break
    return highest


@njit(cache=True, nogil=True)
def _agreed(  # type: ignore[no-untyped-def]
    shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, sure, seeds, best
):  # fmt: skip
    """Which markers have the same dot in best (M) and in all matches that grow from seeds and sure ones as well."""
    agreed = best >= 0
    match = np.empty(shape.shape[0], np.int64)
    first = np.flatnonzero(best >= 0)[0]
    pair = np.array([first, best[first]])
    score = _grow(
        shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, best, pair, match
    )
    for s in range(seeds.shape[0]):
        marker, dot = seeds[s, 0], seeds[s, 1]
        if best[marker] == dot or sure[marker] >= 0:
            continue
        other = _grow(
            shape,
            expected,
            linear,
            spacing,
            neighbours,
            dots,
            buckets,
            cell,
            origin,
            far,
            steady,
            sure,
            seeds[s],
            match,
        )
        if other > score - AMBIGUOUS:
            agreed &= match == best
    return agreed


def recognise(
    pattern: Pattern, shape: Array, expected: Array, trusted: Array, dots: Array, reach: float, sureness: float,
    steady: Array, seen: NDArray[np.bool_] | None = None, marks: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:  # fmt: skip
    """The dot of each marker, (M), -1 for none, and of which markers it can be no other's, (M).

    Args:
        pattern: the markers.
        shape: as last seen [px], (M, 2).
        expected: where motion puts the markers [px], (M, 2).
        trusted: how sure that is, larger for surer; seeds are tried in this order, (M).
        dots: of the new picture [px], (D, 2).
        reach: how far from where it is expected a seed's dot may be [spacings].
        sureness: of the expected motion as a whole, 0 to 1.
        steady: how much more a marker that is where it is expected counts than another, (M).
        seen: which of the markers were seen in the picture before, so that there is no doubt about them, (M); all where
            not given.
        marks: which of the markers stand still beside the body, (M); of none that is known where not given.
    """
    nobody = np.full(len(shape), -1)
    if not len(dots):
        return nobody, np.zeros(len(shape), bool)
    if seen is None:
        seen = np.ones(len(shape), bool)
    if marks is not None and marks.any():
        match = np.where(marks, _at_place(pattern, shape, dots, PINNED), -1)
        agreed = match >= 0
        body, free = np.flatnonzero(~marks), np.setdiff1d(np.arange(len(dots)), match)
        found, alone = recognise(
            Pattern.of(pattern.rest[body]), shape[body], expected[body], trusted[body], dots[free], reach, sureness,
            steady[body], seen[body],
        )  # fmt: skip
        match[body[found >= 0]] = free[found[found >= 0]]
        agreed[body] = alone
        return match, agreed
    search = _Search.of(pattern, dots)
    seeds = search.seeds(expected, trusted, reach)
    far = FAR * sureness
    maps = _local_maps(pattern, shape, expected)
    best, score = search.grow(shape, expected, maps, far, steady, seeds)
    way = shape, maps
    if (best >= 0).sum() < min(len(shape), len(dots)):
        # Markers and dots are left over: some may be marks beside the body, or it may stand where nobody expects it.
        other, other_score = _with_marks(pattern, shape, expected, trusted, dots, reach, far, steady)
        if other_score > score:
            best, score = other, other_score
        for turn in TURNS:
            cos, sin = np.cos(turn), np.sin(turn)
            linear = np.tile([[cos, -sin], [sin, cos]], (len(shape), 1, 1))
            for base in (shape, pattern.rest):
                other, other_score = search.grow(base, expected, linear, far, steady, seeds)
                if other_score > score:
                    best, score, way = other, other_score, (base, linear)
    return best, search.agreed(*way, expected, far, steady, np.where(seen, best, -1), seeds, best)


def _at_place(pattern: Pattern, shape: Array, dots: Array, most: float) -> NDArray[np.int64]:
    """The dot within so many spacings of each marker's last place, (M), -1 for none."""
    gap, nearest = cKDTree(dots).query(shape)
    return np.where(gap < most * pattern.spacing, nearest, -1)


def _with_marks(
    pattern: Pattern, shape: Array, expected: Array, trusted: Array, dots: Array, reach: float, far: float,
    steady: Array,
) -> tuple[NDArray[np.int64], float]:  # fmt: skip
    """The best match (M) in which whoever can keep its place does, as marks on the frame would, and its score."""
    match = _at_place(pattern, shape, dots, STILL)
    moving, free = np.flatnonzero(match < 0), np.setdiff1d(np.arange(len(dots)), match)
    marks = len(match) - len(moving)
    if not marks or len(moving) < 2 or not len(free):  # one alone has no shape
        return match, float(marks)
    body, own = Pattern.of(pattern.rest[moving]), expected[moving]
    search = _Search.of(body, dots[free])
    grown, score = search.grow(
        shape[moving], own, _local_maps(body, shape[moving], own), far, steady[moving],
        search.seeds(own, trusted[moving], reach),
    )  # fmt: skip
    match[moving[grown >= 0]] = free[grown[grown >= 0]]
    return match, marks + score


def match_shape(pattern: Pattern, dots: Array, far: float) -> tuple[float, NDArray[np.int64]]:
    """The best match of dots (D, 2) to a pattern in the shape and about the place where it is at rest, (M), -1 for
    none, and its score: about how many markers it explains.

    Args:
        pattern: the markers.
        dots: of a picture [px], (D, 2).
        far: what a dot one spacing from its place counts less.
    """
    count = len(pattern.rest)
    some = np.arange(0, count, max(count // SEED_MARKERS, 1))
    tree, seeds = cKDTree(dots), []
    for places in (pattern.rest, pattern.rest + dots.mean(axis=0) - pattern.rest.mean(axis=0)):
        near = tree.query(places[some], min(SEED_DOTS, len(dots)))[1].reshape(len(some), -1)
        seeds.append(np.stack([np.repeat(some, near.shape[1]), near.ravel()], axis=1))
    linear = np.tile(np.eye(2), (count, 1, 1))
    search, nobody = _Search.of(pattern, dots), np.zeros(count)
    match, score = search.grow(pattern.rest, pattern.rest, linear, far, nobody, np.concatenate(seeds))
    return score, match


@dataclass(frozen=True)
class _Search:
    """The dots of a picture, ready to be searched."""

    pattern: Pattern
    dots: Array
    buckets: NDArray[np.int64]
    cell: float
    origin: Array

    @classmethod
    def of(cls, pattern: Pattern, dots: Array) -> "_Search":
        cell = float(GATE * pattern.spacing.max())
        return cls(pattern, dots, *_buckets(dots, cell))

    def seeds(self, expected: Array, trusted: Array, reach: float) -> NDArray[np.int64]:
        """Pairs of marker and dot to begin with, likeliest first, (S, 2)."""
        pairs: list[tuple[float, int, int]] = []
        tree = cKDTree(self.dots)
        for rank, marker in enumerate(np.argsort(-trusted)):
            spacing = self.pattern.spacing[marker]
            for dot in tree.query_ball_point(expected[marker], reach * spacing):
                away = float(np.linalg.norm(self.dots[dot] - expected[marker])) / spacing
                pairs.append((away + 0.02 * rank, int(marker), dot))
        pairs.sort()
        return np.array([pair[1:] for pair in pairs], dtype=np.int64).reshape(-1, 2)

    def grow(
        self, shape: Array, expected: Array, linear: Array, far: float, steady: Array, seeds: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], float]:
        """The best match (M) that grows from any seed, and its score."""
        match = np.full(len(shape), -1)
        enough = 0.97 * float(np.sort(1.0 + steady)[-min(len(shape), len(self.dots)) :].sum())
        score = _best_growth(
            shape, expected, linear, self.pattern.spacing, self.pattern.neighbours, self.dots, self.buckets, self.cell,
            self.origin, far, steady, seeds, enough, match,
        )  # fmt: skip
        return match, score

    def agreed(
        self, shape: Array, linear: Array, expected: Array, far: float, steady: Array, sure: NDArray[np.int64],
        seeds: NDArray[np.int64], best: NDArray[np.int64],
    ) -> NDArray[np.bool_]:  # fmt: skip
        """Which markers have their dot in every match that explains about as much and keeps the sure ones, (M)."""
        unsure = np.setdiff1d(best, sure)
        if not len(unsure):
            return best >= 0
        asked = unsure[np.linspace(0, len(unsure) - 1, min(len(unsure), QUESTIONED)).astype(int)]
        return _agreed(
            shape, expected, linear, self.pattern.spacing, self.pattern.neighbours, self.dots, self.buckets, self.cell,
            self.origin, far, steady, sure, seeds[np.isin(seeds[:, 1], asked)], best,
        )  # fmt: skip


def _local_maps(pattern: Pattern, shape: Array, expected: Array) -> Array:
    """The linear part of the motion from `shape` to `expected` about each marker, (M, 2, 2)."""
    maps = np.tile(np.eye(2), (len(shape), 1, 1))
    near = pattern.neighbours
    valid = near >= 0
    if valid.sum(1).min(initial=NEIGHBOURS) < 2:
        return maps
    weight = valid[..., None] / pattern.spacing[:, None, None] ** 2
    source = (shape[near] - shape[:, None]) * weight
    target = expected[near] - expected[:, None]
    source_plain = shape[near] - shape[:, None]
    ridge = 0.3 * np.eye(2)
    moment = np.einsum("mki,mkj->mij", source, source_plain) + ridge
    return (np.einsum("mki,mkj->mij", target, source) + ridge) @ np.linalg.inv(moment)


def _buckets(dots: Array, cell: float) -> tuple[NDArray[np.int64], float, Array]:
    """Dots by square of a grid, (rows, columns, most in one), the squares' side and the grid's corner."""
    origin = dots.min(axis=0) - 1.5 * cell
    place = ((dots - origin) / cell).astype(int)
    columns, rows = place.max(axis=0) + 2
    flat = place[:, 1] * columns + place[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.r_[0, np.flatnonzero(np.diff(flat[order])) + 1]
    counts = np.diff(np.r_[starts, len(order)])
    buckets = np.full((rows * columns, counts.max()), -1)
    for start, count in zip(starts, counts, strict=True):
        buckets[flat[order[start]], :count] = order[start : start + count]
    return buckets.reshape(rows, columns, -1), cell, origin
