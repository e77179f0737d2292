"""Level sets of the mesh graph: an order of the unknowns in which the tangents are block-tridiagonal."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from rafl.fem.mesh import HexMesh
from rafl.solvers.linear import free_nodes, node_graph


@dataclass(frozen=True)
class LevelSets:
    """Breadth-first level sets of the free nodes. Unknowns of two levels are coupled only if these are neighbours.

    Attributes:
        sizes: number of unknowns of each level.
        order: free nodes, sorted by level.
    """

    sizes: list[int]
    order: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: HexMesh, fixed: NDArray[np.int64]) -> "LevelSets":
        """The level sets that cost least to eliminate.

        They start next to the fixed nodes, at an end of the longest side or at a peripheral node.
        """
        free = free_nodes(mesh, fixed)
        candidates = (cls._from(mesh, free, seeds) for seeds in _candidate_seeds(mesh, free, fixed))
        return min(candidates, key=lambda found: found.work)

    @classmethod
    def _from(cls, mesh: HexMesh, free: NDArray[np.int64], seeds: NDArray[np.int64]) -> "LevelSets":
        """The levels from `seeds`, indices into `free`, on."""
        graph = node_graph(mesh, free)
        level = np.full(len(free), -1)
        current, count = seeds, 0
        reached = np.zeros(len(free), dtype=bool)
        while True:
            while len(current):
                level[current] = count
                reached[current] = True
                count += 1
                neighbours = np.unique(graph[current].indices)
                current = neighbours[~reached[neighbours]]
            unreached = np.flatnonzero(~reached)
            if not len(unreached):
                break
            current = unreached[:1]  # start again in a component of the graph not yet reached
        sizes = [3 * int(n) for n in np.bincount(level)]
        return cls(sizes, free[np.argsort(level, kind="stable")])

    @property
    def work(self) -> float:
        """Multiplications to eliminate all levels."""
        return _work(self.sizes)

    @property
    def middle(self) -> int:
        """The level at which eliminations from both ends meet after the same work."""
        sizes = self.sizes
        return min(range(len(sizes)), key=lambda k: max(_work(sizes[: k + 1]), _work(sizes[k:][::-1])))


def _work(sizes: list[int]) -> float:
    """Multiplications to eliminate levels of these sizes in sequence."""
    pairs = zip(sizes, [*sizes[1:], 0], strict=True)
    return sum(s**3 / 3 + s * s * following + s * following * following for s, following in pairs)


def _candidate_seeds(mesh: HexMesh, free: NDArray[np.int64], fixed: NDArray[np.int64]) -> Iterable[NDArray[np.int64]]:
    """Candidate sets of free nodes (indices into `free`) to start the level sets from."""
    graph = node_graph(mesh, free)
    yield np.array([reverse_cuthill_mckee(graph, symmetric_mode=True)[0]])
    along = mesh.vertices[free, np.argmax(np.ptp(mesh.vertices, axis=0))]
    yield np.flatnonzero(along < along.min() + 1e-6 * np.ptp(along))
    cells_at_fixed = np.isin(mesh.hexes, fixed).any(axis=1)
    next_to_fixed = np.flatnonzero(np.isin(free, mesh.hexes[cells_at_fixed]))
    if len(next_to_fixed):
        yield next_to_fixed
