"""Block elimination of a block-tridiagonal matrix, for bodies of varying cross-section."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from rafl.fem.mesh import HexMesh
from rafl.solvers import blas
from rafl.solvers.band import scatter_entries
from rafl.solvers.level_sets import LevelSets
from rafl.solvers.linear import Factors, FreeUnknowns, solve_by_sparse_lu

Array = NDArray[Any]

_THREAD_POOLS = ThreadpoolController()


@dataclass(frozen=True)
class _Level:
    """Unknowns of one level and the slices of its blocks, which are column-major, in the flat storage."""

    unknowns: slice
    inward: int  # index of the next level towards the middle; for the middle level, its own index
    diagonal_block: slice  # (size, size)
    coupling: slice  # with the next level inward, (size of that level, size); empty for the middle level


class BlockElimination:
    """Cholesky factors of a block-tridiagonal matrix, by block elimination from both ends to the middle.

    The blocks are the level sets of `rafl.solvers.level_sets`. The cost depends on the size of each cross-section, not
    only on the largest, so this suits bodies with a thin waist. `work` estimates the multiplications of a
    factorisation.
    """

    factorisation_cost = 7.0

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        found = LevelSets.of(mesh, fixed)
        sizes, middle = found.sizes, found.middle
        self.unknowns = FreeUnknowns(mesh, found.order)
        self.free_index = self.unknowns.free_index
        self.work = found.work
        self._middle = middle
        self._sides = (range(middle), range(len(sizes) - 1, middle, -1))  # each from its outermost level
        ends, offset = np.cumsum(sizes), 0
        self._levels: list[_Level] = []
        for k, size in enumerate(sizes):
            inward = k + (k < middle) - (k > middle)
            diagonal_block = slice(offset, offset + size * size)
            coupling = slice(diagonal_block.stop, diagonal_block.stop + (size * sizes[inward] if k != middle else 0))
            self._levels.append(_Level(slice(ends[k] - size, ends[k]), inward, diagonal_block, coupling))
            offset = coupling.stop
        self._size = offset

    @cached_property
    def _destination(self) -> NDArray[np.int64]:
        """Index in the flat storage of each entry, (M)."""
        rows, columns = self.unknowns.rows, self.unknowns.columns
        start = np.array([level.unknowns.start for level in self._levels])
        length = np.array([_level_size(level) for level in self._levels])
        diagonal = np.array([level.diagonal_block.start for level in self._levels])
        coupling = np.array([level.coupling.start for level in self._levels])
        level_of = np.repeat(np.arange(len(length)), length)
        low, high = level_of[columns], level_of[rows]
        inside = diagonal[low] + (columns - start[low]) * length[low] + rows - start[low]
        from_below = coupling[low] + (columns - start[low]) * length[high] + rows - start[high]
        from_above = coupling[high] + (rows - start[high]) * length[low] + columns - start[low]
        return np.asarray(np.where(low == high, inside, np.where(low < self._middle, from_below, from_above)))

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""
        return Factors(np.zeros((batch, self._size)), np.zeros(batch, dtype=bool))

    def _blocks(self, flat: Array) -> tuple[list[Array], list[Array]]:
        """Views of the diagonal and coupling blocks of each level."""
        diagonal_blocks, couplings = [], []
        for level in self._levels:
            size, inward = _level_size(level), _level_size(self._levels[level.inward])
            diagonal_blocks.append(flat[level.diagonal_block].reshape(size, size, order="F"))
            couplings.append(flat[level.coupling].reshape(inward, -1, order="F"))
        return diagonal_blocks, couplings

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` of the batch; True where the matrix is positive definite."""
        scatter_entries(
            stiffness.reshape(len(rows), -1), self.unknowns.entries, self._destination, rows, factors.storage
        )
        blocks = [self._blocks(factors.storage[row]) for row in rows]
        for row, (diagonal_blocks, _) in enumerate(blocks):
            for block, level in zip(diagonal_blocks, self._levels, strict=True):
                block[np.diag_indices(len(block))] += diagonal[row, level.unknowns]

        def eliminate(row: int, side: range) -> bool:
            diagonal_blocks, couplings = blocks[row]
            for k in side:
                if not blas.cholesky(diagonal_blocks[k]):
                    return False
                blas.solve_triangular_right(diagonal_blocks[k], couplings[k])
                if k != side[-1]:
                    blas.subtract_square(diagonal_blocks[self._levels[k].inward], couplings[k])
            return True

        def factor_middle(row: int) -> bool:
            diagonal_blocks, couplings = blocks[row]
            for side in filter(len, self._sides):
                blas.subtract_square(diagonal_blocks[self._middle], couplings[side[-1]])
            return blas.cholesky(diagonal_blocks[self._middle])

        eliminated = _run_in_parallel(
            [partial(eliminate, row, side) for row in range(len(rows)) for side in self._sides]
        )
        both_sides = [eliminated[2 * row] and eliminated[2 * row + 1] for row in range(len(rows))]
        complete = [row for row, done in enumerate(both_sides) if done]
        definite = np.zeros(len(rows), dtype=bool)
        definite[complete] = _run_in_parallel([partial(factor_middle, row) for row in complete])
        factors.ready[rows] = definite
        return definite

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) for right-hand sides (R, C, n)."""
        blocks = [self._blocks(factors.storage[row]) for row in rows]
        x_of_rows = [[np.asfortranarray(rhs[:, level.unknowns].T) for level in self._levels] for rhs in right]

        def solve_inward(row: int, side: range) -> None:
            (diagonal_blocks, couplings), x = blocks[row], x_of_rows[row]
            for k in side:
                blas.solve_triangular(diagonal_blocks[k], x[k])
                if k != side[-1]:
                    blas.subtract_product(x[self._levels[k].inward], couplings[k], x[k])

        def solve_middle(row: int) -> None:
            (diagonal_blocks, couplings), x = blocks[row], x_of_rows[row]
            for side in filter(len, self._sides):
                blas.subtract_product(x[self._middle], couplings[side[-1]], x[side[-1]])
            blas.solve_triangular(diagonal_blocks[self._middle], x[self._middle])
            blas.solve_triangular(diagonal_blocks[self._middle], x[self._middle], transposed=True)

        def solve_outward(row: int, side: range) -> None:
            (diagonal_blocks, couplings), x = blocks[row], x_of_rows[row]
            for k in reversed(side):
                blas.subtract_product(x[k], couplings[k], x[self._levels[k].inward], transposed=True)
                blas.solve_triangular(diagonal_blocks[k], x[k], transposed=True)

        all_rows = range(len(rows))
        _run_in_parallel([partial(solve_inward, row, side) for row in all_rows for side in self._sides])
        _run_in_parallel([partial(solve_middle, row) for row in all_rows])
        _run_in_parallel([partial(solve_outward, row, side) for row in all_rows for side in self._sides])
        return np.stack([np.concatenate(x).T for x in x_of_rows])

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system whose matrix is not positive definite."""
        return solve_by_sparse_lu(self.unknowns, stiffness, diagonal, right)


def _level_size(level: _Level) -> int:
    return int(level.unknowns.stop - level.unknowns.start)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def _run_in_parallel(tasks: list[Callable[[], Any]]) -> list[Any]:
    """Results of tasks that release the interpreter lock, run on as many threads as the kernels use."""
    threads = min(numba.get_num_threads(), len(tasks))
    with _THREAD_POOLS.limit(limits=1, user_api="blas"):
        if threads <= 1:
            return [task() for task in tasks]
        return list(_pool(threads).map(lambda task: task(), tasks))
