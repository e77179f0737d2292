"""Linear corotated elasticity: psi(F) = mu |F - R|^2 + (lambda / 2) tr^2(R^T F - I), with polar rotation R."""

import torch
from numba import njit
from torch import Tensor

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH
from rafl.fem.simd import KERNEL_OPTIONS


def rest_lame(mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Lame parameters of the law's linearisation at rest."""
    return mu, lam


@njit(**KERNEL_OPTIONS)
def derivatives(w, mu, lam):
    """Fill ENERGY, FIRST, SECOND and FLIP from the stretches; see `rafl.fem.kernel_layout`."""
    for g in range(8):
        e0 = w[STRETCH * 8 + g] - 1.0
        e1 = w[(STRETCH + 1) * 8 + g] - 1.0
        e2 = w[(STRETCH + 2) * 8 + g] - 1.0
        trace = e0 + e1 + e2
        w[ENERGY * 8 + g] = mu * (e0 * e0 + e1 * e1 + e2 * e2) + 0.5 * lam * trace * trace
        w[FIRST * 8 + g] = 2.0 * mu * e0 + lam * trace
        w[(FIRST + 1) * 8 + g] = 2.0 * mu * e1 + lam * trace
        w[(FIRST + 2) * 8 + g] = 2.0 * mu * e2 + lam * trace
    for i in range(3):
        for g in range(8):
            w[(SECOND + i) * 8 + g] = 2.0 * mu + lam
            w[(SECOND + 3 + i) * 8 + g] = lam
            w[(FLIP + i) * 8 + g] = 2.0 * mu


def reference_derivatives(s: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    mu, lam = mu[..., None], lam[..., None]
    trace = (s - 1.0).sum(-1, keepdim=True)
    energy = (mu * (s - 1.0) ** 2).sum(-1) + (0.5 * lam * trace**2)[..., 0]
    identity = torch.eye(3, dtype=s.dtype, device=s.device)
    second = 2.0 * mu[..., None] * identity + lam[..., None] * torch.ones_like(identity)
    return energy, 2.0 * mu * (s - 1.0) + lam * trace, second.expand(*s.shape, 3), (2.0 * mu).expand(s.shape)
