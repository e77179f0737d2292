"""Conjugate gradients with multigrid, for meshes too large to factor."""

from typing import Any

import numpy as np
import pyamg
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg, minres

from rafl.common.errors import SimulationError
from rafl.fem.mesh import HexMesh
from rafl.solvers.linear import Factors, Unknowns, free_nodes

Array = NDArray[Any]

TOLERANCE = 1e-10  # of the right side


class Iterative:
    """Conjugate gradients on a sparse matrix, preconditioned by smoothed aggregation multigrid.

    The multigrid knows the six rigid motions, so its iterations hardly grow with the mesh.
    """

    patience = 1.5

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        self.unknowns = Unknowns(mesh, free_nodes(mesh, fixed))
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
                    matrix.tobsr((3, 3)),
                    B=self._rigid,
                    strength=("symmetric", {"theta": 0.0}),
                    smooth="jacobi",
                    improve_candidates=None,
                    max_coarse=300,
                )
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
                out[r, c], failed = cg(matrix, load, rtol=TOLERANCE, M=grids, maxiter=300)
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
        return np.stack([minres(matrix, load, rtol=TOLERANCE, M=scale, maxiter=100_000)[0] for load in right])
