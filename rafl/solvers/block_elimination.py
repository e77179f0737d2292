"""Factors of a block-tridiagonal matrix, for bodies of uneven section."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee
from threadpoolctl import ThreadpoolController

from rafl.fem.mesh import HexMesh
from rafl.solvers import blas
from rafl.solvers.band import scatter
from rafl.solvers.linear import Factors, Unknowns, free_nodes, node_graph, solve_by_pivoting

Array = NDArray[Any]

_BLAS = ThreadpoolController()


@dataclass(frozen=True)
class _Level:
    """Where one level's blocks stand in the flat storage, column after column."""

    unknowns: slice
    inward: int  # the next level towards the middle; of the middle itself, its own number
    own: slice  # diagonal block, (size, size)
    coupling: slice  # to the next level inward, (size of that, size); the middle has none


class Levels:
    """Cholesky factors of a block-tridiagonal matrix, eliminated from both ends at once.

    The blocks are the level sets of the mesh's graph as seen from the held nodes or from an end of its
    longest side, so a body with a thin waist costs what its sections cost and not what its thickest does.
    """

    patience = 7.0

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        free = free_nodes(mesh, fixed)
        sizes, order = min(
            (_level_sets(mesh, free, seeds) for seeds in _seeds(mesh, free, fixed)), key=lambda found: _work(found[0])
        )
        self.unknowns = Unknowns(mesh, order)
        self.free_index = self.unknowns.free_index
        self.work = _work(sizes)
        middle = min(range(len(sizes)), key=lambda k: max(_work(sizes[: k + 1]), _work(sizes[k:][::-1])))
        self._middle = middle
        self._sides = (range(middle), range(len(sizes) - 1, middle, -1))  # outermost level first
        ends, place = np.cumsum(sizes), 0
        self._levels: list[_Level] = []
        for k, size in enumerate(sizes):
            inward = k + (k < middle) - (k > middle)
            own = slice(place, place + size * size)
            coupling = slice(own.stop, own.stop + (size * sizes[inward] if k != middle else 0))
            self._levels.append(_Level(slice(ends[k] - size, ends[k]), inward, own, coupling))
            place = coupling.stop
        self._size = place

    @cached_property
    def _destination(self) -> NDArray[np.int64]:
        rows, columns = self.unknowns.rows, self.unknowns.columns
        start = np.array([level.unknowns.start for level in self._levels])
        length = np.array([_length(level) for level in self._levels])
        own = np.array([level.own.start for level in self._levels])
        coupling = np.array([level.coupling.start for level in self._levels])
        level_of = np.repeat(np.arange(len(length)), length)
        low, high = level_of[columns], level_of[rows]
        inside = own[low] + (columns - start[low]) * length[low] + rows - start[low]
        from_below = coupling[low] + (columns - start[low]) * length[high] + rows - start[high]
        from_above = coupling[high] + (rows - start[high]) * length[low] + columns - start[low]
        return np.where(low == high, inside, np.where(low < self._middle, from_below, from_above))

    def allocate(self, batch: int) -> Factors:
        """Room for the factors of a batch."""
        return Factors(np.zeros((batch, self._size)), np.zeros(batch, dtype=bool))

    def _blocks(self, flat: Array) -> tuple[list[Array], list[Array]]:
        """Diagonal blocks and couplings, by level."""
        own, couplings = [], []
        for level in self._levels:
            size, inward = _length(level), _length(self._levels[level.inward])
            own.append(flat[level.own].reshape(size, size, order="F"))
            couplings.append(flat[level.coupling].reshape(inward, -1, order="F"))
        return own, couplings

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` of the batch; True where the matrix was positive definite."""
        scatter(stiffness.reshape(len(rows), -1), self.unknowns.entries, self._destination, rows, factors.storage)
        blocks = [self._blocks(factors.storage[row]) for row in rows]
        for row, (own, _) in enumerate(blocks):
            for block, level in zip(own, self._levels, strict=True):
                block[np.diag_indices(len(block))] += diagonal[row, level.unknowns]

        def eliminate(row: int, side: range) -> bool:
            own, couplings = blocks[row]
            for k in side:
                if not blas.cholesky(own[k]):
                    return False
                blas.solve_transposed_right(own[k], couplings[k])
                if k != side[-1]:
                    blas.subtract_square(own[self._levels[k].inward], couplings[k])
            return True

        def meet(row: int) -> bool:
            own, couplings = blocks[row]
            for side in filter(len, self._sides):
                blas.subtract_square(own[self._middle], couplings[side[-1]])
            return blas.cholesky(own[self._middle])

        eliminated = _together([partial(eliminate, row, side) for row in range(len(rows)) for side in self._sides])
        both = [eliminated[2 * row] and eliminated[2 * row + 1] for row in range(len(rows))]
        whole = [row for row, done in enumerate(both) if done]
        definite = np.zeros(len(rows), dtype=bool)
        definite[whole] = _together([partial(meet, row) for row in whole])
        factors.ready[rows] = definite
        return definite

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n)."""
        blocks = [self._blocks(factors.storage[row]) for row in rows]
        parts = [[np.asfortranarray(load[:, level.unknowns].T) for level in self._levels] for load in right]

        def inward(row: int, side: range) -> None:
            (own, couplings), x = blocks[row], parts[row]
            for k in side:
                blas.solve_triangle(own[k], x[k])
                if k != side[-1]:
                    blas.subtract_product(x[self._levels[k].inward], couplings[k], x[k])

        def meet(row: int) -> None:
            (own, couplings), x = blocks[row], parts[row]
            for side in filter(len, self._sides):
                blas.subtract_product(x[self._middle], couplings[side[-1]], x[side[-1]])
            blas.solve_triangle(own[self._middle], x[self._middle])
            blas.solve_triangle(own[self._middle], x[self._middle], transposed=True)

        def outward(row: int, side: range) -> None:
            (own, couplings), x = blocks[row], parts[row]
            for k in reversed(side):
                blas.subtract_product(x[k], couplings[k], x[self._levels[k].inward], transposed=True)
                blas.solve_triangle(own[k], x[k], transposed=True)

        every = range(len(rows))
        _together([partial(inward, row, side) for row in every for side in self._sides])
        _together([partial(meet, row) for row in every])
        _together([partial(outward, row, side) for row in every for side in self._sides])
        return np.stack([np.concatenate(x).T for x in parts])

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system that no Cholesky factor exists for."""
        return solve_by_pivoting(self.unknowns, stiffness, diagonal, right)


def _length(level: _Level) -> int:
    return level.unknowns.stop - level.unknowns.start


def _work(sizes: list[int]) -> float:
    pairs = zip(sizes, [*sizes[1:], 0], strict=True)
    return sum(s**3 / 3 + s * s * after + s * after * after for s, after in pairs)


def _seeds(mesh: HexMesh, free: NDArray[np.int64], fixed: NDArray[np.int64]) -> Iterable[NDArray[np.int64]]:
    """Sets of free nodes (as places in `free`) from which levels may be counted."""
    graph = node_graph(mesh, free)
    yield np.array([reverse_cuthill_mckee(graph, symmetric_mode=True)[0]])
    along = mesh.vertices[free, np.argmax(np.ptp(mesh.vertices, axis=0))]
    yield np.flatnonzero(along < along.min() + 1e-6 * np.ptp(along))
    touching = np.isin(mesh.hexes, fixed).any(axis=1)
    beside = np.flatnonzero(np.isin(free, mesh.hexes[touching]))
    if len(beside):
        yield beside


def _level_sets(
    mesh: HexMesh, free: NDArray[np.int64], seeds: NDArray[np.int64]
) -> tuple[list[int], NDArray[np.int64]]:
    """Sizes (in unknowns) of the breadth-first levels from `seeds`, and the nodes level by level."""
    graph = node_graph(mesh, free)
    level = np.full(len(free), -1)
    current, count = seeds, 0
    reached = np.zeros(len(free), dtype=bool)
    while True:
        while len(current):
            level[current] = count
            reached[current] = True
            count += 1
            near = np.unique(graph[current].indices)
            current = near[~reached[near]]
        rest = np.flatnonzero(~reached)
        if not len(rest):
            break
        current = rest[:1]  # a part that hangs together with nothing yet reached
    sizes = [3 * int(n) for n in np.bincount(level)]
    return sizes, free[np.argsort(level, kind="stable")]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def _together(tasks: list[Callable[[], Any]]) -> list[Any]:
    """Results of tasks that release the interpreter, on as many threads as the kernels use."""
    threads = min(numba.get_num_threads(), len(tasks))
    with _BLAS.limit(limits=1, user_api="blas"):
        if threads <= 1:
            return [task() for task in tasks]
        return list(_pool(threads).map(lambda task: task(), tasks))
