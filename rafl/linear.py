"""Direct solvers of the tangent systems: narrow bands, and blocks of levels for larger meshes.

Both keep the same promises: `allocate` room for a batch of factors, `factor` some of its rows,
`solve` with them. A matrix comes as the cells' stiffnesses and a diagonal over the free unknowns.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any, Protocol

import numba
import numpy as np
import pyamg
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import cg, minres, splu
from threadpoolctl import ThreadpoolController

from rafl import blas
from rafl.band import allocate, column_length, factor_bands, scatter, solve_bands
from rafl.errors import SimulationError
from rafl.lanes import LANES
from rafl.mesh import HexMesh

Array = NDArray[Any]

UPWARD = 1.15  # how much longer elimination from the far end takes
LITTLE_WORK = 3e8  # multiplications to factor; below it a band wins whatever its levels
MOST_WORK = 1e11  # multiplications to factor; beyond it multigrid wins
ITERATIVE_TOLERANCE = 1e-10  # of the right side

_BLAS = ThreadpoolController()


@dataclass
class Factors:
    """Factors of a batch of matrices, kept from one Newton step to the next.

    Attributes:
        storage: whatever the solver fills, by trajectory.
        ready: which of them can be used, (B).
    """

    storage: Any
    ready: NDArray[np.bool_]


class LinearSolver(Protocol):
    """Factors and solves tangent systems over the free unknowns of one mesh."""

    free_index: NDArray[np.int64]
    unknowns: "Unknowns"
    patience: float  # how many steps with an old factor cost as much as a new one

    def allocate(self, batch: int) -> Factors:
        """Room for the factors of a batch."""

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` of the batch; True where the matrix was positive definite."""

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n)."""

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system that no Cholesky factor exists for."""


class Unknowns:
    """Numbering of the free nodes' unknowns, and where the cells' entries belong.

    Attributes:
        order: free nodes in the order of their unknowns.
        free_index: flat indices into (N * 3) of the unknowns, in order, (n).
        entries: which of the cells' (E * 384) entries count: neither held nor there twice, (M).
        rows, columns: of those entries, row >= column, (M).
    """

    def __init__(self, mesh: HexMesh, order: NDArray[np.int64]) -> None:
        self.order = order
        self.free_index = (3 * order[:, None] + np.arange(3)).ravel()
        first = np.full(len(mesh.vertices), -1, dtype=np.int64)
        first[order] = 3 * np.arange(len(order))
        at = first[mesh.hexes]  # (E, 8)
        rows, columns = [], []
        for i in range(3):
            for k in range(i + 1):
                row, column = np.broadcast_arrays(at[:, :, None] + i, at[:, None, :] + k)
                counts = (at[:, :, None] >= 0) & (at[:, None, :] >= 0)
                if i == k:
                    counts = counts & np.tri(8, dtype=bool)
                rows.append(np.where(counts, np.maximum(row, column), -1).reshape(len(at), 64))
                columns.append(np.where(counts, np.minimum(row, column), -1).reshape(len(at), 64))
        flat = np.concatenate(rows, axis=1).ravel()
        self.entries = np.flatnonzero(flat >= 0)
        self.rows = flat[self.entries]
        self.columns = np.concatenate(columns, axis=1).ravel()[self.entries]

    @property
    def count(self) -> int:
        """Number of unknowns n."""
        return len(self.free_index)

    @cached_property
    def width(self) -> int:
        """Bandwidth, the diagonal included."""
        return int((self.rows - self.columns).max()) + 1

    def sparse(self, stiffness: Array, diagonal: Array) -> csr_array:
        """One trajectory's matrix, both triangles."""
        values = stiffness.reshape(-1)[self.entries]
        lower = coo_array((values, (self.rows, self.columns)), shape=(self.count, self.count)).tocsr()
        lower.setdiag(0.5 * (lower.diagonal() + diagonal))
        return (lower + lower.T).tocsr()


def _graph(mesh: HexMesh, free: NDArray[np.int64]) -> csr_array:
    rows = np.repeat(mesh.hexes, 8, axis=1).ravel()
    columns = np.tile(mesh.hexes, (1, 8)).ravel()
    shape = (len(mesh.vertices),) * 2
    return coo_array((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()[free][:, free].tocsr()


def _free(mesh: HexMesh, fixed: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.setdiff1d(np.arange(len(mesh.vertices)), fixed)


class Banded:
    """L D L^T of a band, for meshes with a small cross-section.

    Slices across the longest side and reverse Cuthill-McKee are both tried; the narrower band wins.
    """

    patience = 5.0

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        free = _free(mesh, fixed)
        permuted = free[reverse_cuthill_mckee(_graph(mesh, free), symmetric_mode=True)]
        places = np.round(mesh.vertices[free] / (1e-6 * np.ptp(mesh.vertices)))
        longest_last = np.argsort(np.ptp(mesh.vertices, axis=0), kind="stable")
        sliced = free[np.lexsort(places[:, longest_last].T)]
        self.unknowns = min((Unknowns(mesh, order) for order in (sliced, permuted)), key=lambda u: u.width)
        self._length = column_length(self.unknowns.width)
        self.work = float(self.unknowns.count) * self.unknowns.width**2
        self.free_index = self.unknowns.free_index

    @cached_property
    def _destination(self) -> NDArray[np.int32]:
        rows, columns = self.unknowns.rows, self.unknowns.columns
        start = LANES * (columns // LANES)
        return (columns * self._length + rows - start).astype(np.int32)

    def allocate(self, batch: int) -> Factors:
        """Room for the factors of a batch."""
        bands = allocate(batch, self.unknowns.count, self.unknowns.width)
        return Factors(bands, np.zeros(batch, dtype=bool))

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` of the batch; True where the matrix was positive definite."""
        pivots = np.empty(len(rows))
        factor_bands(
            stiffness.reshape(len(rows), -1), diagonal, self.unknowns.entries, self._destination, rows,
            factors.storage, self._length, pivots,
        )  # fmt: skip
        factors.ready[rows] = pivots > 0.0
        return pivots > 0.0

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n)."""
        x = np.ascontiguousarray(right).copy()
        solve_bands(factors.storage, self._length, rows, x)
        return x

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system that no Cholesky factor exists for."""
        return _solve_by_pivoting(self.unknowns, stiffness, diagonal, right)


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
        free = _free(mesh, fixed)
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
        return _solve_by_pivoting(self.unknowns, stiffness, diagonal, right)


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
    graph = _graph(mesh, free)
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
    graph = _graph(mesh, free)
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


class Iterative:
    """Conjugate gradients on a sparse matrix, preconditioned by smoothed aggregation multigrid.

    The multigrid knows the six rigid motions, so its iterations hardly grow with the mesh.
    """

    patience = 1.5

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        self.unknowns = Unknowns(mesh, _free(mesh, fixed))
        self.free_index = self.unknowns.free_index
        x, y, z = (mesh.vertices[self.unknowns.order] - mesh.vertices.mean(0)).T
        zero = np.zeros_like(x)
        turns = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])  # (3 axes, 3 components, nodes)
        self._rigid = np.concatenate(
            [np.tile(np.eye(3), (len(x), 1)), turns.transpose(2, 1, 0).reshape(-1, 3) / np.ptp(mesh.vertices)], axis=1
        )

    def allocate(self, batch: int) -> Factors:
        """Room for the matrices of a batch and their multigrids."""
        return Factors([None] * batch, np.zeros(batch, dtype=bool))

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Set up `rows` of the batch; False where a diagonal is not positive."""
        definite = np.empty(len(rows), dtype=bool)
        for r, row in enumerate(rows):
            matrix = self.unknowns.sparse(stiffness[r], diagonal[r])
            definite[r] = matrix.diagonal().min() > 0.0
            if definite[r]:
                grids = pyamg.smoothed_aggregation_solver(
                    matrix.tobsr((3, 3)), B=self._rigid, strength=("symmetric", {"theta": 0.0}),
                    smooth="jacobi", improve_candidates=None, max_coarse=300,
                )  # fmt: skip
                factors.storage[row] = matrix, grids.aspreconditioner()
        factors.ready[rows] = definite
        return definite

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n).

        Raises:
            SimulationError: conjugate gradients did not converge; the matrix may be indefinite.
        """
        out = np.empty_like(right)
        for r, row in enumerate(rows):
            matrix, grids = factors.storage[row]
            for c, load in enumerate(right[r]):
                out[r, c], failed = cg(matrix, load, rtol=ITERATIVE_TOLERANCE, M=grids, maxiter=300)
                if failed:
                    raise SimulationError(
                        f"conjugate gradients on {len(load)} unknowns did not converge: the body may be about to "
                        "buckle; try a smaller time step or load"
                    )
        return out

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system that no Cholesky factor exists for."""
        matrix = self.unknowns.sparse(stiffness, diagonal)
        scale = sparse.diags_array(1.0 / np.abs(matrix.diagonal()))
        return np.stack([minres(matrix, load, rtol=ITERATIVE_TOLERANCE, M=scale, maxiter=100_000)[0] for load in right])


def linear_solver(mesh: HexMesh, fixed: NDArray[np.int64]) -> LinearSolver:
    """The solver that is fastest for a mesh (see `make bench-simulator`)."""
    banded, levels = Banded(mesh, fixed), Levels(mesh, fixed)
    if min(banded.work, levels.work) > MOST_WORK:
        return Iterative(mesh, fixed)
    return banded if banded.work <= max(0.6 * levels.work, LITTLE_WORK) else levels


def _solve_by_pivoting(unknowns: Unknowns, stiffness: Array, diagonal: Array, right: Array) -> Array:
    return splu(unknowns.sparse(stiffness, diagonal).tocsc()).solve(right.T).T
