"""Hourglass terms of `enhanced` integration in plain, differentiable tensors; see `rafl.fem.enhanced.hourglass`."""

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from rafl.fem.enhanced.hourglass import MODES


def _cross_matrix(v: Tensor) -> Tensor:
    """Matrix of the cross product with v (3)."""
    zero = torch.zeros_like(v[0])
    return torch.stack([zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero]).reshape(3, 3)


def local_vectors(x: Tensor, gradient: Tensor, gamma: Tensor, rotation: Tensor) -> Tensor:
    """Y = R^T Gamma (12) of one cell with nodal positions x (8, 3).

    `rotation` (3, 3) is the polar rotation R of F = x^T gradient, with gradient (8, 3) and gamma (4, 8), as a constant.
    Two steps of an iteration that converges quadratically give R its first and second derivatives.
    """
    F = x.T @ gradient
    R = rotation
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    for _ in range(2):
        S = R.T @ F
        axial = torch.stack([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]])
        a, b, c = (torch.trace(S) * identity - S).T  # columns
        b_c = torch.linalg.cross(b, c)
        solution = torch.stack([b_c @ axial, torch.linalg.cross(c, a) @ axial, torch.linalg.cross(a, b) @ axial])
        turn = _cross_matrix(solution / (a @ b_c))
        R = R @ (identity + turn + 0.5 * turn @ turn)
    return (gamma @ x @ R).reshape(MODES)


def _energy(
    x: Tensor,
    gradient: Tensor,
    gamma: Tensor,
    rotation: Tensor,
    elastic: Tensor,
    viscous: Tensor,
    modulus: Tensor,
    memory: Tensor,
) -> Tensor:
    """Elastic and viscous energy [J] of the hourglass modes of one cell; `modulus` is that of the viscous stress."""
    y = local_vectors(x, gradient, gamma, rotation)
    strain = modulus * y - memory
    return 0.5 * y @ elastic @ y + 0.5 / modulus.clamp_min(1e-300) * strain @ viscous @ strain


# All over the cells of a batch, (B, E, ..).
vectors = vmap(vmap(local_vectors))
vector_jacobian = vmap(vmap(jacrev(local_vectors)))
energies = vmap(vmap(_energy))
forces = vmap(vmap(jacrev(_energy)))
tangents = vmap(vmap(jacrev(jacrev(_energy))))
