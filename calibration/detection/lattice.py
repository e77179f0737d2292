"""Points of a square lattice in an image: growth from a few of them, and the place of the board's origin among them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Index = tuple[int, int]

MAX_DISTORTION = 0.2  # RMS distance of the points from a perspective view, relative to their spacing
DIRECTIONS = ((0, 1), (0, -1), (1, 1), (1, -1))  # axis and sign of the step to each neighbour


@dataclass(frozen=True)
class Node:
    """A lattice point in the image: its pixel (2), and the steps to its neighbours along both axes (2, 2) [px]."""

    pixel: Array
    steps: Array


@dataclass(frozen=True)
class Lattice:
    """Lattice points, indices (P, 2) right-handed with x to the right and y down, and their pixels (P, 2)."""

    indices: NDArray[np.int64]
    pixels: Array

    @classmethod
    def of(cls, nodes: dict[Index, Node]) -> "Lattice":
        """Lattice of grown nodes; a mirrored one is flipped."""
        indices = np.array(list(nodes), dtype=np.int64).reshape(-1, 2)
        pixels = np.array([node.pixel for node in nodes.values()]).reshape(-1, 2)
        steps = np.mean([node.steps for node in nodes.values()], axis=0)
        if np.linalg.det(steps) < 0:
            indices[:, 0] *= -1
        return cls(indices, pixels)

    @property
    def size(self) -> tuple[int, int]:
        """Number of columns and rows that the points span."""
        columns, rows = np.ptp(self.indices, axis=0) + 1
        return int(columns), int(rows)

    def perspective(self, indices: Array) -> Array | None:
        """Pixels (I, 2) of indices (I, 2) in the best perspective view of the lattice; None if there is none."""
        homography = cv2.findHomography(self.indices.astype(float), self.pixels)[0]
        if homography is None:
            return None
        result: Array = cv2.perspectiveTransform(indices[None].astype(float), homography)[0]
        return result

    def is_flat(self) -> bool:
        """Whether the points are a perspective view of a flat square lattice, but for the distortion of a lens."""
        expected = self.perspective(self.indices)
        if expected is None:
            return False
        area = float(np.prod(np.ptp(self.pixels, axis=0)) / np.prod(self.size))
        return float(((self.pixels - expected) ** 2).sum(axis=1).mean()) < MAX_DISTORTION**2 * area

    def is_free_standing(self, image_size: tuple[int, int]) -> bool:
        """Whether one more row and column would fit into the image on every side."""
        (left, top), (right, bottom) = self.indices.min(axis=0) - 1, self.indices.max(axis=0) + 1
        corners = self.perspective(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))
        return corners is not None and bool(((corners >= 0) & (corners <= np.array(image_size) - 1)).all())

    def turned(self) -> Iterator["Lattice"]:
        """The four lattices that differ by quarter turns of the axes."""
        indices = self.indices
        for _ in range(4):
            yield Lattice(indices, self.pixels)
            indices = np.stack([-indices[:, 1], indices[:, 0]], axis=1)

    def from_first_corner(self) -> "Lattice":
        """The lattice with indices from (0, 0) on."""
        return Lattice(self.indices - self.indices.min(axis=0), self.pixels)


def place_by_size(lattice: Lattice, size: tuple[int, int], image_size: tuple[int, int]) -> tuple[Lattice | None, bool]:
    """Number the points of a lattice of `size` columns x rows from the corner nearest the top left of the image.

    Returns:
        The numbered lattice, None if this is a board of another size: it has more columns or rows, or fewer although
        the border of the image does not cut it. And whether the whole board is seen; the origin of a part is not the
        board's.
    """

    def distance(found: Lattice) -> float:
        origin = found.perspective(np.zeros((1, 2)))
        return np.inf if origin is None else float(origin.sum())

    turned = [found.from_first_corner() for found in lattice.turned()]
    whole = [found for found in turned if found.size == size]
    part = [found for found in turned if found.size[0] <= size[0] and found.size[1] <= size[1]]
    if not whole and lattice.is_free_standing(image_size):
        part = []
    return min(whole or part, key=distance, default=None), bool(whole)


def place_by_rings(lattice: Lattice, ringed: NDArray[np.bool_], rings: tuple[int, int]) -> tuple[Lattice, bool]:
    """Number the points of a lattice from the ringed point at the corner of the three ringed ones.

    Args:
        lattice: the points.
        ringed: whether each is ringed, (P).
        rings: places of the two other ringed points, (rings[0], 0) and (0, rings[1]).

    Returns:
        The numbered lattice, and whether the ringed points determine its origin and axes: all three are seen, in one
        orientation only.
    """
    template = np.array([(0, 0), (rings[0], 0), (0, rings[1])])
    placed = []
    for found in lattice.turned():
        own = found.indices[ringed]
        for corner in own:
            if all((own == corner + place).all(axis=1).any() for place in template):
                placed.append(Lattice(found.indices - corner, found.pixels))
    return (placed[0], True) if len(placed) == 1 else (lattice.from_first_corner(), False)


def grow_lattice(seed: dict[Index, Node], observe: Callable[[list[Index], list[Node]], Array]) -> dict[Index, Node]:
    """Add neighbours to lattice points until no more are observed.

    Args:
        seed: points to start from, by index.
        observe: pixels (P, 2) of the points at these indices that are expected at these nodes; NaN where there is none.
    """
    nodes = dict(seed)
    frontier = set(seed)
    while frontier:
        expected: dict[Index, Node] = {}
        for index in {_shift(index, axis, sign) for index in frontier for axis, sign in DIRECTIONS} - set(nodes):
            near = [(nodes[other], axis, sign) for other, axis, sign in _neighbours(index) if other in nodes]
            pixel = np.mean([node.pixel - sign * node.steps[axis] for node, axis, sign in near], axis=0)
            expected[index] = Node(pixel, np.mean([node.steps for node, *_ in near], axis=0))
        found = observe(list(expected), list(expected.values())) if expected else np.zeros((0, 2))
        frontier = set()
        for (index, node), pixel in zip(expected.items(), found, strict=True):
            taken = np.linalg.norm([other.pixel - pixel for other in nodes.values()], axis=1).min()
            if np.isnan(pixel).any() or taken < 0.5 * np.linalg.norm(node.steps, axis=1).min():
                continue
            steps = node.steps.copy()
            for axis in (0, 1):
                own = [s * (nodes[o].pixel - pixel) for o, a, s in _neighbours(index) if a == axis and o in nodes]
                if own:
                    steps[axis] = np.mean(own, axis=0)
            nodes[index] = Node(pixel, steps)
            frontier.add(index)
    return nodes


def grid_nodes(grid: Array) -> dict[Index, Node]:
    """Nodes of a full grid of pixels (rows, columns, 2), by column and row."""
    along, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    rows, columns = grid.shape[:2]
    return {
        (column, row): Node(grid[row, column], np.stack([along[row, column], down[row, column]]))
        for row in range(rows)
        for column in range(columns)
    }


def _shift(index: Index, axis: int, sign: int) -> Index:
    return (index[0] + sign, index[1]) if axis == 0 else (index[0], index[1] + sign)


def _neighbours(index: Index) -> Iterator[tuple[Index, int, int]]:
    """Neighbours of an index, each with the axis and the sign of the step to it."""
    for axis, sign in DIRECTIONS:
        yield _shift(index, axis, sign), axis, sign
