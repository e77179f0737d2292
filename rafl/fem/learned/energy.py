"""A learned isotropic strain energy: a small network of two invariants, added to the elastic law.

With the principal stretches s_i and d = s_0 s_1 s_2 - 1, the invariants are

    x = (sum s_i^4 - 3) / 4 - d + d^2 / 2,    y = sum_{i<j} s_i^2 s_j^2 - 3 - 4 d.

Neither is ever negative, and both vanish only where the cell is rigidly rotated; there they equal 2 sum (s_i - 1)^2 to
second order. Energies in tension and in compression differ between x and y, and the elastic law lies between them. The
energy density is

    psi = sum_k w_k phi_k,    softening unit  2 c (sqrt(1 + z / c) - 1),    stiffening unit  sqrt(z^2 + c^2) - c,

one unit of each kind for z = x and z = y at each scale c. With weights w_k >= 0 the energy is never negative, has
neither energy nor slope at rest, grows with the strain, and grows at most like a quartic. So no weights make a body
gain energy in a closed cycle.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.mesh import HexMesh, QuadraturePoints

Array = NDArray[Any]

# Where the units bend: x is about 3 strain^2 in tension, so at strains of 6, 18 and 58 %, from the smallest that
# recordings of soft beams resolve to those that break silicone in bending.
SCALES = (0.01, 0.1, 1.0)
KINDS = 2  # softening, stiffening
MIN_LAW_SHARE = 0.25  # of mu at rest, below which softening units are scaled down
UNITS = 2 * len(SCALES) * KINDS  # of x at every scale, both kinds; then of y


def _energy_of(s: Tensor, weights: Tensor) -> Tensor:
    """Energy density (..) at stretches s (.., 3) for weights (.., UNITS), as the module defines it."""
    square = s**2
    d = s.prod(-1) - 1.0
    x = 0.25 * ((square**2).sum(-1) - 3.0) - d + 0.5 * d**2
    y = (square * square.roll(1, -1)).sum(-1) - 3.0 - 4.0 * d
    units = []
    for z in (x, y):
        for c in SCALES:
            units += [2.0 * c * ((1.0 + z / c).sqrt() - 1.0), (z**2 + c**2).sqrt() - c]
    return (weights * torch.stack(units, dim=-1)).sum(-1)


def reference_learned_energy(s: Tensor, weights: Tensor, shares: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Energy (..), first (.., 3) and second derivatives (.., 3, 3) and flips (.., 3) by automatic differentiation.

    s (B, E, P, 3); weights (B, UNITS) [Pa]; shares (P): the fraction of the energy that each point integrates.
    """
    own = (weights[:, None, None, :] * shares[:, None]).expand(*s.shape[:-1], -1)
    energy = _energy_of(s, own)
    with torch.enable_grad():
        at = s.detach().requires_grad_()
        (first,) = torch.autograd.grad(_energy_of(at, own).sum(), at, create_graph=True)
        rows = [torch.autograd.grad(first[..., i].sum(), at, retain_graph=True)[0] for i in range(3)]
    second = torch.stack(rows, dim=-2)
    flips = []
    for i in range(3):
        j = (i + 1) % 3
        gap = s[..., i] - s[..., j]
        near = gap.abs() < 1e-5  # where the difference quotient becomes the derivative along (1, -1)
        quotient = (first[..., i] - first[..., j]) / torch.where(near, torch.ones_like(gap), gap)
        limit = 0.5 * (second[..., i, i] + second[..., j, j]) - second[..., i, j]
        flips.append(torch.where(near, limit, quotient))
    return energy, first.detach(), second, torch.stack(flips, dim=-1).detach()


def _unit_slopes(z: Array) -> Array:
    """Slopes of the units at invariants z (..), (.., UNITS / 2)."""
    slopes = []
    for c in SCALES:
        slopes += [1.0 / np.sqrt(1.0 + z / c), z / np.sqrt(z**2 + c**2)]
    return np.stack(slopes, axis=-1)


def force_derivatives(mesh: HexMesh, points: QuadraturePoints, shares: Array, q: Array, direction: Array) -> Array:
    """Derivative of direction . internal force by every weight, (B, UNITS); q [m] and direction (B, N, 3).

    shares (P): the fraction of the energy that each point integrates.
    """
    F, change = (np.einsum("beni,epnj->bepij", x[:, mesh.hexes], points.gradient) for x in (q, direction))
    C = F.swapaxes(-1, -2) @ F
    trace = np.trace(C, axis1=-2, axis2=-1)
    cofactor = np.stack([np.cross(F[..., (i + 1) % 3, :], F[..., (i + 2) % 3, :]) for i in range(3)], axis=-2)
    d = (F[..., 0, :] * cofactor[..., 0, :]).sum(-1) - 1.0
    square = (C**2).sum((-2, -1))
    invariants = 0.25 * (square - 3.0) - d + 0.5 * d**2, 0.5 * (trace**2 - square) - 3.0 - 4.0 * d
    product = F @ C
    slopes = (
        product + (d - 1.0)[..., None, None] * cofactor,
        2.0 * (trace[..., None, None] * F - product) - 4.0 * cofactor,
    )
    volume = points.volume * shares
    parts = []
    for z, slope in zip(invariants, slopes, strict=True):
        along = volume * (slope * change).sum((-2, -1))
        parts.append(np.einsum("bep,bepk->bk", along, _unit_slopes(np.maximum(z, 0.0))))
    return np.concatenate(parts, axis=-1)


def shared_weights(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (.., UNITS) in proportion to half of mu at rest, and the fraction of mu that is left to the law (..).

    Softening units have a stiffness at rest, and mu is that of law and units together. So the law takes what they leave
    of it. If they would leave less than `MIN_LAW_SHARE`, they are scaled down, smoothly, so that some is left.
    """
    soft = torch.zeros_like(weights)
    soft[..., ::2] = 1.0
    wanted = (soft * weights).sum(-1)
    most = 1.0 - MIN_LAW_SHARE
    beyond = (wanted - most).clamp_min(0.0)
    law = torch.where(beyond > 0.0, MIN_LAW_SHARE * torch.exp(-beyond / MIN_LAW_SHARE), 1.0 - wanted)
    scale = torch.where(beyond > 0.0, (1.0 - law) / wanted.clamp_min(most), torch.ones_like(law))
    return weights * (1.0 + soft * (scale[..., None] - 1.0)), law
