"""Stable neo-Hookean rubber: psi(F) = mu/2 (|F|^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2, J = det F.

The energy stays finite for inverted cells; at rest the law is linear elasticity with mu and lambda. Source:
Smith, De Goes and Kim, Stable Neo-Hookean Flesh Simulation (2018), without the logarithmic term.
"""

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
    bulk = mu + lam
    for g in range(8):
        # In terms of e = s - 1, to avoid cancellation near rest.
        s0 = w[STRETCH * 8 + g]
        s1 = w[(STRETCH + 1) * 8 + g]
        s2 = w[(STRETCH + 2) * 8 + g]
        e0 = s0 - 1.0
        e1 = s1 - 1.0
        e2 = s2 - 1.0
        a0 = s1 * s2
        a1 = s2 * s0
        a2 = s0 * s1
        higher_order = e0 * e1 + e1 * e2 + e2 * e0 + e0 * e1 * e2
        volume_change = e0 + e1 + e2 + higher_order
        pressure = bulk * volume_change - mu
        square = 0.5 * (e0 * e0 + e1 * e1 + e2 * e2)
        w[ENERGY * 8 + g] = mu * (square - higher_order) + 0.5 * bulk * volume_change * volume_change
        w[FIRST * 8 + g] = mu * (e0 - e1 - e2 - e1 * e2) + bulk * volume_change * a0
        w[(FIRST + 1) * 8 + g] = mu * (e1 - e2 - e0 - e2 * e0) + bulk * volume_change * a1
        w[(FIRST + 2) * 8 + g] = mu * (e2 - e0 - e1 - e0 * e1) + bulk * volume_change * a2
        w[SECOND * 8 + g] = mu + bulk * a0 * a0
        w[(SECOND + 1) * 8 + g] = mu + bulk * a1 * a1
        w[(SECOND + 2) * 8 + g] = mu + bulk * a2 * a2
        w[(SECOND + 3) * 8 + g] = bulk * a0 * a1 + pressure * s2
        w[(SECOND + 4) * 8 + g] = bulk * a1 * a2 + pressure * s0
        w[(SECOND + 5) * 8 + g] = bulk * a2 * a0 + pressure * s1
        w[FLIP * 8 + g] = mu - pressure * s2
        w[(FLIP + 1) * 8 + g] = mu - pressure * s0
        w[(FLIP + 2) * 8 + g] = mu - pressure * s1


def reference_derivatives(s: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    mu, lam = mu[..., None], lam[..., None]
    next_, after = s.roll(-1, -1), s.roll(-2, -1)
    area = next_ * after  # d J / d s
    volume_change = s.prod(-1, keepdim=True) - 1.0
    pressure = (mu + lam) * volume_change - mu
    energy = 0.5 * mu * ((s**2).sum(-1, keepdim=True) - 3.0) - mu * volume_change + 0.5 * (mu + lam) * volume_change**2
    identity = torch.eye(3, dtype=s.dtype, device=s.device)
    # d^2 J / ds_i ds_j (i != j) is the remaining stretch.
    zero = torch.zeros_like(s[..., 0])
    jacobian_hessian = torch.stack(
        [zero, s[..., 2], s[..., 1], s[..., 2], zero, s[..., 0], s[..., 1], s[..., 0], zero], dim=-1
    ).reshape(*s.shape, 3)
    second = (
        mu[..., None] * identity
        + (mu + lam)[..., None] * area[..., :, None] * area[..., None, :]
        + pressure[..., None] * jacobian_hessian
    )
    return energy[..., 0], mu * s + pressure * area, second, mu - pressure * after
