"""Energy, forces and tangents of cells in tensors, behind one interface for all integration schemes.

Shapes: B bodies, E cells of the mesh, C of them in one call. Tangents have rows and columns 3 n + i for component i of
node n.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.enhanced.hourglass import MODES, HourglassModes
from rafl.fem.quadrature import QuadratureRule
from rafl.fem.strain import MULTIPLICITY
from rafl.fem.tensors.constants import numbers
from rafl.fem.tensors.hourglass import HourglassFrame, modes_energy
from rafl.fem.tensors.stress import Point, Terms, components, damping, elastic, symmetric, viscous


@dataclass(frozen=True)
class CellMotion:
    """What the terms of some cells depend on.

    Attributes:
        cells: which of the mesh.
        x: nodal positions [m], (B, C, 8, 3).
        velocity: of the nodes [m/s], (B, C, 8, 3); None without stiffness damping.
        state: of these cells, see `of_cells`.
    """

    cells: slice
    x: Tensor
    velocity: Tensor | None
    state: ConstitutiveState


@dataclass(frozen=True)
class CellTerms:
    """Energy [J] (B), forces [N] (B, C, 8, 3) and, if asked for, tangents [N/m] (B, C, 24, 24)."""

    energy: Tensor
    force: Tensor
    tangent: Tensor | None


class TensorElements(Protocol):
    """Energy, forces, tangents and strains of the cells of one mesh."""

    points: int  # of a cell

    def terms(self, at: CellMotion, *, tangent: bool, project: bool) -> CellTerms:
        """Terms of the cells; tangents, if asked for, are exact, or positive semi-definite if `project`."""

    def strains(self, x: Tensor, direction: Tensor, cells: slice) -> tuple[Tensor, Tensor]:
        """As of `rafl.simulation.engine.Engine.strains`, both (B, C, Z)."""

    def strains_adjoint(self, x: Tensor, by_strain: Tensor, cells: slice) -> Tensor:
        """Nodal derivatives (B, C, 8, 3) of the sum of by_strain (B, C, Z) times the strains."""


class PointElements:
    """Cells whose energy is that of their integration points: `full` and `selective` integration."""

    def __init__(self, rule: QuadratureRule, law: str, device: torch.device) -> None:
        self.law = law
        self.points = len(rule.points.shape)
        gradient = torch.from_numpy(rule.points.gradient).to(device)  # (E, P, 8, 3)
        self._gradient = gradient.transpose(1, 2).flatten(2)  # (E, 8, 3 P)
        self._volume = torch.from_numpy(rule.points.volume).to(device)
        self._shares = torch.from_numpy(rule.point_shares).to(device)

    def gradients(self, x: Tensor, cells: slice) -> Tensor:
        """Gradients (B, C, P, 3, 3) of nodal values (B, C, 8, 3)."""
        flat = x.mT @ self._gradient[cells]  # (B, C, 3, 3 P)
        return flat.reshape(*flat.shape[:-1], self.points, 3).transpose(2, 3).contiguous()

    def nodal(self, stress: Tensor, cells: slice) -> Tensor:
        """Nodal forces (B, C, 8, 3) of stresses times volume (B, C, P, 3, 3)."""
        return self._gradient[cells] @ stress.mT.flatten(2, 3)

    def stress(self, at: CellMotion, tangent: bool, project: bool) -> tuple[Point, Terms]:
        """Energy, stress and tangent at the points, times their volume."""
        state = at.state
        point = Point.of(self.gradients(at.x, at.cells))
        terms = elastic(self.law, point, self._shares, state, tangent, project)
        if state.memory is not None:
            assert state.viscous_modulus is not None
            own = self._shares[:, 0]
            terms = terms + viscous(point, own, state.viscous_modulus, state.memory, tangent, project)
        if at.velocity is not None:
            rate = self.gradients(at.velocity, at.cells)
            terms = terms + damping(rate, self._shares, state.moduli, state.velocity_factor, tangent)
        volume = self._volume[at.cells]
        return point, Terms(
            terms.energy * volume,
            terms.stress * volume[..., None, None],
            None if terms.tangent is None else terms.tangent * volume[..., None, None],
        )

    def terms(self, at: CellMotion, *, tangent: bool, project: bool) -> CellTerms:
        """Terms of the cells; tangents, if asked for, are exact, or positive semi-definite if `project`."""
        _, terms = self.stress(at, tangent, project)
        cell_tangent = None
        if terms.tangent is not None:
            batch, count = at.x.shape[:2]
            gradient = self._gradient[at.cells]
            by_point = gradient.reshape(-1, 8, self.points, 3).permute(0, 2, 3, 1)  # (C, P, 3, 8)
            half = terms.tangent.reshape(batch, count, self.points, 27, 3) @ by_point
            half = half.reshape(batch, count, self.points, 3, 3, 24).transpose(3, 4)  # .., j, i, k and node
            flat = gradient @ half.reshape(batch, count, 3 * self.points, 72)
            cell_tangent = flat.reshape(batch, count, 24, 3, 8).transpose(-1, -2).reshape(batch, count, 24, 24)
        return CellTerms(terms.energy.sum((1, 2)), self.nodal(terms.stress, at.cells), cell_tangent)

    def strains(self, x: Tensor, direction: Tensor, cells: slice) -> tuple[Tensor, Tensor]:
        """Green strains, and their change along a direction."""
        F, change = self.gradients(x, cells), self.gradients(direction, cells)
        strain = 0.5 * (F.mT @ F - torch.eye(3, dtype=F.dtype, device=F.device))
        product = F.mT @ change
        both = strain, 0.5 * (product + product.mT)
        first, second = (components(tensor).flatten(2) for tensor in both)
        return first, second

    def strains_adjoint(self, x: Tensor, by_strain: Tensor, cells: slice) -> Tensor:
        """Derivative of the weighted sum of the strains."""
        weights = by_strain.reshape(*by_strain.shape[:-1], self.points, 6) / numbers(
            tuple(MULTIPLICITY), by_strain.device
        )
        return self.nodal(self.gradients(x, cells) @ symmetric(weights), cells)


class EnhancedElements:
    """Cells with one integration point and stabilised hourglass modes: `enhanced` integration."""

    points = 1

    def __init__(self, rule: QuadratureRule, law: str, modes: HourglassModes, device: torch.device) -> None:
        self._mean = PointElements(rule, law, device)
        self._gamma = torch.from_numpy(modes.gamma).to(device)
        self._shape_index = torch.from_numpy(modes.shape_index).to(device)
        columns = np.concatenate([rule.points.gradient[:, 0].transpose(0, 2, 1), modes.gamma], axis=1)
        self._columns = torch.from_numpy(columns).to(device)  # (E, 7, 8)

    def _of_cells(self, stiffness: Tensor, cells: slice) -> Tensor:
        """Stiffness (B, U, 12, 12) of the shapes, by cell (B, C or 1, 12, 12)."""
        return stiffness if stiffness.shape[1] == 1 else stiffness[:, self._shape_index[cells]]

    def terms(self, at: CellMotion, *, tangent: bool, project: bool) -> CellTerms:
        """Terms of the cells; tangents, if asked for, are exact, or positive semi-definite if `project`."""
        state, cells = at.state, at.cells
        assert state.hourglass is not None
        gamma, shape = self._gamma[cells], at.x.shape[:2]
        point, terms = self._mean.stress(at, tangent, project)
        frame = HourglassFrame.of(point, gamma @ at.x)
        elastic_part, viscous_part = (
            self._of_cells(part, cells) for part in (state.hourglass.elastic, state.hourglass.viscous)
        )
        energy, force, stiffness = modes_energy(
            frame.local, elastic_part, viscous_part, state.viscous_modulus, state.hourglass_memory
        )
        total = terms.energy.sum((1, 2)) + energy.sum(1)
        on_gradient, on_vectors = frame.forces(force)
        whole = frame.tangent(stiffness.expand(*shape, MODES, MODES), force, project) if tangent else None
        if at.velocity is not None:
            damped = self._of_cells(state.hourglass.damping, cells)
            rate = (gamma @ at.velocity).flatten(-2)
            along = (damped @ rate[..., None])[..., 0]
            total = total + 0.5 / state.velocity_factor * (rate * along).sum((1, 2))
            on_vectors = on_vectors + along.reshape(*shape, 4, 3)
            if whole is not None:
                whole[..., 9:, 9:] += state.velocity_factor * damped
        nodal = self._mean.nodal(terms.stress + on_gradient[:, :, None], cells) + gamma.mT @ on_vectors
        if whole is None or terms.tangent is None:
            return CellTerms(total, nodal, None)
        mean = terms.tangent.reshape(*shape, 3, 3, 3, 3).permute(0, 1, 3, 2, 5, 4)  # rows and columns 3 j + i
        whole[..., :9, :9] += mean.reshape(*shape, 9, 9)
        columns = self._columns[cells]
        half = columns.mT @ whole.reshape(*shape, 7, 63)
        half = half.reshape(*shape, 24, 7, 3).transpose(-1, -2).reshape(*shape, 72, 7)  # node, component, component
        flat = (half @ columns).reshape(*shape, 24, 3, 8)
        return CellTerms(total, nodal, flat.transpose(-1, -2).reshape(*shape, 24, 24))

    def strains(self, x: Tensor, direction: Tensor, cells: slice) -> tuple[Tensor, Tensor]:
        """Green strains, then hourglass vectors, and their change along a direction."""
        gamma = self._gamma[cells]
        frame = HourglassFrame.of(Point.of(self._mean.gradients(x, cells)), gamma @ x)
        change = frame.change(self._mean.gradients(direction, cells)[:, :, 0], gamma @ direction)
        strain, along = self._mean.strains(x, direction, cells)
        return torch.cat([strain, frame.local], dim=-1), torch.cat([along, change], dim=-1)

    def strains_adjoint(self, x: Tensor, by_strain: Tensor, cells: slice) -> Tensor:
        """Derivative of the weighted sum of the strains."""
        gamma = self._gamma[cells]
        frame = HourglassFrame.of(Point.of(self._mean.gradients(x, cells)), gamma @ x)
        on_gradient, on_vectors = frame.forces(by_strain[..., 6:])
        # Forces on the mean gradient act at the point, whose weight here is 1.
        own = self._mean.strains_adjoint(x, by_strain[..., :6], cells)
        return own + self._mean.nodal(on_gradient[:, :, None], cells) + gamma.mT @ on_vectors


def of_cells(state: ConstitutiveState, cells: slice) -> ConstitutiveState:
    """The state of some cells of all bodies."""

    def own(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor[:, cells]

    return replace(
        state,
        viscous_modulus=own(state.viscous_modulus),
        memory=own(state.memory),
        hourglass_memory=own(state.hourglass_memory),
    )
