"""Factors of a band, for meshes with a small cross-section."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from rafl.fem.mesh import HexMesh
from rafl.fem.simd import LANES
from rafl.solvers.band import allocate, column_length, factor_bands, solve_bands
from rafl.solvers.linear import Factors, Unknowns, free_nodes, node_graph, solve_by_pivoting

Array = NDArray[Any]


class Banded:
    """L D L^T of a band, for meshes with a small cross-section.

    Slices across the longest side and reverse Cuthill-McKee are both tried; the narrower band wins.
    """

    patience = 5.0

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        free = free_nodes(mesh, fixed)
        permuted = free[reverse_cuthill_mckee(node_graph(mesh, free), symmetric_mode=True)]
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
            stiffness.reshape(len(rows), -1),
            diagonal,
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
        """Solutions (R, C, n) of right sides (R, C, n)."""
        x = np.ascontiguousarray(right).copy()
        solve_bands(factors.storage, self._length, rows, x)
        return x

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system that no Cholesky factor exists for."""
        return solve_by_pivoting(self.unknowns, stiffness, diagonal, right)
