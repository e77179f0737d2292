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
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH
from rafl.fem.mesh import HexMesh, QuadraturePoints
from rafl.fem.simd import KERNEL_OPTIONS

Array = NDArray[Any]

# Where the units bend: x is about 3 strain^2 in tension, so at strains of 6, 18 and 58 %. From the smallest strains that
# marker recordings of soft beams resolve to those that break silicone in bending.
SCALES = (0.01, 0.1, 1.0)
KINDS = 2  # softening, stiffening
UNITS = 2 * len(SCALES) * KINDS  # of x at every scale, both kinds; then of y


@njit(**KERNEL_OPTIONS)
def _unit_sums(z, weights, first, out):
    """Fill out with value, slope and second derivative by z of the units `first` and following."""
    out[0] = 0.0
    out[1] = 0.0
    out[2] = 0.0
    for k in range(len(SCALES)):
        c = SCALES[k]
        soft = weights[first + 2 * k]
        stiff = weights[first + 2 * k + 1]
        root = np.sqrt(1.0 + z / c)
        radius = np.sqrt(z * z + c * c)
        out[0] += soft * 2.0 * z / (root + 1.0) + stiff * z * z / (radius + c)
        out[1] += soft / root + stiff * z / radius
        out[2] += stiff * c * c / (radius * radius * radius) - soft * 0.5 / (c * root * root * root)


@njit(**KERNEL_OPTIONS)
def add_learned_energy(w, weights, share):
    """Add the energy of weights (UNITS) [Pa] times `share` to ENERGY, FIRST, SECOND and FLIP of the scratch."""
    e = np.empty(3)
    u = np.empty(3)
    area = np.empty(3)
    x_first = np.empty(3)
    y_first = np.empty(3)
    by_x = np.empty(3)
    by_y = np.empty(3)
    for g in range(8):
        for i in range(3):
            e[i] = w[(STRETCH + i) * 8 + g] - 1.0
            u[i] = e[i] * (2.0 + e[i])
        pairs = e[0] * e[1] + e[1] * e[2] + e[2] * e[0]
        triple = e[0] * e[1] * e[2]
        d = triple + pairs + e[0] + e[1] + e[2]
        squares = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        # Terms of first order in e cancel; they are left out.
        x = 0.25 * (u[0] * u[0] + u[1] * u[1] + u[2] * u[2]) + 0.5 * squares - pairs - triple + 0.5 * d * d
        y = 2.0 * squares + u[0] * u[1] + u[1] * u[2] + u[2] * u[0] - 4.0 * (pairs + triple)
        _unit_sums(max(x, 0.0), weights, 0, by_x)
        _unit_sums(max(y, 0.0), weights, len(SCALES) * KINDS, by_y)
        for i in range(3):
            a = (i + 1) % 3
            b = (i + 2) % 3
            change = e[a] + e[b] + e[a] * e[b]  # of s_a s_b
            area[i] = 1.0 + change
            x_first[i] = e[i] * (3.0 + e[i] * (3.0 + e[i])) - change + d * area[i]
            y_first[i] = 4.0 * e[i] + 2.0 * (1.0 + e[i]) * (u[a] + u[b]) - 4.0 * change
        w[ENERGY * 8 + g] += share * (by_x[0] + by_y[0])
        for i in range(3):
            j = (i + 1) % 3
            k = (i + 2) % 3
            s_i = 1.0 + e[i]
            s_j = 1.0 + e[j]
            s_k = 1.0 + e[k]
            w[(FIRST + i) * 8 + g] += share * (by_x[1] * x_first[i] + by_y[1] * y_first[i])
            w[(SECOND + i) * 8 + g] += share * (
                by_x[1] * (3.0 * s_i * s_i + area[i] * area[i])
                + by_y[1] * 2.0 * (s_j * s_j + s_k * s_k)
                + by_x[2] * x_first[i] * x_first[i]
                + by_y[2] * y_first[i] * y_first[i]
            )
            w[(SECOND + 3 + i) * 8 + g] += share * (
                by_x[1] * ((d - 1.0) * s_k + area[i] * area[j])
                + by_y[1] * 4.0 * (s_i * s_j - s_k)
                + by_x[2] * x_first[i] * x_first[j]
                + by_y[2] * y_first[i] * y_first[j]
            )
            w[(FLIP + i) * 8 + g] += share * (
                by_x[1] * (s_i * s_i + s_i * s_j + s_j * s_j - (d - 1.0) * s_k)
                + by_y[1] * (2.0 * (s_k * s_k - s_i * s_j) + 4.0 * s_k)
            )


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


def force_derivatives(
    mesh: HexMesh, points: QuadraturePoints, shares: Array, q: Array, direction: Array
) -> Array:
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


def rest_share(weights: Any) -> Any:
    """What weights (.., UNITS) relative to half of a law's mu add to mu at rest, relative to the law's."""
    return weights[..., ::2].sum(-1)
