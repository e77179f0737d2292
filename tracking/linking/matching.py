"""Matching the dots of a frame to a pattern of markers of which only the rough shape is known.

The markers sit on one smooth body. So a match starts from a seed, one marker and one dot, and spreads from neighbour to
neighbour, predicting each marker by the affine map of the matches around it. Of all seeds, the one is kept whose match
explains most dots and lies nearest to the pattern.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rafl.tracking.linking.match_propagation import best_match

Array = NDArray[Any]

NEIGHBOUR_COUNT = 8
SEED_MARKERS, SEED_DOTS = 8, 5  # markers that give seeds, and dots tried for each
SUFFICIENT_SHARE = 0.97  # of the largest possible score, which ends the search


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
    match = np.full(count, -1)
    sufficient = SUFFICIENT_SHARE * min(count, len(dots))
    score: float = best_match(
        pattern.rest,
        pattern.spacing,
        pattern.neighbours,
        dots,
        distance_cost,
        np.concatenate(seeds),
        sufficient,
        match,
    )
    return score, match
