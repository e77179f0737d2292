"""Energy, stress and tangent at integration points: elastic law, learned energy, viscosity and stiffness damping.

Shapes: B bodies, E cells, P points of a cell. P = dpsi/dF is the first Piola-Kirchhoff stress; tangents dP/dF have rows
and columns 3 i + j for component F_ij, (B, E, P, 9, 9).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rafl.fem.constitutive_state import DAMPING, ConstitutiveState
from rafl.fem.laws import LAWS
from rafl.fem.learned.energy import reference_learned_energy
from rafl.fem.tensors.constants import indices
from rafl.fem.tensors.svd import signed_svd

STRETCH_PAIRS = ((0, 1), (1, 2), (2, 0))  # order of the pair stiffnesses of `rafl.fem.laws`
COMPONENTS = (0, 4, 8, 1, 5, 2)  # of symmetric tensors 00 11 22 01 12 02, as indices 3 i + j
EXPANSION = (0, 3, 5, 3, 1, 4, 5, 4, 2)  # for each index 3 i + j, the component
MIN_STRETCH_SUM = 1e-8  # of two stretches; bounds the stiffness against the rotation of an inverted cell


@dataclass(frozen=True)
class Point:
    """Deformation gradients F = U diag(s) V^T, (B, E, P, 3, 3), and their decompositions."""

    F: Tensor
    U: Tensor
    s: Tensor
    V: Tensor

    @classmethod
    def of(cls, F: Tensor) -> "Point":
        """Decompose deformation gradients."""
        return cls(F, *signed_svd(F))

    @property
    def rotation(self) -> Tensor:
        """Polar rotations R, (B, E, P, 3, 3)."""
        return self.U @ self.V.mT


@dataclass(frozen=True)
class Terms:
    """Energy density [Pa] (B, E, P), stress P [Pa] (B, E, P, 3, 3) and, if asked for, tangent dP/dF [Pa]."""

    energy: Tensor
    stress: Tensor
    tangent: Tensor | None

    def __add__(self, other: "Terms") -> "Terms":
        tangent = None
        if self.tangent is not None and other.tangent is not None:
            tangent = self.tangent + other.tangent
        return Terms(self.energy + other.energy, self.stress + other.stress, tangent)


def symmetric(values: Tensor) -> Tensor:
    """Tensors (..., 3, 3) from their components 00 11 22 01 12 02 (..., 6)."""
    expanded = values.index_select(-1, indices(EXPANSION, values.device))
    return expanded.reshape(*values.shape[:-1], 3, 3)


def components(tensor: Tensor) -> Tensor:
    """Components 00 11 22 01 12 02 (..., 6) of symmetric tensors (..., 3, 3)."""
    return tensor.flatten(-2).index_select(-1, indices(COMPONENTS, tensor.device))


def elastic(law: str, point: Point, shares: Tensor, state: ConstitutiveState, tangent: bool, project: bool) -> Terms:
    """Terms of the elastic law and of the learned energy.

    shares: fractions of mu and of lambda that each point integrates, (P, 2).
    """
    s = point.s
    mu, lam = (state.moduli[:, k, None, None] * shares[:, k] for k in (0, 1))  # (B, 1, P)
    parts = LAWS[law].reference_derivatives(s, mu.expand(s.shape[:-1]), lam.expand(s.shape[:-1]))
    energy, first, second, flip = parts
    if state.energy_weights is not None:
        learned = reference_learned_energy(s, state.energy_weights, shares[:, 0])
        energy, first, second, flip = (a + b for a, b in zip(parts, learned, strict=True))
    stress = (point.U * first[..., None, :]) @ point.V.mT
    return Terms(energy, stress, _tangent(point, first, second, flip, project) if tangent else None)


def _local_entries() -> tuple[int, ...]:
    """For every entry of the tangent in the frame of the singular vectors, (81), where `_tangent` finds its value."""
    entries = [15] * 81  # zero
    for a in range(3):
        for c in range(3):
            entries[9 * (4 * a) + 4 * c] = 3 * a + c
    for k, (a, b) in enumerate(STRETCH_PAIRS):
        one, other = 3 * a + b, 3 * b + a
        entries[9 * one + one] = entries[9 * other + other] = 9 + k
        entries[9 * one + other] = entries[9 * other + one] = 12 + k
    return tuple(entries)


LOCAL_ENTRIES = _local_entries()


def _tangent(point: Point, first: Tensor, second: Tensor, flip: Tensor, project: bool) -> Tensor:
    """dP/dF of an isotropic law, computed in the frame of the singular vectors."""
    if project:
        values, vectors = torch.linalg.eigh(second)
        second = (vectors * values.clamp_min(0.0)[..., None, :]) @ vectors.mT
    total = point.s + point.s.roll(-1, -1)  # of each of STRETCH_PAIRS
    total = torch.where(total.abs() > MIN_STRETCH_SUM, total, torch.full_like(total, MIN_STRETCH_SUM).copysign(total))
    twist = (first + first.roll(-1, -1)) / total
    if project:
        twist, flip = twist.clamp_min(0.0), flip.clamp_min(0.0)
    values = torch.cat([second.flatten(-2), 0.5 * (flip + twist), 0.5 * (flip - twist), torch.zeros_like(flip)], dim=-1)
    local = values.index_select(-1, indices(LOCAL_ENTRIES, values.device)).reshape(*values.shape[:-1], 9, 9)
    frame = (point.U[..., :, None, :, None] * point.V[..., None, :, None, :]).flatten(-2).flatten(-3, -2)
    return frame @ local @ frame.mT


def viscous(point: Point, shares: Tensor, modulus: Tensor, memory: Tensor, tangent: bool, project: bool) -> Terms:
    """Terms of the stress P = F 2 (g E - memory); modulus g (B, E, P), memory (B, E, P, 6) [Pa].

    shares: fraction that each point integrates, (P).
    """
    F = point.F
    identity = torch.eye(3, dtype=F.dtype, device=F.device)
    g, share = modulus[..., None, None], shares[:, None, None]
    half = share * (g * 0.5 * (F.mT @ F - identity) - symmetric(memory))
    S = 2.0 * half
    energy = (half.square() / g.clamp_min(1e-300)).sum((-2, -1))
    if not tangent:
        return Terms(energy, F @ S, None)
    weighted = share * g * F
    H = weighted[..., :, None, None, :] * F.mT[..., None, :, :, None]  # F_im F_kj
    H = H + torch.einsum("...ik,jm->...ijkm", weighted @ F.mT, identity)
    if not project:
        H = H + torch.einsum("ik,...jm->...ijkm", identity, S)
    return Terms(energy, F @ S, H.flatten(-2).flatten(-3, -2))


def damping(velocity_gradient: Tensor, shares: Tensor, moduli: Tensor, velocity_factor: float, tangent: bool) -> Terms:
    """Terms of stiffness damping: rest moduli times the velocity gradient (B, E, P, 3, 3) [1/s]."""
    L = velocity_gradient
    weighted = moduli[:, list(DAMPING), None] * shares.T  # (B, 2, P)
    mu, lam = (x[:, None, :, None, None] for x in weighted.unbind(1))
    identity = torch.eye(3, dtype=L.dtype, device=L.device)
    D, trace = 0.5 * (L + L.mT), L.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    stress = 2.0 * mu * D + lam * trace * identity
    energy = (mu / velocity_factor * D.square()).sum((-2, -1))
    energy = energy + (0.5 * lam / velocity_factor * trace.square())[..., 0, 0]
    if not tangent:
        return Terms(energy, stress, None)
    same, swapped = torch.einsum("ik,jm->ijkm", identity, identity), torch.einsum("im,jk->ijkm", identity, identity)
    volume = torch.einsum("ij,km->ijkm", identity, identity)
    H = velocity_factor * (mu * (same + swapped).reshape(9, 9) + lam * volume.reshape(9, 9))
    return Terms(energy, stress, H.expand(*L.shape[:-2], 9, 9))
