"""Which linear solver a mesh gets."""

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh
from rafl.solvers.banded import Banded
from rafl.solvers.block_elimination import Levels
from rafl.solvers.linear import LinearSolver
from rafl.solvers.multigrid_cg import Iterative

LITTLE_WORK = 3e8  # multiplications to factor; below it a band wins whatever its levels
MOST_WORK = 1e11  # multiplications to factor; beyond it multigrid wins


def linear_solver(mesh: HexMesh, fixed: NDArray[np.int64]) -> LinearSolver:
    """The solver that is fastest for a mesh (see `make bench-simulator`)."""
    banded, levels = Banded(mesh, fixed), Levels(mesh, fixed)
    if min(banded.work, levels.work) > MOST_WORK:
        return Iterative(mesh, fixed)
    return banded if banded.work <= max(0.6 * levels.work, LITTLE_WORK) else levels
