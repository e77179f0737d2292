"""What linear solvers of the tangent systems promise, and what they share.

A matrix comes as the cells' stiffnesses and a diagonal over the free unknowns. Solvers `allocate` room for
a batch of factors, `factor` some of its rows, and `solve` with them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import splu

from rafl.fem.mesh import HexMesh

Array = NDArray[Any]


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


def node_graph(mesh: HexMesh, free: NDArray[np.int64]) -> csr_array:
    """Which free nodes share a cell, by their places in `free`."""
    rows = np.repeat(mesh.hexes, 8, axis=1).ravel()
    columns = np.tile(mesh.hexes, (1, 8)).ravel()
    shape = (len(mesh.vertices),) * 2
    return coo_array((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()[free][:, free].tocsr()


def free_nodes(mesh: HexMesh, fixed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes that are not held, in order."""
    return np.setdiff1d(np.arange(len(mesh.vertices)), fixed)


def solve_by_pivoting(unknowns: Unknowns, stiffness: Array, diagonal: Array, right: Array) -> Array:
    """Solutions (C, n) of right sides (C, n) with one trajectory's matrix, definite or not."""
    return splu(unknowns.sparse(stiffness, diagonal).tocsc()).solve(right.T).T
