"""Banded Cholesky factorisation, for meshes with a small cross-section."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from rafl.fem.mesh import HexMesh
from rafl.fem.simd import SIMD_LANES
from rafl.solvers.band import allocate_bands, column_length, factor_bands, solve_bands
from rafl.solvers.linear import Factors, FreeUnknowns, free_nodes, node_graph, solve_by_sparse_lu

Array = NDArray[Any]


class BandedCholesky:
    """L D L^T factors of a banded matrix, for meshes with a small cross-section.

    Two orderings are compared, by slices across the longest side and by reverse Cuthill-McKee. The one of smaller
    bandwidth is used. `work` estimates the multiplications of a factorisation.
    """

    factorisation_cost = 5.0

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        free = free_nodes(mesh, fixed)
        permuted = free[reverse_cuthill_mckee(node_graph(mesh, free), symmetric_mode=True)]
        rounded = np.round(mesh.vertices[free] / (1e-6 * np.ptp(mesh.vertices)))
        by_extent = np.argsort(np.ptp(mesh.vertices, axis=0), kind="stable")
        sliced = free[np.lexsort(rounded[:, by_extent].T)]
        self.unknowns = min((FreeUnknowns(mesh, order) for order in (sliced, permuted)), key=lambda u: u.bandwidth)
        self._length = column_length(self.unknowns.bandwidth)
        self.work = float(self.unknowns.count) * self.unknowns.bandwidth**2
        self.free_index = self.unknowns.free_index

    @cached_property
    def _destination(self) -> NDArray[np.int32]:
        """Index in the band of each entry, (M)."""
        rows, columns = self.unknowns.rows, self.unknowns.columns
        start = SIMD_LANES * (columns // SIMD_LANES)
        destination: NDArray[np.int32] = (columns * self._length + rows - start).astype(np.int32)
        return destination

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""
        bands = allocate_bands(batch, self.unknowns.count, self.unknowns.bandwidth)
        return Factors(bands, np.zeros(batch, dtype=bool))

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` of the batch; True where the matrix is positive definite."""
        pivots = np.empty(len(rows))
        factor_bands(
            stiffness.reshape(len(rows), -1),
            np.ascontiguousarray(diagonal),  # one layout, for which the kernel is compiled once
            self.unknowns.entries,
            self._destination,
            rows,
            factors.storage,
            self._length,
            pivots,
        )
        factors.ready[rows] = pivots > 0.0
        return pivots > 0.0

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) for right-hand sides (R, C, n)."""
        x = np.ascontiguousarray(right).copy()
        solve_bands(factors.storage, self._length, rows, x)
        return x

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system whose matrix is not positive definite."""
        return solve_by_sparse_lu(self.unknowns, stiffness, diagonal, right)
