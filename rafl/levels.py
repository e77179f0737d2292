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

from rafl import blas
from rafl.band import scatter
from rafl.linear import Factors, Unknowns, free_nodes, node_graph, solve_by_pivoting
from rafl.mesh import HexMesh

Array = NDArray[Any]

UPWARD = 1.15  # how much longer elimination from the far end takes

_BLAS = ThreadpoolController()


@dataclass(frozen=True)
class _Level:
    """Where one level's blocks stand in the flat storage."""

    unknowns: slice
    own: slice  # diagonal block, (size, size), column after column
    up: slice  # coupling to the next level, (size of next, size)


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
        ends = np.cumsum(sizes)
        levels, place = [], 0
        for k, size in enumerate(sizes):
            after = sizes[k + 1] if k + 1 < len(sizes) else 0
            own = slice(place, place + size * size)
            up = slice(own.stop, own.stop + size * after)
            levels.append(_Level(slice(ends[k] - size, ends[k]), own, up))
            place = up.stop
        self._levels = levels
        self._size = place
        # Both ends' work alike; from below solves with triangles on the left take longer.
        self._middle = min(range(len(sizes)), key=lambda k: max(_work(sizes[: k + 1]), UPWARD * _work(sizes[k:][::-1])))

    @cached_property
    def _destination(self) -> NDArray[np.int64]:
        rows, columns = self.unknowns.rows, self.unknowns.columns
        level_of = np.repeat(np.arange(len(self._levels)), [_length(level) for level in self._levels])
        start = np.array([level.unknowns.start for level in self._levels])
        length = np.array([_length(level) for level in self._levels])
        own = np.array([level.own.start for level in self._levels])
        up = np.array([level.up.start for level in self._levels])
        low, high = level_of[columns], level_of[rows]
        inside = own[low] + (columns - start[low]) * length[low] + rows - start[low]
        across = up[low] + (columns - start[low]) * length[high] + rows - start[high]
        return np.where(low == high, inside, across)

    def allocate(self, batch: int) -> Factors:
        """Room for the factors of a batch."""
        return Factors(np.zeros((batch, self._size)), np.zeros(batch, dtype=bool))

    def _blocks(self, flat: Array) -> tuple[list[Array], list[Array]]:
        sizes = [_length(level) for level in self._levels]
        own = [flat[level.own].reshape(s, s, order="F") for level, s in zip(self._levels, sizes, strict=True)]
        up = [
            flat[level.up].reshape(after, s, order="F")
            for level, s, after in zip(self._levels, sizes, [*sizes[1:], 0], strict=True)
        ]
        return own, up

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` of the batch; True where the matrix was positive definite."""
        scatter(stiffness.reshape(len(rows), -1), self.unknowns.entries, self._destination, rows, factors.storage)
        last, middle = len(self._levels) - 1, self._middle

        def prepare(row: int) -> tuple[list[Array], list[Array]]:
            own, up = self._blocks(factors.storage[rows[row]])
            for block, level in zip(own, self._levels, strict=True):
                block[np.diag_indices(len(block))] += diagonal[row, level.unknowns]
            return own, up

        blocks = [prepare(row) for row in range(len(rows))]

        def downward(row: int) -> bool:
            own, up = blocks[row]
            for k in range(middle):
                if not blas.cholesky(own[k]):
                    return False
                blas.solve_triangle(own[k], up[k], transposed=True, right=True)
                if k + 1 < middle:
                    blas.subtract_square(own[k + 1], up[k])
            return True

        def upward(row: int) -> bool:
            own, up = blocks[row]
            for k in range(last, middle, -1):
                if not blas.cholesky(own[k]):
                    return False
                blas.solve_triangle(own[k], up[k - 1])
                if k - 1 > middle:
                    blas.subtract_square(own[k - 1], up[k - 1], transposed=True)
            return True

        def meet(row: int) -> bool:
            if not (sides[2 * row] and sides[2 * row + 1]):
                return False
            own, up = blocks[row]
            if middle > 0:
                blas.subtract_square(own[middle], up[middle - 1])
            if middle < last:
                blas.subtract_square(own[middle], up[middle], transposed=True)
            return blas.cholesky(own[middle])

        every = range(len(rows))
        sides = _together([partial(side, r) for r in every for side in (downward, upward)])
        met = _together([partial(meet, r) for r in every])
        factors.ready[rows] = met
        return np.array(met)

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n)."""
        last, middle = len(self._levels) - 1, self._middle

        blocks = [self._blocks(factors.storage[row]) for row in rows]
        parts = [
            [np.asfortranarray(right[row, :, level.unknowns].T) for level in self._levels] for row in range(len(rows))
        ]

        def inward(row: int, side: range, step: int) -> None:
            """Forward substitution from an end up to, not into, the middle."""
            (own, up), x = blocks[row], parts[row]
            for k in side:
                blas.solve_triangle(own[k], x[k])
                if k + step != middle:
                    _take(x[k + step], up[min(k, k + step)], x[k], step)

        def meet(row: int) -> None:
            (own, up), x = blocks[row], parts[row]
            if middle > 0:
                _take(x[middle], up[middle - 1], x[middle - 1], 1)
            if middle < last:
                _take(x[middle], up[middle], x[middle + 1], -1)
            blas.solve_triangle(own[middle], x[middle])
            blas.solve_triangle(own[middle], x[middle], transposed=True)

        def outward(row: int, side: range, step: int) -> None:
            """Back substitution from the middle to an end."""
            (own, up), x = blocks[row], parts[row]
            for k in side:
                _take(x[k], up[min(k, k - step)], x[k - step], step)
                blas.solve_triangle(own[k], x[k], transposed=True)

        every = range(len(rows))
        inner = ((range(middle), 1), (range(last, middle, -1), -1))
        outer = ((range(middle - 1, -1, -1), -1), (range(middle + 1, last + 1), 1))
        _together([partial(inward, r, *side) for r in every for side in inner])
        _together([partial(meet, r) for r in every])
        _together([partial(outward, r, *side) for r in every for side in outer])
        return np.stack([np.concatenate(x).T for x in parts])

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system that no Cholesky factor exists for."""
        return solve_by_pivoting(self.unknowns, stiffness, diagonal, right)


def _take(x: Array, up: Array, y: Array, step: int) -> None:
    """Subtract the coupling of two levels times y from x, the level above where step is 1, below where -1."""
    blas.subtract_product(x, up, y, transposed=step < 0)


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
