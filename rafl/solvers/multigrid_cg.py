"""Conjugate gradients with a multigrid preconditioner, for meshes too large to factor."""

from typing import Any

import numpy as np
import pyamg
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg, minres

from rafl.common.errors import SimulationError
from rafl.fem.mesh import HexMesh
from rafl.solvers.linear import Factors, FreeUnknowns, free_nodes

Array = NDArray[Any]

RELATIVE_TOLERANCE = 1e-10  # of the residual, relative to the right-hand side


class MultigridCG:
    """Conjugate gradients on a sparse matrix, preconditioned by smoothed-aggregation multigrid.

    The near-nullspace is the six rigid-body modes, so the number of iterations hardly grows with the mesh.
    """

    factorisation_cost = 1.5

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64]) -> None:
        self.unknowns = FreeUnknowns(mesh, free_nodes(mesh, fixed))
        self.free_index = self.unknowns.free_index
        x, y, z = (mesh.vertices[self.unknowns.order] - mesh.vertices.mean(0)).T
        zero = np.zeros_like(x)
        rotations = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])  # (3 axes, 3 components, nodes)
        self._rigid_modes = np.concatenate(
            [np.tile(np.eye(3), (len(x), 1)), rotations.transpose(2, 1, 0).reshape(-1, 3) / np.ptp(mesh.vertices)],
            axis=1,
        )

    def allocate(self, batch: int) -> Factors:
        """Storage for the matrices of a batch and their preconditioners."""
        return Factors([None] * batch, np.zeros(batch, dtype=bool))

    def factor(self, factors: Factors, rows: Array, stiffness: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Set up `rows` of the batch; False where the matrix diagonal is not positive."""
        definite = np.empty(len(rows), dtype=bool)
        for r, row in enumerate(rows):
            matrix = self.unknowns.sparse_matrix(stiffness[r], diagonal[r])
            definite[r] = matrix.diagonal().min() > 0.0
            if definite[r]:
                hierarchy = pyamg.smoothed_aggregation_solver(
                    matrix.tobsr((3, 3)),
                    B=self._rigid_modes,
                    strength=("symmetric", {"theta": 0.0}),
                    smooth="jacobi",
                    improve_candidates=None,
                    max_coarse=300,
                )
                factors.storage[row] = matrix, hierarchy.aspreconditioner()
        factors.ready[rows] = definite
        return definite

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) for right-hand sides (R, C, n).

        Raises:
            SimulationError: conjugate gradients did not converge; the matrix may be indefinite.
        """
        out = np.empty_like(right)
        for r, row in enumerate(rows):
            matrix, preconditioner = factors.storage[row]
            for c, rhs in enumerate(right[r]):
                out[r, c], failed = cg(matrix, rhs, rtol=RELATIVE_TOLERANCE, M=preconditioner, maxiter=300)
                if failed:
                    raise SimulationError(
                        f"conjugate gradients on {len(rhs)} unknowns did not converge: the body may be close to "
                        "buckling; try a smaller time step or load"
                    )
        return out

    def solve_indefinite(self, stiffness: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (C, n) of one trajectory's system whose matrix is not positive definite."""
        matrix = self.unknowns.sparse_matrix(stiffness, diagonal)
        scale = sparse.diags_array(1.0 / np.abs(matrix.diagonal()))
        return np.stack([minres(matrix, rhs, rtol=RELATIVE_TOLERANCE, M=scale, maxiter=100_000)[0] for rhs in right])
