"""Energy, forces and tangent of the hourglass modes; see `rafl.fem.enhanced.hourglass`.

A motion changes the mean deformation gradient by dF and the hourglass vectors by dGamma_k. In the frame of the cell,
f_j = R^T dF e_j and g_k = R^T dGamma_k. The frame turns by omega = sum_j L_j f_j, with L_j = G^-1 [e_j],
G = tr(S) I - S, and [a] the matrix of the cross product with a. So Y_k = R^T Gamma_k changes by [Y_k] omega + g_k.

Shapes: B bodies, E cells. Rows and columns of the frame's motion are f_j, then g_k, 21 in all.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rafl.fem.tensors.constants import numbers
from rafl.fem.tensors.stress import Point

MIN_ROTATION_STIFFNESS = 1e-8  # of G, relative to no stretch: bounds the rotation of a flattened cell
CROSS = (0.0, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 1, 0, 0, 0, -1, 0, 0, 0, -1, 0, 1, 0, 0, 0, 0, 0)


def _axes(like: Tensor) -> Tensor:
    """Matrices of the cross products with the three axes, (3, 3, 3)."""
    return numbers(CROSS, like.device).reshape(3, 3, 3)


def _cross(v: Tensor) -> Tensor:
    """Matrices of the cross products with v (..., 3), (..., 3, 3)."""
    return (v @ _axes(v).reshape(3, 9)).reshape(*v.shape, 3)


@dataclass(frozen=True)
class HourglassFrame:
    """The frame of the hourglass modes of every cell.

    Attributes:
        rotation: R, (B, E, 3, 3).
        stretch: S, (B, E, 3, 3).
        inverse: G^-1, (B, E, 3, 3).
        turn: L_0, L_1, L_2 side by side, (B, E, 3, 9).
        local: Y, (B, E, 12).
        sweep: [Y_0] to [Y_3] below each other, (B, E, 12, 3).
    """

    rotation: Tensor
    stretch: Tensor
    inverse: Tensor
    turn: Tensor
    local: Tensor
    sweep: Tensor

    @classmethod
    def of(cls, point: Point, vectors: Tensor) -> "HourglassFrame":
        """The frame for hourglass vectors Gamma (B, E, 4, 3) [m]; `point`: the mean deformation gradients."""
        U, s, V = (x[:, :, 0] for x in (point.U, point.s, point.V))
        rotation = U @ V.mT
        pairs = s.roll(-1, -1) + s.roll(-2, -1)
        least = torch.full_like(pairs, MIN_ROTATION_STIFFNESS).copysign(pairs)
        pairs = torch.where(pairs.abs() > MIN_ROTATION_STIFFNESS, pairs, least)
        inverse = (V / pairs[..., None, :]) @ V.mT
        axes = _axes(inverse).transpose(0, 1).reshape(3, 9)
        local = vectors @ rotation
        sweep = _cross(local).flatten(-3, -2)
        return cls(rotation, (V * s[..., None, :]) @ V.mT, inverse, inverse @ axes, local.flatten(-2), sweep)

    def change(self, gradient: Tensor, vectors: Tensor) -> Tensor:
        """Change of Y (B, E, 12) by changes of F (B, E, 3, 3) and of Gamma (B, E, 4, 3)."""
        columns = (gradient.mT @ self.rotation).flatten(-2)  # f_j, one after the other
        omega = self.turn @ columns[..., None]
        return (self.sweep @ omega)[..., 0] + (vectors @ self.rotation).flatten(-2)

    def moment(self, force: Tensor) -> Tensor:
        """n = G^-1 sum_k Y_k x T_k of forces T (B, E, 12) dual to Y, (B, E, 3)."""
        torque = self.sweep.mT @ force[..., None]  # the transpose of [Y_k] is minus itself
        return -(self.inverse @ torque)[..., 0]

    def forces(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Forces (B, E, 3, 3) dual to F and (B, E, 4, 3) dual to Gamma, of forces T (B, E, 12) dual to Y."""
        on_vectors = force.reshape(*force.shape[:-1], 4, 3) @ self.rotation.mT
        # Column j of the force on F is R (e_j x n), which is minus R times column j of [n].
        return -self.rotation @ _cross(self.moment(force)), on_vectors

    def tangent(self, stiffness: Tensor, force: Tensor, project: bool) -> Tensor:
        """Tangent (B, E, 21, 21), with the rows and columns of every vector in the frame of space.

        stiffness (B, E, 12, 12) is the derivative of T by Y, and force (B, E, 12) is T.
        """
        driven = stiffness @ self.sweep
        curvature = self.sweep.mT @ driven
        if not project:
            pull = _cross(force.reshape(*force.shape[:-1], 4, 3)).flatten(-3, -2)
            moment = self.moment(force)
            driven = driven - pull
            curvature = driven.mT @ self.sweep - _cross((self.stretch @ moment[..., None])[..., 0])
        corner = curvature @ self.turn
        if not project:
            identity = torch.eye(3, dtype=force.dtype, device=force.device)
            trace = moment[..., :, None] * identity.flatten()
            columns = (moment[..., None, :, None] * identity[:, None, :]).flatten(-2)
            corner = corner + trace - columns
        corner = self.turn.mT @ corner
        if not project:
            turned = (_axes(force) @ moment[..., None, :, None])[..., 0]  # e_j x n, (B, E, 3, 3)
            corner = corner - (_cross(turned) @ self.turn[..., None, :, :]).flatten(-3, -2)
        across = driven @ self.turn
        whole = torch.cat([torch.cat([corner, across.mT], -1), torch.cat([across, stiffness], -1)], -2)
        by_vector = whole.reshape(*whole.shape[:2], 7, 3, 21)
        turned_rows = (self.rotation[:, :, None] @ by_vector).reshape(*whole.shape[:2], 21, 7, 3)
        return (turned_rows @ self.rotation.mT[:, :, None]).flatten(-2)


def modes_energy(
    local: Tensor, elastic: Tensor, viscous: Tensor, modulus: Tensor | None, memory: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Energy [J] (B, E), force T (B, E, 12) and stiffness dT/dY (B, E, 12, 12) at local vectors Y (B, E, 12).

    elastic, viscous: (B, E, 12, 12); modulus (B, E, 1) [Pa] and memory (B, E, 12) of the viscous stress, or None.
    """
    force = (elastic @ local[..., None])[..., 0]
    energy = 0.5 * (local * force).sum(-1)
    if memory is None or modulus is None:
        return energy, force, elastic
    strain = modulus * local - memory
    dual = (viscous @ strain[..., None])[..., 0]
    energy = energy + 0.5 * (strain * dual).sum(-1) / modulus[..., 0].clamp_min(1e-300)
    return energy, force + dual, elastic + modulus[..., None] * viscous
