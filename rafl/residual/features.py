"""The 34 local features of the residual acceleration field (paper, table of input features)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rafl.fem.mesh import HexMesh
from rafl.fem.tensors.svd import signed_svd

FEATURES = 34


class _PolarDecomposition(torch.autograd.Function):
    """Rotation R (P, 3, 3) and ascending signed stretches (P, 3) of F (P, 3, 3).

    The derivatives dR = U [(M - M^T)_ij / (s_i + s_j)] V^T and ds_i = M_ii, with M = U^T dF V, contain no difference of
    stretches. So they are finite at repeated stretches and at exact rest.
    """

    @staticmethod
    def forward(ctx: Any, F: Tensor) -> tuple[Tensor, Tensor]:
        U, s, V = signed_svd(F)
        ctx.save_for_backward(U, s, V)
        return U @ V.mT, s.flip(-1)

    @staticmethod
    def backward(ctx: Any, by_R: Tensor, by_s: Tensor) -> Tensor:
        U, s, V = ctx.saved_tensors
        N = U.mT @ by_R @ V
        total = s[:, :, None] + s[:, None, :]
        total = torch.where(total.abs() < 1e-9, torch.full_like(total, 1e-9), total)
        K = (N - N.mT) / total + torch.diag_embed(by_s.flip(-1))
        by_F: Tensor = U @ K @ V.mT
        return by_F


polar_decomposition: Callable[[Tensor], tuple[Tensor, Tensor]] = _PolarDecomposition.apply


@dataclass(frozen=True)
class GaussPoints:
    """Mesh data for features and forces, as tensors.

    Attributes:
        hexes: (E, 8).
        shape: shape functions, (8 points, 8 nodes).
        gradient: shape function gradients [1/m], (E, 8 points, 8 nodes, 3).
        mass: true mass of each point, rho V_e [kg], (E, 8).
    """

    hexes: Tensor
    shape: Tensor
    gradient: Tensor
    mass: Tensor

    @classmethod
    def of(cls, mesh: HexMesh, density: float, device: str = "cpu") -> "GaussPoints":
        """Gauss points of a mesh with a density [kg/m^3], on a torch device."""
        rule = mesh.quadrature
        arrays = (mesh.hexes, rule.shape, rule.gradient, density * rule.volume)
        return cls(*(torch.from_numpy(array).to(device) for array in arrays))

    def accumulate(self, acceleration: Tensor, nodes: int) -> Tensor:
        """Nodal forces [N], (B, N, 3), from accelerations [m/s^2], (B, E, 8, 3) (paper, accumulation eq.)."""
        share = torch.einsum("gn,begi->beni", self.shape, acceleration * self.mass[..., None])
        force = share.new_zeros(len(share), nodes, 3)
        return force.index_add(1, self.hexes.reshape(-1), share.reshape(len(share), -1, 3))


def features(q: Tensor, v: Tensor, points: GaussPoints, gravity: Tensor) -> tuple[Tensor, Tensor]:
    """The 34 features and the rotation at every Gauss point.

    Args:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        points: Gauss points of the mesh.
        gravity: acceleration by external body forces [m/s^2], (3).

    Returns:
        Features (B, E, 8, 34), in order: principal stretches - 1 (ascending), flat(F^T F - I),
        det F - 1, diag D, tr D, flat(dev D), sqrt(|dev D|^2 / 2), axial W, |2 axial W|, R^T g, where
        D and W are the co-rotated symmetric and skew velocity gradients; and rotations R (B, E, 8, 3, 3).
    """
    batch, cells = len(q), len(points.hexes)
    at_nodes = torch.stack([q, v])[:, :, points.hexes]  # (2, B, E, 8, 3)
    F, rate = torch.einsum("sbeni,egnj->sbegij", at_nodes, points.gradient).reshape(2, -1, 3, 3)
    R, stretch = polar_decomposition(F)
    local = R.mT @ F  # right stretch tensor S; co-rotated L = R^T (rate F^-1) R = R^T rate S^-1
    a, b, c = local.unbind(-1)
    cofactor = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-2)
    determinant = (a * cofactor[:, 0]).sum(-1, keepdim=True)
    L = R.mT @ rate @ (cofactor / determinant[..., None])
    D = 0.5 * (L + L.mT)
    W = 0.5 * (L - L.mT)
    identity = torch.eye(3, dtype=q.dtype, device=q.device)
    diagonal = D.diagonal(dim1=-2, dim2=-1)
    trace = diagonal.sum(-1, keepdim=True)
    shear = D - trace[..., None] / 3.0 * identity
    axial = torch.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], dim=-1)
    # The derivative of a square root is infinite at zero. Small constants keep both derivatives finite at exact rest.
    shear_size = torch.sqrt(0.5 * (shear**2).sum((-2, -1)) + 1e-20)[:, None]
    spin_size = torch.sqrt(4.0 * (axial**2).sum(-1) + 1e-30)[:, None]
    parts = [
        stretch - 1.0,
        (F.mT @ F - identity).flatten(-2),
        determinant - 1.0,
        diagonal,
        trace,
        shear.flatten(-2),
        shear_size,
        axial,
        spin_size,
        (R.mT @ gravity[:, None])[..., 0],
    ]
    shape = (batch, cells, 8)
    return torch.cat(parts, dim=-1).reshape(*shape, FEATURES), R.reshape(*shape, 3, 3)


def mirror_signs(sign: Tensor) -> Tensor:
    """Signs (34) of the features under a reflection that gives the vector components the signs `sign` (3)."""
    one, even = sign.new_ones(1), sign.new_ones(3)
    tensor = torch.outer(sign, sign).flatten()
    axial = sign.prod() * sign
    return torch.cat([even, tensor, one, even, one, tensor, one, axial, one, sign])
