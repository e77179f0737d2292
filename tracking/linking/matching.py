"""Matching all dots of a frame to the markers at once, after the body has moved and bent.

All dots look alike, and between two frames they may move farther than their spacing: the nearest dot is often another
marker's. But the markers sit on one smooth body. So a match starts from a seed, one marker and one dot, and spreads
from neighbour to neighbour, predicting each marker by the affine map of the matches around it. Of all seeds, the one is
kept whose match explains most dots and lies nearest to the expected positions.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rafl.tracking.linking.match_propagation import GATE_SPACINGS, agreed_markers, best_match

Array = NDArray[Any]

NEIGHBOUR_COUNT = 8
DISTANCE_COST = 0.12  # cost, in markers, of a dot one spacing from its expected position, if the motion is known
TRIED_ROTATIONS = np.radians([0.0, 15.0, -15.0, 30.0, -30.0, 45.0, -45.0])  # of the body, if dots are left unmatched
SEED_MARKERS, SEED_DOTS = 8, 5  # markers that give seeds, and dots tried for each (`match_at_rest`)
MAX_CHECKED_DOTS = 12  # dots tested for belonging to another marker
UNMOVED_GATE = 0.01  # a dot this near to a marker's last position may be a static one [spacings]
STATIC_GATE = 0.1  # most apparent displacement of a marker known to be static [spacings]


@dataclass(frozen=True)
class MarkerPattern:
    """The markers' rest positions in the image, with their spacing and neighbours.

    Attributes:
        rest: [px], (M, 2).
        spacing: distance of each marker from its nearest neighbour, at least half the median [px], (M).
        neighbours: indices, nearest first, (M, K); -1 where there are fewer.
    """

    rest: Array
    spacing: Array
    neighbours: NDArray[np.int64]

    @classmethod
    def of(cls, rest: Array) -> "MarkerPattern":
        """From rest positions [px], (M, 2)."""
        count = min(NEIGHBOUR_COUNT + 1, len(rest))
        distance, nearest = cKDTree(rest).query(rest, count)
        neighbours = np.full((len(rest), NEIGHBOUR_COUNT), -1)
        neighbours[:, : count - 1] = nearest[:, 1:]
        spacing = distance[:, 1]
        return cls(rest, np.maximum(spacing, 0.5 * np.median(spacing)), neighbours)


def match_markers(
    pattern: MarkerPattern,
    shape: Array,
    expected: Array,
    confidence: Array,
    dots: Array,
    seed_reach: float,
    motion_confidence: float,
    steady_bonus: Array,
    seen: NDArray[np.bool_] | None = None,
    static: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The dot of each marker, (M), -1 for none, and which of these matches are unambiguous, (M).

    Args:
        pattern: the markers.
        shape: their last positions [px], (M, 2).
        expected: their positions predicted from the motion [px], (M, 2).
        confidence: in each expected position, larger for surer; seeds are tried in this order, (M).
        dots: of the new frame [px], (D, 2).
        seed_reach: most distance of a seed's dot from its expected position [spacings].
        motion_confidence: in the expected motion as a whole, 0 to 1.
        steady_bonus: extra score of a marker at its expected position, (M).
        seen: markers that were seen in the frame before, whose match is not questioned, (M); default: all.
        static: markers known to stand still beside the body, (M); default: none.
    """
    unmatched = np.full(len(shape), -1)
    if not len(dots):
        return unmatched, np.zeros(len(shape), bool)
    if seen is None:
        seen = np.ones(len(shape), bool)
    if static is not None and static.any():
        match = np.where(static, _match_in_place(pattern, shape, dots, STATIC_GATE), -1)
        agreed = match >= 0
        body, free = np.flatnonzero(~static), np.setdiff1d(np.arange(len(dots)), match)
        body_match, body_agreed = match_markers(
            MarkerPattern.of(pattern.rest[body]),
            shape[body],
            expected[body],
            confidence[body],
            dots[free],
            seed_reach,
            motion_confidence,
            steady_bonus[body],
            seen[body],
        )
        match[body[body_match >= 0]] = free[body_match[body_match >= 0]]
        agreed[body] = body_agreed
        return match, agreed
    search = _Search.of(pattern, dots)
    seeds = search.seeds(expected, confidence, seed_reach)
    distance_cost = DISTANCE_COST * motion_confidence
    maps = _local_maps(pattern, shape, expected)
    best, score = search.grow(shape, expected, maps, distance_cost, steady_bonus, seeds)
    start = shape, maps
    if (best >= 0).sum() < min(len(shape), len(dots)):
        # Markers and dots are left over: some may be static dots, or the body may be far from its expected position.
        other, other_score = _match_with_static(
            pattern, shape, expected, confidence, dots, seed_reach, distance_cost, steady_bonus
        )
        if other_score > score:
            best, score = other, other_score
        for angle in TRIED_ROTATIONS:
            cos, sin = np.cos(angle), np.sin(angle)
            linear = np.tile([[cos, -sin], [sin, cos]], (len(shape), 1, 1))
            for base in (shape, pattern.rest):
                other, other_score = search.grow(base, expected, linear, distance_cost, steady_bonus, seeds)
                if other_score > score:
                    best, score, start = other, other_score, (base, linear)
    confirmed = np.where(seen, best, -1)
    return best, search.agreed(*start, expected, distance_cost, steady_bonus, confirmed, seeds, best)


def _match_in_place(pattern: MarkerPattern, shape: Array, dots: Array, gate: float) -> NDArray[np.int64]:
    """The dot within `gate` spacings of each marker's last position, (M), -1 for none."""
    distance, nearest = cKDTree(dots).query(shape)
    return np.where(distance < gate * pattern.spacing, nearest, -1)


def _match_with_static(
    pattern: MarkerPattern,
    shape: Array,
    expected: Array,
    confidence: Array,
    dots: Array,
    seed_reach: float,
    distance_cost: float,
    steady_bonus: Array,
) -> tuple[NDArray[np.int64], float]:
    """The best match (M), and its score, if every marker with a dot at its last position is static."""
    match = _match_in_place(pattern, shape, dots, UNMOVED_GATE)
    moving, free = np.flatnonzero(match < 0), np.setdiff1d(np.arange(len(dots)), match)
    static_count = len(match) - len(moving)
    if not static_count or len(moving) < 2 or not len(free):  # a single marker has no pattern
        return match, float(static_count)
    body, body_expected = MarkerPattern.of(pattern.rest[moving]), expected[moving]
    search = _Search.of(body, dots[free])
    body_match, score = search.grow(
        shape[moving],
        body_expected,
        _local_maps(body, shape[moving], body_expected),
        distance_cost,
        steady_bonus[moving],
        search.seeds(body_expected, confidence[moving], seed_reach),
    )
    match[moving[body_match >= 0]] = free[body_match[body_match >= 0]]
    return match, static_count + score


def match_at_rest(pattern: MarkerPattern, dots: Array, distance_cost: float) -> tuple[float, NDArray[np.int64]]:
    """Match dots (D, 2) to a pattern near its rest shape and position.

    Args:
        pattern: the markers.
        dots: of a frame [px], (D, 2).
        distance_cost: cost, in markers, of a dot one spacing from its rest position.

    Returns:
        The score, about the number of markers explained, and the dot of each marker, (M), -1 for none.
    """
    count = len(pattern.rest)
    seed_markers = np.arange(0, count, max(count // SEED_MARKERS, 1))
    tree, seeds = cKDTree(dots), []
    for positions in (pattern.rest, pattern.rest + dots.mean(axis=0) - pattern.rest.mean(axis=0)):
        near = tree.query(positions[seed_markers], min(SEED_DOTS, len(dots)))[1].reshape(len(seed_markers), -1)
        seeds.append(np.stack([np.repeat(seed_markers, near.shape[1]), near.ravel()], axis=1))
    linear = np.tile(np.eye(2), (count, 1, 1))
    search, no_bonus = _Search.of(pattern, dots), np.zeros(count)
    match, score = search.grow(pattern.rest, pattern.rest, linear, distance_cost, no_bonus, np.concatenate(seeds))
    return score, match


@dataclass(frozen=True)
class _Search:
    """The dots of a frame, in buckets for a fast search (see `_fill_buckets`)."""

    pattern: MarkerPattern
    dots: Array
    buckets: NDArray[np.int64]
    cell: float
    origin: Array

    @classmethod
    def of(cls, pattern: MarkerPattern, dots: Array) -> "_Search":
        cell = float(GATE_SPACINGS * pattern.spacing.max())
        return cls(pattern, dots, *_fill_buckets(dots, cell))

    def seeds(self, expected: Array, confidence: Array, seed_reach: float) -> NDArray[np.int64]:
        """Pairs of marker and dot from which to start, likeliest first, (S, 2)."""
        pairs: list[tuple[float, int, int]] = []
        tree = cKDTree(self.dots)
        for rank, marker in enumerate(np.argsort(-confidence)):
            spacing = self.pattern.spacing[marker]
            for dot in tree.query_ball_point(expected[marker], seed_reach * spacing):
                distance = float(np.linalg.norm(self.dots[dot] - expected[marker])) / spacing
                pairs.append((distance + 0.02 * rank, int(marker), dot))
        pairs.sort()
        return np.array([pair[1:] for pair in pairs], dtype=np.int64).reshape(-1, 2)

    def grow(
        self,
        shape: Array,
        expected: Array,
        linear: Array,
        distance_cost: float,
        steady_bonus: Array,
        seeds: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], float]:
        """The best match (M) from any seed, and its score."""
        match = np.full(len(shape), -1)
        most = min(len(shape), len(self.dots))
        sufficient_score = 0.97 * float(np.sort(1.0 + steady_bonus)[-most:].sum())
        score: float = best_match(
            shape,
            expected,
            linear,
            self.pattern.spacing,
            self.pattern.neighbours,
            self.dots,
            self.buckets,
            self.cell,
            self.origin,
            distance_cost,
            steady_bonus,
            seeds,
            sufficient_score,
            match,
        )
        return match, score

    def agreed(
        self,
        shape: Array,
        linear: Array,
        expected: Array,
        distance_cost: float,
        steady_bonus: Array,
        confirmed: NDArray[np.int64],
        seeds: NDArray[np.int64],
        best: NDArray[np.int64],
    ) -> NDArray[np.bool_]:
        """Which markers keep their dot in every similarly good match that contains the confirmed ones, (M)."""
        unconfirmed = np.setdiff1d(best, confirmed)
        if not len(unconfirmed):
            return best >= 0
        evenly = np.linspace(0, len(unconfirmed) - 1, min(len(unconfirmed), MAX_CHECKED_DOTS))
        checked = unconfirmed[evenly.astype(int)]
        agreed: NDArray[np.bool_] = agreed_markers(
            shape,
            expected,
            linear,
            self.pattern.spacing,
            self.pattern.neighbours,
            self.dots,
            self.buckets,
            self.cell,
            self.origin,
            distance_cost,
            steady_bonus,
            confirmed,
            seeds[np.isin(seeds[:, 1], checked)],
            best,
        )
        return agreed


def _local_maps(pattern: MarkerPattern, shape: Array, expected: Array) -> Array:
    """The linear part of the motion from `shape` to `expected` about each marker, (M, 2, 2)."""
    maps = np.tile(np.eye(2), (len(shape), 1, 1))
    near = pattern.neighbours
    valid = near >= 0
    if valid.sum(1).min(initial=NEIGHBOUR_COUNT) < 2:
        return maps
    weight = valid[..., None] / pattern.spacing[:, None, None] ** 2
    weighted_source = (shape[near] - shape[:, None]) * weight
    target = expected[near] - expected[:, None]
    source = shape[near] - shape[:, None]
    ridge = 0.3 * np.eye(2)
    moment = np.einsum("mki,mkj->mij", weighted_source, source) + ridge
    fitted: Array = (np.einsum("mki,mkj->mij", target, weighted_source) + ridge) @ np.linalg.inv(moment)
    return fitted


def _fill_buckets(dots: Array, cell: float) -> tuple[NDArray[np.int64], float, Array]:
    """Dots by square of a grid, (rows, columns, most in one), -1 filled; the squares' side; the grid's corner [px]."""
    origin = dots.min(axis=0) - 1.5 * cell
    square = ((dots - origin) / cell).astype(int)
    columns, rows = square.max(axis=0) + 2
    flat = square[:, 1] * columns + square[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.r_[0, np.flatnonzero(np.diff(flat[order])) + 1]
    counts = np.diff(np.r_[starts, len(order)])
    buckets = np.full((rows * columns, counts.max()), -1)
    for start, count in zip(starts, counts, strict=True):
        buckets[flat[order[start]], :count] = order[start : start + count]
    return buckets.reshape(rows, columns, -1), cell, origin
