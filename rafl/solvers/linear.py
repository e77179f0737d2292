"""Interface and shared parts of the linear solvers for tangent systems.

A matrix is given by the cell stiffnesses and a diagonal over the free unknowns. A solver allocates storage for the
factors of a batch, factors some rows of the batch, and solves with them. Shapes: B trajectories in the batch, R of
them in one call, C right-hand sides for each, n unknowns, E cells.
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
    """Factors of a batch of matrices, which can be reused in later Newton steps.

    Attributes:
        storage: the solver's own data, indexed by trajectory.
        ready: whether each trajectory has a usable factor, (B).
    """

    storage: Any
    ready: NDArray[np.bool_]


class LinearSolver(Protocol):
    """Solver for tangent systems over the free unknowns of one mesh."""

    free_index: NDArray[np.int64]
    unknowns: "FreeUnknowns"
    factorisation_cost: float  # of a new factor, in Newton steps with an old factor

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor `rows` (R) of the batch; True where the matrix is positive definite.

        stiffness: (R, E, 6, 8, 8) [N/m], lower blocks as from `rafl.fem.elements.element_terms`. diagonal: (R, n).
        """

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) for right-hand sides (R, C, n), with the factors of `rows`."""

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system whose matrix is not positive definite."""


class FreeUnknowns:
    """Numbering of the unknowns (components of the free nodes) and matrix positions of the cell stiffnesses.

    Attributes:
        order: free nodes, in the order of their unknowns.
        free_index: flat index into (N * 3) of each unknown, (n).
        entries: indices into the cell stiffnesses (E * 384): those of free nodes, each symmetric pair once, (M).
        rows, columns: matrix positions of these entries, with row >= column, (M).
    """

    def __init__(self, mesh: HexMesh, order: NDArray[np.int64]) -> None:
        self.order = order
        self.free_index = (3 * order[:, None] + np.arange(3)).ravel()
        unknown_of_node = np.full(len(mesh.vertices), -1, dtype=np.int64)
        unknown_of_node[order] = 3 * np.arange(len(order))
        first_unknowns = unknown_of_node[mesh.hexes]  # (E, 8)
        rows, columns = [], []
        for i in range(3):
            for k in range(i + 1):
                row, column = np.broadcast_arrays(first_unknowns[:, :, None] + i, first_unknowns[:, None, :] + k)
                kept = (first_unknowns[:, :, None] >= 0) & (first_unknowns[:, None, :] >= 0)
                if i == k:
                    kept = kept & np.tri(8, dtype=bool)
                rows.append(np.where(kept, np.maximum(row, column), -1).reshape(len(first_unknowns), 64))
                columns.append(np.where(kept, np.minimum(row, column), -1).reshape(len(first_unknowns), 64))
        flat = np.concatenate(rows, axis=1).ravel()
        self.entries = np.flatnonzero(flat >= 0)
        self.rows = flat[self.entries]
        self.columns = np.concatenate(columns, axis=1).ravel()[self.entries]

    @property
    def count(self) -> int:
        """Number of unknowns n."""
        return len(self.free_index)

    @cached_property
    def bandwidth(self) -> int:
        """Bandwidth, including the diagonal."""
        return int((self.rows - self.columns).max()) + 1

    def sparse_matrix(self, stiffness: Array, diagonal: Array) -> csr_array:
        """Full symmetric matrix of one trajectory."""
        values = stiffness.reshape(-1)[self.entries]
        lower = coo_array((values, (self.rows, self.columns)), shape=(self.count, self.count)).tocsr()
        lower.setdiag(0.5 * (lower.diagonal() + diagonal))
        return (lower + lower.T).tocsr()


def node_graph(mesh: HexMesh, free: NDArray[np.int64]) -> csr_array:
    """Adjacency of the free nodes: nodes of one cell are adjacent. Rows and columns index `free`."""
    rows = np.repeat(mesh.hexes, 8, axis=1).ravel()
    columns = np.tile(mesh.hexes, (1, 8)).ravel()
    shape = (len(mesh.vertices),) * 2
    return coo_array((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()[free][:, free].tocsr()


def free_nodes(mesh: HexMesh, fixed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes that are not fixed, in ascending order."""
    return np.setdiff1d(np.arange(len(mesh.vertices)), fixed)


def solve_by_sparse_lu(unknowns: FreeUnknowns, stiffness: Array, diagonal: Array, right: Array) -> Array:
    """Solutions (C, n) for right-hand sides (C, n) of one trajectory, by LU factors; the matrix may be indefinite."""
    return np.asarray(splu(unknowns.sparse_matrix(stiffness, diagonal).tocsc()).solve(right.T).T)
