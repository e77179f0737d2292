"""Stable neo-Hookean rubber: psi(F) = mu/2 (|F|^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2, J = det F.

Finite where a cell turns inside out, and at rest the linear elasticity of (mu, lambda). After Smith,
De Goes and Kim, Stable Neo-Hookean Flesh Simulation (2018), without its logarithm.
"""

import torch
from numba import njit
from torch import Tensor

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH
from rafl.fem.simd import KERNEL


def rest_lame(mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Lame parameters of the linear elasticity this law starts with."""
    return mu, lam


@njit(**KERNEL)
def derivatives(w, mu, lam):
    """Energy density and its derivatives at the scratch's stretches; see `rafl.fem.kernel_layout`."""
    bulk = mu + lam
    for g in range(8):
        # In e = s - 1, so that nothing large cancels near rest.
        s0 = w[STRETCH * 8 + g]
        s1 = w[(STRETCH + 1) * 8 + g]
        s2 = w[(STRETCH + 2) * 8 + g]
        e0 = s0 - 1.0
        e1 = s1 - 1.0
        e2 = s2 - 1.0
        a0 = s1 * s2
        a1 = s2 * s0
        a2 = s0 * s1
        bend = e0 * e1 + e1 * e2 + e2 * e0 + e0 * e1 * e2
        growth = e0 + e1 + e2 + bend
        pressure = bulk * growth - mu
        square = 0.5 * (e0 * e0 + e1 * e1 + e2 * e2)
        w[ENERGY * 8 + g] = mu * (square - bend) + 0.5 * bulk * growth * growth
        w[FIRST * 8 + g] = mu * (e0 - e1 - e2 - e1 * e2) + bulk * growth * a0
        w[(FIRST + 1) * 8 + g] = mu * (e1 - e2 - e0 - e2 * e0) + bulk * growth * a1
        w[(FIRST + 2) * 8 + g] = mu * (e2 - e0 - e1 - e0 * e1) + bulk * growth * a2
        w[SECOND * 8 + g] = mu + bulk * a0 * a0
        w[(SECOND + 1) * 8 + g] = mu + bulk * a1 * a1
        w[(SECOND + 2) * 8 + g] = mu + bulk * a2 * a2
        w[(SECOND + 3) * 8 + g] = bulk * a0 * a1 + pressure * s2
        w[(SECOND + 4) * 8 + g] = bulk * a1 * a2 + pressure * s0
        w[(SECOND + 5) * 8 + g] = bulk * a2 * a0 + pressure * s1
        w[FLIP * 8 + g] = mu - pressure * s2
        w[(FLIP + 1) * 8 + g] = mu - pressure * s0
        w[(FLIP + 2) * 8 + g] = mu - pressure * s1


def plain_derivatives(s: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same in plain words: energy (...), first (..., 3), second (..., 3, 3), flip (..., 3) at s (..., 3)."""
    mu, lam = mu[..., None], lam[..., None]
    next_, after = s.roll(-1, -1), s.roll(-2, -1)
    area = next_ * after  # d J / d s
    growth = s.prod(-1, keepdim=True) - 1.0
    pressure = (mu + lam) * growth - mu
    energy = 0.5 * mu * ((s**2).sum(-1, keepdim=True) - 3.0) - mu * growth + 0.5 * (mu + lam) * growth**2
    identity = torch.eye(3, dtype=s.dtype, device=s.device)
    # d^2 J / ds_i ds_j is the third stretch.
    zero = torch.zeros_like(s[..., 0])
    third = torch.stack(
        [zero, s[..., 2], s[..., 1], s[..., 2], zero, s[..., 0], s[..., 1], s[..., 0], zero], dim=-1
    ).reshape(*s.shape, 3)
    second = (
        mu[..., None] * identity
        + (mu + lam)[..., None] * area[..., :, None] * area[..., None, :]
        + pressure[..., None] * third
    )
    return energy[..., 0], mu * s + pressure * area, second, mu - pressure * after
