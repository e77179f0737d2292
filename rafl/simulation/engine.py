"""Interface of the numerical engines: `rafl.simulation.compiled_engine` and `rafl.simulation.torch_engine`."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.enhanced.hourglass import HourglassModes
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.solvers.linear import Factors

Array = NDArray[Any]


class Engine(Protocol):
    """Energy, gradient, tangent and linear solves of one mesh with one elastic law, for batches."""

    mesh: HexMesh
    quadrature: QuadratureRule
    hourglass_modes: HourglassModes

    @property
    def free_index(self) -> Array:
        """Flat indices into (N * 3) of the unknowns, in the solver's order, (n)."""

    @property
    def factorisation_cost(self) -> float:
        """Number of Newton steps with a reused factor that cost as much as a new factor."""

    def place(self, state: ConstitutiveState) -> ConstitutiveState:
        """The state in arrays of the engine's own kind, for many calls of `evaluate`, which takes both."""

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Any]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, tangents [N/m].

        The tangents are opaque: pass them to `factor`, `multiply`, `reactions` or `solve_once`. They are exact, or
        positive semi-definite if `project`.
        """

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """Strains (B, E, Z) that viscous stress depends on, and their change along a direction, both (B, N, 3) [m].

        They are the Green strains at the integration points and, for `enhanced` integration, the hourglass vectors [m].
        """

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """Derivative by q (B, N, 3) of the sum of by_strain (B, E, Z) times the strains, (B, N, 3)."""

    def multiply(self, tangents: Any, x: Array) -> Array:
        """Tangent times x, both (B, N, 3), on all nodes, including the fixed ones."""

    def reactions(self, tangents: Any, x: Array) -> Array:
        """Tangent times x (B, N, 3) on the fixed nodes, (B, F, 3)."""

    def thread_limit(self, batch: int) -> AbstractContextManager[None]:
        """Context that limits the number of threads to what suits a batch of this size."""

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""

    def factor(self, factors: Factors, rows: Array, tangents: Any, diagonal: Array) -> NDArray[np.bool_]:
        """Factor tangents plus a diagonal (R, n) into `rows` of the storage; True where positive definite."""

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right-hand sides (R, C, n) with the factors in `rows`."""

    def solve_once(self, tangents: Any, diagonal: Array, right: Array) -> Array:
        """Solutions (B, C, n) with tangents, possibly indefinite, plus a diagonal (B, n)."""


def solve_once(
    engine: Engine,
    factors: Factors,
    tangents: Any,
    diagonal: Array,
    right: Array,
    solve_indefinite: Callable[[int], Array],
) -> Array:
    """Solutions (B, C, n) by Cholesky factors, into `factors`, and by `solve_indefinite` of a trajectory (C, n)."""
    rows = np.arange(len(right))
    definite = engine.factor(factors, rows, tangents, diagonal)
    solution = np.empty_like(right)
    if definite.any():
        solution[definite] = engine.solve(factors, rows[definite], right[definite])
    for row in np.flatnonzero(~definite):
        solution[row] = solve_indefinite(int(row))
    return solution
