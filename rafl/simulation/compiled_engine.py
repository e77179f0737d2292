"""The simulator's arithmetic in compiled kernels, on the processor's cores."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rafl.fem.constitutive_state import Resistance
from rafl.fem.elements import element_terms, multiply
from rafl.fem.laws import LAWS
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import Integration
from rafl.solvers.choose import linear_solver
from rafl.solvers.linear import Factors, LinearSolver

Array = NDArray[Any]

CELLS_FOR_TWO = 60  # in a batch, below which one thread is as fast as two


class Compiled:
    """Energy, gradient, tangent and linear solves of one mesh under one law.

    Args:
        mesh: the rest shape.
        law: name of the elastic law.
        integration: `full`, or `selective`: lambda's part of each cell's mean strain only (B-bar).
        fixed: held nodes, (F).
    """

    def __init__(self, mesh: HexMesh, law: str, integration: str, fixed: NDArray[np.int64]) -> None:
        self.mesh = mesh
        self.fixed = fixed
        self._room: Factors | None = None  # of `solve_once`, which is called again and again
        self.law = list(LAWS).index(law)
        self.integration = Integration.of(mesh, integration)
        cells, groups = len(mesh.hexes), len(self.integration.shares)
        points = self.integration.points.gradient.reshape(cells, groups, 8, 8, 3)  # by group, point and node
        self._by_point = np.ascontiguousarray(points.transpose(0, 1, 3, 4, 2)).reshape(cells, groups, 192)
        self._by_node = np.ascontiguousarray(points.transpose(0, 1, 2, 4, 3)).reshape(cells, groups, 192)
        self._volume = self.integration.points.volume.reshape(cells, groups, 8)
        self._touching = np.flatnonzero(np.isin(mesh.hexes, fixed).any(axis=1))

    @contextmanager
    def threads(self, batch: int) -> Iterator[None]:
        """One thread where little is to be done: two would spend longer waiting than working."""
        before = numba.get_num_threads()
        if batch * len(self.mesh.hexes) < CELLS_FOR_TWO:
            numba.set_num_threads(1)
        try:
            yield
        finally:
            numba.set_num_threads(before)

    @cached_property
    def linear(self) -> LinearSolver:
        """The direct solver of its tangent systems."""
        return linear_solver(self.mesh, self.fixed)

    @property
    def free_index(self) -> NDArray[np.int64]:
        """Flat indices into (N * 3) of the unknowns, in the solver's order, (n)."""
        return self.linear.free_index

    def terms(
        self, q: Array, resistance: Resistance, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Array]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if wanted, the cells' tangents [N/m].

        Tangents are an opaque array for `factor`, `multiply` and `solve_once`; with `project` they are
        positive semi-definite, else exact.
        """
        batch = len(q)
        energy, gradient = np.empty(batch), np.empty_like(q)
        stiffness = np.empty((batch if tangent else 0, len(self.mesh.hexes), 6, 8, 8))
        none = np.zeros((1, 1, 1, 1))
        element_terms(
            q,
            self.mesh.hexes,
            self._by_point,
            self._by_node,
            self._volume,
            self.integration.shares,
            self.law,
            resistance.moduli,
            resistance.damped,
            none[0] if resistance.drift is None else resistance.drift,
            none if resistance.strain is None else resistance.strain,
            resistance.rate,
            resistance.strain_rate,
            project,
            tangent,
            energy,
            gradient,
            stiffness,
        )
        return energy, gradient, stiffness

    def multiply(self, tangents: Array, x: Array) -> Array:
        """Tangent times x, both (B, N, 3); all nodes, the held ones too."""
        out = np.empty_like(x)
        multiply(tangents, np.arange(len(self.mesh.hexes)), self.mesh.hexes, x, out)
        return out

    def reactions(self, tangents: Array, x: Array) -> Array:
        """Tangent times x (B, N, 3) on the held nodes, (B, F, 3)."""
        out = np.empty_like(x)
        multiply(tangents, self._touching, self.mesh.hexes, x, out)
        return out[:, self.fixed]

    @property
    def patience(self) -> float:
        """How many steps with an old factor cost as much as a new one."""
        return self.linear.patience

    def allocate(self, batch: int) -> Factors:
        """Room for the factors of a batch."""
        return self.linear.allocate(batch)

    def factor(self, factors: Factors, rows: Array, tangents: Array, diagonal: Array) -> NDArray[np.bool_]:
        """Factor tangents plus a diagonal (R, n) into `rows`; True where positive definite."""
        return self.linear.factor(factors, rows, tangents, diagonal)

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n)."""
        return self.linear.solve(factors, rows, right)

    def solve_once(self, tangents: Array, diagonal: Array, right: Array) -> Array:
        """Solutions (B, C, n) with tangents that may be indefinite, plus a diagonal (B, n)."""
        rows = np.arange(len(right))
        if self._room is None or len(self._room.ready) != len(right):
            self._room = self.allocate(len(right))
        factors = self._room
        definite = self.factor(factors, rows, tangents, diagonal)
        solution = np.empty_like(right)
        if definite.any():
            solution[definite] = self.solve(factors, rows[definite], right[definite])
        for t in np.flatnonzero(~definite):
            solution[t] = self.linear.solve_indefinite(tangents[t], diagonal[t], right[t])
        return solution
