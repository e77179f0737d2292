"""Green strain at integration points, and its derivatives; components 00 11 22 01 12 02."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh, QuadraturePoints

Array = NDArray[Any]

FIRST, SECOND = [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]  # indices of the components
# How often a symmetric tensor holds each component.
MULTIPLICITY = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


def green_strain(mesh: HexMesh, points: QuadraturePoints, q: Array, direction: Array) -> tuple[Array, Array]:
    """Green strain at positions q [m], and its change along `direction`, both (B, N, 3); two arrays (B, E, P, 6)."""
    F, change = (np.einsum("beni,epnj->bepij", x[:, mesh.hexes], points.gradient) for x in (q, direction))
    strain = 0.5 * (F.swapaxes(-1, -2) @ F - np.eye(3))
    product = F.swapaxes(-1, -2) @ change
    strain_change = 0.5 * (product + product.swapaxes(-1, -2))
    return strain[..., FIRST, SECOND], strain_change[..., FIRST, SECOND]


def magnitude(strain: Array) -> Array:
    """Frobenius norm (...) of symmetric tensors (..., 6), the root of the sum of their nine squared components."""
    return np.asarray(np.sqrt((strain**2 * MULTIPLICITY).sum(-1)))


def green_strain_adjoint(mesh: HexMesh, points: QuadraturePoints, q: Array, by_strain: Array) -> Array:
    """Derivative by q (B, N, 3) of the sum of by_strain (B, E, P, 6) times the Green strain, (B, N, 3)."""
    F = np.einsum("beni,epnj->bepij", q[:, mesh.hexes], points.gradient)
    tensor = np.zeros(F.shape)
    share = by_strain / MULTIPLICITY
    tensor[..., FIRST, SECOND] = share
    tensor[..., SECOND, FIRST] = share
    force = np.einsum("bepij,epnj->beni", F @ tensor, points.gradient)
    return scatter(force, mesh.hexes, q.shape[1])


def scatter(force: Array, hexes: NDArray[np.int64], nodes: int) -> Array:
    """Sum of the forces of the cells (B, E, 8, 3) at every node, (B, N, 3)."""
    flat = force.reshape(len(force), -1, 3)
    out = np.zeros((len(force), nodes, 3))
    for b in range(len(force)):
        for i in range(3):
            out[b, :, i] = np.bincount(hexes.ravel(), flat[b, :, i], nodes)
    return out
