"""Choice of the linear solver for a mesh."""

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh
from rafl.solvers.banded import BandedCholesky
from rafl.solvers.block_elimination import BlockElimination
from rafl.solvers.linear import LinearSolver
from rafl.solvers.multigrid_cg import MultigridCG

# Limits of the multiplications of one factorisation.
MAX_BAND_PREFERRED_WORK = 3e8  # up to here a banded solver is always faster than block elimination
MAX_DIRECT_WORK = 1e11  # beyond this multigrid is faster than both


def choose_linear_solver(mesh: HexMesh, fixed: NDArray[np.int64]) -> LinearSolver:
    """The fastest solver for a mesh; see `make bench-simulator`."""
    banded, blocks = BandedCholesky(mesh, fixed), BlockElimination(mesh, fixed)
    if min(banded.work, blocks.work) > MAX_DIRECT_WORK:
        return MultigridCG(mesh, fixed)
    return banded if banded.work <= max(0.6 * blocks.work, MAX_BAND_PREFERRED_WORK) else blocks
