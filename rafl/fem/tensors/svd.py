"""Singular value decompositions of 3 x 3 tensors into two rotations and signed singular values."""

import torch
from torch import Tensor

PAIRS = ((0, 1), (0, 2), (1, 2))
MIN_SWEEPS, MAX_SWEEPS = 3, 30  # over all pairs; few matrices need fewer, and few need five
SMALLEST = 1e-300  # gives the angle 0 to a sum of zero
ORTHOGONAL = 1e-30  # square of the cosine between two columns that counts as rounding
# Relative size of the second stretch, and cosine between its column and the first, beyond which it is rounding only.
MIN_RELATIVE_STRETCH, MAX_COSINE = 1e-100, 1e-8


def signed_svd(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """F = U diag(s) V^T with rotations U, V (..., 3, 3); s (..., 3) descends, and its last has the sign of det F.

    One-sided Jacobi on all matrices together, as in `rafl.fem.svd`. The batched decompositions of libraries are made
    for larger matrices, and are slower for many small ones.
    """
    columns = _orthogonal_columns(F.reshape(-1, 9).T.reshape(3, 3, -1))  # (3 columns, 6, N)
    size = columns[:, :3].square().sum(1)
    order = size.argsort(dim=0, descending=True)
    columns = columns.gather(0, order[:, None].expand_as(columns))
    (b0, b1, b2), (v0, v1, v2) = columns[:, :3], columns[:, 3:]
    s0, s1 = size.gather(0, order[:2]).sqrt()
    third = torch.linalg.cross(v0, v1, dim=0)
    b2 = b2 * (third * v2).sum(0).sign()
    u0, u1 = b0 / s0, b1 / s1
    along = (u0 * b1).sum(0)
    found = (s1 > MIN_RELATIVE_STRETCH * s0) & (along.abs() < MAX_COSINE * s1)
    u1 = torch.where(found, u1, _any_normal(u0))
    u2 = torch.linalg.cross(u0, u1, dim=0)
    U, V = (
        torch.stack(parts, dim=1).reshape(9, -1).T.contiguous().reshape(F.shape)
        for parts in ((u0, u1, u2), (v0, v1, third))
    )
    return U, torch.stack([s0, s1, (u2 * b2).sum(0)], dim=-1).reshape(F.shape[:-1]), V


def _orthogonal_columns(F: Tensor) -> Tensor:
    """Columns of F V, which are orthogonal to each other, above those of a rotation V, (3 columns, 6, N); F (3, 3, N).

    Two columns x, y are turned together as z = x + i y. They are orthogonal where the sum of z^2 is real, so z is
    turned by half the angle to the nearest real number.
    """
    identity = torch.eye(3, dtype=F.dtype, device=F.device)[..., None].expand_as(F)
    columns = list(torch.cat([F, identity]).unbind(1))
    for sweep in range(MAX_SWEEPS):
        for p, r in PAIRS:
            z = torch.complex(columns[p], columns[r])
            whole = (z[:3].square().sum(0) + SMALLEST).sgn()
            half = (whole * torch.ones_like(whole.real).copysign(whole.real) + 1.0).sgn()
            z = z * half.conj()
            columns[p], columns[r] = z.real, z.imag
        turned = torch.stack(columns)
        if sweep + 1 >= MIN_SWEEPS:
            own, other = turned[:, :3], turned[:, :3].roll(-1, 0)
            square = own.square().sum(1)
            product = (own * other).sum(1).square() - ORTHOGONAL * square * square.roll(-1, 0)
            if not product.amax() > 0.0:
                break
    return turned


def _any_normal(u: Tensor) -> Tensor:
    """A unit vector normal to each unit vector u (3, N)."""
    axis = torch.zeros_like(u).scatter_(0, u.abs().argmin(dim=0, keepdim=True), 1.0)
    normal = axis - (axis * u).sum(0) * u
    unit: Tensor = normal / normal.norm(dim=0)
    return unit
