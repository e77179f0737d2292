"""What the simulator asks of its arithmetic; `rafl.simulation.compiled_engine` and `rafl.simulation.reference_engine` both answer."""

from contextlib import AbstractContextManager
from typing import Any, Protocol

from numpy.typing import NDArray

from rafl.fem.constitutive_state import Resistance
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import Integration
from rafl.solvers.linear import Factors

Array = NDArray[Any]


class Engine(Protocol):
    """Energy, gradient, tangent and linear solves of one mesh under one law, for batches."""

    mesh: HexMesh
    integration: Integration

    @property
    def free_index(self) -> Array:
        """Flat indices into (N * 3) of the unknowns, in the solver's order, (n)."""

    @property
    def patience(self) -> float:
        """How many steps with an old factor cost as much as a new one."""

    def terms(
        self, q: Array, resistance: Resistance, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Any]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if wanted, tangents [N/m].

        Tangents are for `factor`, `multiply` and `solve_once` only; with `project` they are positive
        semi-definite, else exact.
        """

    def multiply(self, tangents: Any, x: Array) -> Array:
        """Tangent times x, both (B, N, 3); all nodes, the held ones too."""

    def reactions(self, tangents: Any, x: Array) -> Array:
        """Tangent times x (B, N, 3) on the held nodes, (B, F, 3)."""

    def threads(self, batch: int) -> AbstractContextManager[None]:
        """As many threads as a batch of this size is worth."""

    def allocate(self, batch: int) -> Factors:
        """Room for the factors of a batch."""

    def factor(self, factors: Factors, rows: Array, tangents: Any, diagonal: Array) -> NDArray:
        """Factor tangents plus a diagonal (R, n) into `rows`; True where positive definite."""

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right sides (R, C, n)."""

    def solve_once(self, tangents: Any, diagonal: Array, right: Array) -> Array:
        """Solutions (B, C, n) with tangents that may be indefinite, plus a diagonal (B, n)."""
