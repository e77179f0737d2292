"""Engine of torch tensors on any device: the specification of the kernels, and what runs on a graphics card.

Cells, trajectories and levels of the mesh are dimensions of tensors, so the work of a step is some hundred calls,
whatever the sizes. Everything is in double precision. A card sums in no fixed order, so two runs differ by rounding.

Meshes, factors, tangents and, in Newton's method, the constitutive state stay on the device. What goes to it and back
are positions, right-hand sides, energies, gradients and solutions: four arrays of (B, N, 3) per Newton step.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.constitutive_state import ConstitutiveState, HourglassStiffness
from rafl.fem.enhanced.hourglass import HourglassModes
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.fem.tensors.elements import CellMotion, EnhancedElements, PointElements, TensorElements, of_cells
from rafl.simulation.engine import solve_once
from rafl.solvers.linear import Factors
from rafl.solvers.tensor_blocks import TensorBlockElimination

Array = NDArray[Any]

# Integration points, of all trajectories, that are evaluated together. With tangents a point takes some 7 kB: 30 MB
# stay near the caches of a processor, and 1 GB fills every card.
POINTS_AT_ONCE = {"cpu": 4_096, "cuda": 131_072}


class TorchEngine:
    """Energy, gradient, tangent and linear solves of one mesh with one elastic law.

    Args:
        mesh: the rest shape.
        law: name of the elastic law.
        integration: one of `rafl.fem.material.INTEGRATION_SCHEMES`.
        fixed: indices of the fixed nodes, (F).
        device: name of a torch device.
    """

    def __init__(
        self, mesh: HexMesh, law: str, integration: str, fixed: NDArray[np.int64], device: str = "cpu"
    ) -> None:
        self.mesh = mesh
        self.fixed = fixed
        self.device = torch.device(device)
        self.quadrature = QuadratureRule.from_scheme(mesh, integration)
        self.hourglass_modes = HourglassModes(mesh)
        self._elements: TensorElements = (
            EnhancedElements(self.quadrature, law, self.hourglass_modes, self.device)
            if integration == "enhanced"
            else PointElements(self.quadrature, law, self.device)
        )
        self._hexes = torch.from_numpy(mesh.hexes).to(self.device)
        self._unknowns = (3 * self._hexes[..., None] + torch.arange(3, device=self.device)).reshape(-1)
        self._fixed = torch.from_numpy(fixed).to(self.device)
        self._cells_at_fixed = torch.from_numpy(np.flatnonzero(np.isin(mesh.hexes, fixed).any(axis=1))).to(self.device)

    @cached_property
    def linear_solver(self) -> TensorBlockElimination:
        """The solver of the tangent systems."""
        return TensorBlockElimination(self.mesh, self.fixed, self.device)

    @property
    def free_index(self) -> NDArray[np.int64]:
        """Flat indices into (N * 3) of the unknowns, in the solver's order, (n)."""
        return self.linear_solver.free_index

    @property
    def factorisation_cost(self) -> float:
        """Number of Newton steps with a reused factor that cost as much as a new factor."""
        return self.linear_solver.factorisation_cost

    def _tensor(self, array: Array | Tensor) -> Tensor:
        own = array if isinstance(array, Tensor) else torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64))
        return own.to(self.device)

    def place(self, state: ConstitutiveState) -> ConstitutiveState:
        """The state in tensors on the device."""

        def placed(array: Any) -> Any:
            return None if array is None else self._tensor(array)

        hourglass = state.hourglass
        if hourglass is not None:
            hourglass = HourglassStiffness(*map(placed, (hourglass.elastic, hourglass.viscous, hourglass.damping)))
        names = ("moduli", "viscous_modulus", "memory", "velocity_offset", "hourglass_memory", "energy_weights")
        return replace(state, hourglass=hourglass, **{name: placed(getattr(state, name)) for name in names})

    def _chunks(self, batch: int) -> Iterator[slice]:
        """Slices of the cells that are evaluated together."""
        most = POINTS_AT_ONCE.get(self.device.type, POINTS_AT_ONCE["cuda"])
        count = max(1, most // (batch * self._elements.points))
        for first in range(0, len(self.mesh.hexes), count):
            yield slice(first, first + count)

    def _scatter(self, forces: Tensor) -> Tensor:
        """Sum of the forces of the cells (B, E, 8, 3) at every node, (B, N, 3)."""
        out = forces.new_zeros(len(forces), len(self.mesh.vertices) * 3)
        out.scatter_add_(1, self._unknowns.expand(len(forces), -1), forces.flatten(1))
        return out.reshape(len(forces), -1, 3)

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool = False
    ) -> tuple[Array, Array, Tensor]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, tangents of the cells [N/m] (B, E, 24, 24).

        The tangents are exact, or positive semi-definite if `project`.
        """
        batch, cells = len(q), len(self.mesh.hexes)
        placed, at = self.place(state), self._tensor(q)
        velocity = None
        if placed.velocity_offset is not None:
            velocity = placed.velocity_factor * at - placed.velocity_offset
        energy = at.new_zeros(batch)
        forces = at.new_empty(batch, cells, 8, 3)
        tangents = at.new_empty(batch if tangent else 0, cells, 24, 24)
        for chunk in self._chunks(batch):
            nodes = self._hexes[chunk]
            own = CellMotion(
                chunk, at[:, nodes], None if velocity is None else velocity[:, nodes], of_cells(placed, chunk)
            )
            terms = self._elements.terms(own, tangent=tangent, project=project)
            energy += terms.energy
            forces[:, chunk] = terms.force
            if terms.tangent is not None:
                tangents[:, chunk] = terms.tangent
        return energy.cpu().numpy(), self._scatter(forces).cpu().numpy(), tangents

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """As of `rafl.simulation.compiled_engine.CompiledEngine.strains`."""
        at, along = self._tensor(q), self._tensor(direction)
        parts = [
            self._elements.strains(at[:, self._hexes[chunk]], along[:, self._hexes[chunk]], chunk)
            for chunk in self._chunks(len(q))
        ]
        strain, change = (torch.cat(part, dim=1).cpu().numpy() for part in zip(*parts, strict=True))
        return strain, change

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """As of `rafl.simulation.compiled_engine.CompiledEngine.strains_adjoint`."""
        at, weights = self._tensor(q), self._tensor(by_strain)
        parts = [
            self._elements.strains_adjoint(at[:, self._hexes[chunk]], weights[:, chunk], chunk)
            for chunk in self._chunks(len(q))
        ]
        out: Array = self._scatter(torch.cat(parts, dim=1)).cpu().numpy()
        return out

    def multiply(self, tangents: Tensor, x: Array) -> Array:
        """Tangent times x, both (B, N, 3), on all nodes, including the fixed ones."""
        at_cells = self._tensor(x)[:, self._hexes].reshape(len(x), -1, 24, 1)
        out: Array = self._scatter((tangents @ at_cells).reshape(len(x), -1, 8, 3)).cpu().numpy()
        return out

    def reactions(self, tangents: Tensor, x: Array) -> Array:
        """Tangent times x (B, N, 3) on the fixed nodes, (B, F, 3)."""
        cells = self._cells_at_fixed
        at_cells = self._tensor(x)[:, self._hexes[cells]].reshape(len(x), -1, 24, 1)
        forces = self._tensor(x).new_zeros(len(x), len(self.mesh.hexes), 8, 3)
        forces[:, cells] = (tangents[:, cells] @ at_cells).reshape(len(x), -1, 8, 3)
        out: Array = self._scatter(forces)[:, self._fixed].cpu().numpy()
        return out

    def thread_limit(self, batch: int) -> AbstractContextManager[None]:
        """Context without effect: torch keeps its number of threads."""
        return nullcontext()

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch."""
        return self.linear_solver.allocate(batch)

    def factor(self, factors: Factors, rows: Array, tangents: Tensor, diagonal: Array) -> NDArray[np.bool_]:
        """Factor tangents plus a diagonal (R, n) into `rows` of the storage; True where positive definite."""
        return self.linear_solver.factor(factors, rows, tangents, self._tensor(diagonal))

    def solve(self, factors: Factors, rows: Array, right: Array) -> Array:
        """Solutions (R, C, n) of right-hand sides (R, C, n) with the factors in `rows`."""
        solution: Array = self.linear_solver.solve(factors, rows, self._tensor(right)).cpu().numpy()
        return solution

    def solve_once(self, tangents: Tensor, diagonal: Array, right: Array) -> Array:
        """Solutions (B, C, n) with tangents, possibly indefinite, plus a diagonal (B, n)."""

        def solve_indefinite(row: int) -> Array:
            own = self._tensor(diagonal[row]), self._tensor(right[row])
            solution: Array = self.linear_solver.solve_indefinite(tangents[row], *own).cpu().numpy()
            return solution

        return solve_once(self, self.allocate(len(right)), tangents, diagonal, right, solve_indefinite)
