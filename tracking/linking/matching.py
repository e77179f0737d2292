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
from numpy.typing import NDArray
from rafl.tracking.linking.match_propagation import GATE, agreed_growth, best_growth
from scipy.spatial import cKDTree

Array = NDArray[Any]

NEIGHBOURS = 8
FAR = 0.12  # of a marker: what a dot one spacing from its expected place costs, where motion is known
TURNS = np.radians([0.0, 15.0, -15.0, 30.0, -30.0, 45.0, -45.0])  # tried where the body is lost
SEED_MARKERS, SEED_DOTS = 8, 5  # from how many markers, and how many dots of each, a match may begin
QUESTIONED = 12  # dots of which it is asked whether they could be another marker's
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


def recognise(
    pattern: Pattern,
    shape: Array,
    expected: Array,
    trusted: Array,
    dots: Array,
    reach: float,
    sureness: float,
    steady: Array,
    seen: NDArray[np.bool_] | None = None,
    marks: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
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
            Pattern.of(pattern.rest[body]),
            shape[body],
            expected[body],
            trusted[body],
            dots[free],
            reach,
            sureness,
            steady[body],
            seen[body],
        )
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
    pattern: Pattern,
    shape: Array,
    expected: Array,
    trusted: Array,
    dots: Array,
    reach: float,
    far: float,
    steady: Array,
) -> tuple[NDArray[np.int64], float]:
    """The best match (M) in which whoever can keep its place does, as marks on the frame would, and its score."""
    match = _at_place(pattern, shape, dots, STILL)
    moving, free = np.flatnonzero(match < 0), np.setdiff1d(np.arange(len(dots)), match)
    marks = len(match) - len(moving)
    if not marks or len(moving) < 2 or not len(free):  # one alone has no shape
        return match, float(marks)
    body, own = Pattern.of(pattern.rest[moving]), expected[moving]
    search = _Search.of(body, dots[free])
    grown, score = search.grow(
        shape[moving],
        own,
        _local_maps(body, shape[moving], own),
        far,
        steady[moving],
        search.seeds(own, trusted[moving], reach),
    )
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
        score = best_growth(
            shape,
            expected,
            linear,
            self.pattern.spacing,
            self.pattern.neighbours,
            self.dots,
            self.buckets,
            self.cell,
            self.origin,
            far,
            steady,
            seeds,
            enough,
            match,
        )
        return match, score

    def agreed(
        self,
        shape: Array,
        linear: Array,
        expected: Array,
        far: float,
        steady: Array,
        sure: NDArray[np.int64],
        seeds: NDArray[np.int64],
        best: NDArray[np.int64],
    ) -> NDArray[np.bool_]:
        """Which markers have their dot in every match that explains about as much and keeps the sure ones, (M)."""
        unsure = np.setdiff1d(best, sure)
        if not len(unsure):
            return best >= 0
        asked = unsure[np.linspace(0, len(unsure) - 1, min(len(unsure), QUESTIONED)).astype(int)]
        return agreed_growth(
            shape,
            expected,
            linear,
            self.pattern.spacing,
            self.pattern.neighbours,
            self.dots,
            self.buckets,
            self.cell,
            self.origin,
            far,
            steady,
            sure,
            seeds[np.isin(seeds[:, 1], asked)],
            best,
        )


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
