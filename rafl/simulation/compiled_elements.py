"""Compiled element kernels of one mesh, behind one interface for all integration schemes."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rafl.fem.constitutive_state import ConstitutiveState, HourglassStiffness
from rafl.fem.elements import element_terms
from rafl.fem.enhanced.hourglass import MODES, HourglassModes
from rafl.fem.enhanced.strains import enhanced_strains, enhanced_strains_adjoint
from rafl.fem.enhanced.terms import enhanced_terms
from rafl.fem.laws import LAWS
from rafl.fem.mesh import HexMesh
from rafl.fem.quadrature import QuadratureRule
from rafl.fem.simd import SIMD_LANES
from rafl.fem.strain import green_strain, green_strain_adjoint

Array = NDArray[Any]


class CompiledElements(Protocol):
    """Energy, gradient, tangent and strains of the cells of one mesh."""

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool
    ) -> tuple[Array, Array, Array]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, tangents [N/m] (B, E, 6, 8, 8)."""

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """As of `rafl.simulation.engine.Engine.strains`."""

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """As of `rafl.simulation.engine.Engine.strains_adjoint`."""


class PointElements:
    """Cells with eight or more integration points: `full` and `selective` integration."""

    def __init__(self, mesh: HexMesh, law: str, rule: QuadratureRule) -> None:
        self.mesh, self.rule = mesh, rule
        self.law = law
        cells, groups = len(mesh.hexes), len(rule.group_shares)
        gradient = rule.points.gradient.reshape(cells, groups, 8, 8, 3)  # (.., point, node, component)
        self._gradients_by_point = np.ascontiguousarray(gradient.transpose(0, 1, 3, 4, 2)).reshape(cells, groups, 192)
        self._gradients_by_node = np.ascontiguousarray(gradient.transpose(0, 1, 2, 4, 3)).reshape(cells, groups, 192)
        self._volume = rule.points.volume.reshape(cells, groups, 8)

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool
    ) -> tuple[Array, Array, Array]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, tangents [N/m] (B, E, 6, 8, 8)."""
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
            self.rule.group_shares,
            LAWS[self.law].kernel.address,
            state.moduli,
            state.energy_weights is not None,
            unused[0, 0] if state.energy_weights is None else state.energy_weights,
            state.memory is not None,
            unused[0] if state.viscous_modulus is None else state.viscous_modulus,
            unused if state.memory is None else state.memory,
            state.velocity_offset is not None,
            unused[0] if state.velocity_offset is None else state.velocity_offset,
            state.velocity_factor,
            project,
            tangent,
            energy,
            gradient,
            stiffness,
        )
        return energy, gradient, stiffness

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """Green strains, and their change along a direction."""
        shape = (len(q), len(self.mesh.hexes), -1)
        strain, change = green_strain(self.mesh, self.rule.points, q, direction)
        return strain.reshape(shape), change.reshape(shape)

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """Derivative of the weighted sum of the strains."""
        shape = (len(q), len(self.mesh.hexes), -1, 6)
        return green_strain_adjoint(self.mesh, self.rule.points, q, by_strain.reshape(shape))


class EnhancedElements:
    """Cells with one integration point and stabilised hourglass modes: `enhanced` integration."""

    def __init__(self, modes: HourglassModes, law: str) -> None:
        self.modes = modes
        self.mesh = mesh = modes.mesh
        self.law = law
        count = len(mesh.hexes)
        groups = -(-count // SIMD_LANES)
        lanes = np.arange(groups * SIMD_LANES)
        self._cells = np.minimum(lanes, count - 1).reshape(groups, SIMD_LANES)
        self._volume = np.where(lanes < count, mesh.volumes[np.minimum(lanes, count - 1)], 0.0).reshape(groups, -1)
        mean = mesh.mean_quadrature.gradient[:, 0].transpose(0, 2, 1)
        columns = np.concatenate([mean, self.modes.gamma], axis=1)[self._cells]  # (G, lanes, 7, 8)
        self._columns = np.ascontiguousarray(columns.transpose(0, 2, 3, 1)).reshape(groups, -1)
        self._latest: tuple[HourglassStiffness, Array] | None = None

    def _lanes(self, hourglass: HourglassStiffness) -> Array:
        """Stiffness of the hourglass modes by lane, (B, G or 1, 3, 144 * lanes)."""
        if self._latest is None or self._latest[0] is not hourglass:
            parts = np.stack([hourglass.elastic, hourglass.viscous, hourglass.damping], axis=2)
            batch, shapes = parts.shape[:2]
            flat = parts.reshape(batch, shapes, 3, MODES * MODES)
            if shapes == 1:
                lanes = np.repeat(flat[..., None], SIMD_LANES, axis=-1)
            else:
                lanes = np.moveaxis(flat[:, self.modes.shape_index[self._cells]], 2, -1)
            self._latest = hourglass, np.ascontiguousarray(lanes).reshape(batch, lanes.shape[1], 3, -1)
        return self._latest[1]

    def evaluate(
        self, q: Array, state: ConstitutiveState, *, tangent: bool, project: bool
    ) -> tuple[Array, Array, Array]:
        """Energy [J] (B), nodal gradient [N] (B, N, 3) and, if `tangent`, tangents [N/m] (B, E, 6, 8, 8)."""
        assert state.hourglass is not None
        batch = len(q)
        energy, gradient = np.empty(batch), np.empty_like(q)
        stiffness = np.empty((batch if tangent else 0, len(self.mesh.hexes), 6, 8, 8))
        unused = np.zeros((1, 1, 1, 1))
        hourglass = self._lanes(state.hourglass)
        enhanced_terms(
            q,
            self._cells,
            self.mesh.hexes,
            self._columns,
            self._volume,
            LAWS[self.law].kernel.address,
            state.moduli,
            hourglass,
            hourglass.shape[1] == 1,
            state.energy_weights is not None,
            unused[0, 0] if state.energy_weights is None else state.energy_weights,
            state.memory is not None,
            unused[0] if state.viscous_modulus is None else state.viscous_modulus,
            unused if state.memory is None else state.memory,
            unused[0] if state.hourglass_memory is None else state.hourglass_memory,
            state.velocity_offset is not None,
            unused[0] if state.velocity_offset is None else state.velocity_offset,
            state.velocity_factor,
            project,
            tangent,
            energy,
            gradient,
            stiffness,
        )
        return energy, gradient, stiffness

    def strains(self, q: Array, direction: Array) -> tuple[Array, Array]:
        """Green strains, then hourglass vectors, and their change along a direction."""
        out = [np.empty((len(q), len(self.mesh.hexes), size)) for size in (6, MODES, 6, MODES)]
        enhanced_strains(q, direction, self._cells, self.mesh.hexes, self._columns, self._volume, *out)
        return np.concatenate(out[:2], axis=-1), np.concatenate(out[2:], axis=-1)

    def strains_adjoint(self, q: Array, by_strain: Array) -> Array:
        """Derivative of the weighted sum of the strains."""
        out = np.empty_like(q)
        parts = np.ascontiguousarray(by_strain[..., :6]), np.ascontiguousarray(by_strain[..., 6:])
        enhanced_strains_adjoint(q, *parts, self._cells, self.mesh.hexes, self._columns, self._volume, out)
        return out
