"""Engine of compiled multithreaded kernels."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.elements import multiply
from rafl.fem.enhanced.hourglass import HourglassModes
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.simulation.compiled_elements import CompiledElements, EnhancedElements, PointElements
from rafl.simulation.engine import solve_once
from rafl.solvers.choose import choose_linear_solver
from rafl.solvers.linear import Factors, LinearSolver

Array = NDArray[Any]

MIN_CELLS_FOR_TWO_THREADS = 60  # in the whole batch; below it one thread is as fast as two


class CompiledEngine:
    """Energy, gradient, tangent and linear solves of one mesh with one elastic law.

    Args:
        mesh: the rest shape.
        law: name of the elastic law.
        integration: one of `rafl.fem.material.INTEGRATION_SCHEMES`.
        fixed: indices of the fixed nodes, (F).
    """

    def __init__(self, mesh: HexMesh, law: str, integration: str, fixed: NDArray[np.int64]) -> None:
        self.mesh = mesh
        self.fixed = fixed
        self.integration = integration
        self._reused: Factors | None = None  # storage that repeated calls of `solve_once` share
        self.quadrature = QuadratureRule.from_scheme(mesh, integration)
        self.hourglass_modes = HourglassModes(mesh)
        self._elements: CompiledElements = (
            EnhancedElements(self.hourglass_modes, law)
            if integration == "enhanced"
            else PointElements(mesh, law, self.quadrature)
        )
        self._cells_at_fixed = np.flatnonzero(np.isin(mesh.hexes, fixed).any(axis=1))

    @contextmanager
    def thread_limit(self, batch: int) -> Iterator[None]:
        """Context that uses one thread for a small batch: two would spend more time waiting than working."""
        before = numba.get_num_threads()
        if batch * len(self.mesh.hexes) < MIN_CELLS_FOR_TWO_THREADS:
            numba.set_num_threads(1)
        try:
            yield
        finally:
            numba.set_num_threads(before)

    @cached_property
    def linear_solver(self) -> LinearSolver:
        """The solver of the tangent systems."""
        return choose_linear_solver(self.mesh, self.fixed)

    @property
    def free_index(self) -> NDArray[np.int64]:
        """Flat indices into (N * 3) of the unknowns, in the solver's order, (n)."""
        return self.linear_solver.free_index

    def place(self, state: ConstitutiveState) -> ConstitutiveState:
        """The state itself: the kernels take arrays."""
        return state

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Array]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, the tangents of the cells [N/m].

        The tangents are opaque: pass them to `factor`, `multiply`, `reactions` or `solve_once`. They are exact, or
        positive semi-definite if `project`.
        """
        return self._elements.evaluate(q, state, tangent=tangent, project=project)

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """Strains (B, E, Z) that viscous stress depends on, and their change along a direction, both (B, N, 3) [m].

        They are the Green strains at the integration points and, for `enhanced` integration, the hourglass vectors [m].
        """
        return self._elements.strains(q, direction)

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """Derivative by q (B, N, 3) of the sum of by_strain (B, E, Z) times the strains, (B, N, 3)."""
        return self._elements.strains_adjoint(q, by_strain)

    def multiply(self, tangents: Array, x: Array) -> Array:
        """Tangent times x, both (B, N, 3), on all nodes, including the fixed ones."""
        out = np.empty_like(x)
        multiply(tangents, np.arange(len(self.mesh.hexes)), self.mesh.hexes, x, out)
        return out

    def reactions(self, tangents: Array, x: Array) -> Array:
        """Tangent times x (B, N, 3) on the fixed nodes, (B, F, 3)."""
        out = np.empty_like(x)
        multiply(tangents, self._cells_at_fixed, self.mesh.hexes, x, out)
        return out[:, self.fixed]

    @property
    def factorisation_cost(self) -> float:
        """Number of Newton steps with a reused factor that cost as much as a new factor."""
        return self.linear_solver.factorisation_cost

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""
        return self.linear_solver.allocate(batch)

    def factor(self, factors: Factors, rows: Array, tangents: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor tangents plus a diagonal (R, n) into `rows` of the storage; True where positive definite."""
        return self.linear_solver.factor(factors, rows, tangents, diagonal)

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right-hand sides (R, C, n) with the factors in `rows`."""
        return self.linear_solver.solve(factors, rows, right)

    def solve_once(self, tangents: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (B, C, n) with tangents, possibly indefinite, plus a diagonal (B, n)."""
        if self._reused is None or len(self._reused.ready) != len(right):
            self._reused = self.allocate(len(right))

        def solve_indefinite(row: int) -> Array:
            return self.linear_solver.solve_indefinite(tangents[row], diagonal[row], right[row])

        return solve_once(self, self._reused, tangents, diagonal, right, solve_indefinite)
