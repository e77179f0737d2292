"""Engine of compiled multithreaded kernels."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.elements import element_terms, multiply
from rafl.fem.laws import LAWS
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.solvers.choose import choose_linear_solver
from rafl.solvers.linear import Factors, LinearSolver

Array = NDArray[Any]

MIN_CELLS_FOR_TWO_THREADS = 60  # in the whole batch; below it one thread is as fast as two


class CompiledEngine:
    """Energy, gradient, tangent and linear solves of one mesh with one elastic law.

    Args:
        mesh: the rest shape.
        law: name of the elastic law.
        integration: `full`, or `selective`: lambda at the mean strain of each cell only (B-bar).
        fixed: indices of the fixed nodes, (F).
    """

    def __init__(self, mesh: HexMesh, law: str, integration: str, fixed: NDArray[np.int64]) -> None:
        self.mesh = mesh
        self.fixed = fixed
        self._reused: Factors | None = None  # storage that repeated calls of `solve_once` share
        self.law = law
        self.quadrature = QuadratureRule.from_scheme(mesh, integration)
        cells, groups = len(mesh.hexes), len(self.quadrature.group_shares)
        gradient = self.quadrature.points.gradient.reshape(cells, groups, 8, 8, 3)  # (.., point, node, component)
        self._gradients_by_point = np.ascontiguousarray(gradient.transpose(0, 1, 3, 4, 2)).reshape(cells, groups, 192)
        self._gradients_by_node = np.ascontiguousarray(gradient.transpose(0, 1, 2, 4, 3)).reshape(cells, groups, 192)
        self._volume = self.quadrature.points.volume.reshape(cells, groups, 8)
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

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Array]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, the tangents of the cells [N/m].

        The tangents are opaque: pass them to `factor`, `multiply`, `reactions` or `solve_once`. They are exact, or
        positive semi-definite if `project`.
        """
        batch = len(q)
        energy, gradient = np.empty(batch), np.empty_like(q)
        stiffness = np.empty((batch if tangent else 0, len(self.mesh.hexes), 6, 8, 8))
        unused = np.zeros((1, 1, 1, 1))
        element_terms(
            q,
            self.mesh.hexes,
            self._gradients_by_point,
            self._gradients_by_node,
            self._volume,
            self.quadrature.group_shares,
            LAWS[self.law].kernel.address,
            state.moduli,
            state.damped,
            unused[0] if state.velocity_offset is None else state.velocity_offset,
            unused if state.strain_offset is None else state.strain_offset,
            state.velocity_factor,
            state.strain_factor,
            project,
            tangent,
            energy,
            gradient,
            stiffness,
        )
        return energy, gradient, stiffness

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
        rows = np.arange(len(right))
        if self._reused is None or len(self._reused.ready) != len(right):
            self._reused = self.allocate(len(right))
        factors = self._reused
        definite = self.factor(factors, rows, tangents, diagonal)
        solution = np.empty_like(right)
        if definite.any():
            solution[definite] = self.solve(factors, rows[definite], right[definite])
        for t in np.flatnonzero(~definite):
            solution[t] = self.linear_solver.solve_indefinite(tangents[t], diagonal[t], right[t])
        return solution
