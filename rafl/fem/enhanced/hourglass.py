"""Hourglass modes of a hexahedron: their shape, and a stiffness that locks neither in bending nor in volume.

The positions of a cell's eight nodes have an affine part, the mean deformation gradient F0, and four hourglass vectors
Gamma_k = sum_n gamma_kn x_n [m] that vanish for every affine motion (Flanagan and Belytschko, 1981). The gradient of
the trilinear interpolation is F0 + sum_k Gamma_k c_k^T, with c_k [1/m] known at every point.

The energy of the hourglass modes is Y K Y / 2 with Y = R^T Gamma (12 numbers) and R the polar rotation of F0. K is the
linear elastic stiffness at rest, with twelve enhanced strains that are eliminated cell by cell: the nine gradients of
incompatible displacements (Wilson and others, 1973, in the form of Taylor, Beresford and Wilson, 1976) and three
changes of volume (Simo, Armero and Taylor, 1993). So a cell bends exactly as a beam does, at any Poisson's ratio. K is
positive definite in every state of strain, so no hourglass mode becomes unstable under compression, where enhanced
strains that follow the deformation do. Source of this physical stabilisation: Puso, Int. J. Numer. Meth. Engng 49
(2000).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.mesh import CORNERS, HexMesh

MODES = 12  # four hourglass vectors of three components; component i of vector k has index 3 k + i
SIGNS = 2.0 * CORNERS - 1.0
# Values of the four hourglass patterns at the nodes: yz, zx, xy, xyz, (4, 8).
PATTERNS = np.stack([SIGNS[:, 1] * SIGNS[:, 2], SIGNS[:, 2] * SIGNS[:, 0], SIGNS[:, 0] * SIGNS[:, 1], SIGNS.prod(1)])
SHAPE_DIGITS = 9  # cells whose edges agree to so many digits, relative to their size, share a stiffness


@dataclass(frozen=True)
class HourglassModes:
    """The hourglass modes of the cells of a mesh.

    Attributes:
        mesh: the rest shape.
    """

    mesh: HexMesh

    @cached_property
    def gamma(self) -> NDArray[np.float64]:
        """Hourglass vectors per nodal position, (E, 4, 8)."""
        corners = self.mesh.vertices[self.mesh.hexes]
        mean = self.mesh.mean_quadrature.gradient[:, 0]  # (E, 8, 3)
        along = np.einsum("kn,enj->ekj", PATTERNS, corners)
        return np.asarray((PATTERNS - np.einsum("ekj,enj->ekn", along, mean)) / 8.0)

    def vectors(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hourglass vectors of nodal values x (B, N, 3), (B, E, 12)."""
        vectors = np.einsum("ekn,beni->beki", self.gamma, x[:, self.mesh.hexes])
        return np.asarray(vectors.reshape(*vectors.shape[:2], MODES))

    @cached_property
    def _shapes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        corners = self.mesh.vertices[self.mesh.hexes]
        edges = (corners - corners[:, :1]).reshape(len(corners), -1)
        size = np.ptp(self.mesh.vertices, axis=0).max()
        rounded = np.round(edges / size, SHAPE_DIGITS)
        _, first, index = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        return first, index.reshape(-1)

    @property
    def shape_index(self) -> NDArray[np.int64]:
        """Which of the U distinct shapes each cell has, (E,)."""
        return self._shapes[1]

    @cached_property
    def _blocks(self) -> tuple[Tensor, Tensor]:
        """Stiffness of hourglass modes and enhanced strains per mu and per lambda [m], each (U, 24, 24)."""
        cells = self._shapes[0]
        full, mean = self.mesh.quadrature, self.mesh.mean_quadrature
        gamma = self.gamma[cells]
        slope = full.gradient[cells] - mean.gradient[cells]  # (U, 8 points, 8 nodes, 3)
        directions = np.einsum("ugnj,unk->ugkj", slope, np.linalg.pinv(gamma))
        # Displacement gradients of the modes, then of the enhanced strains, (U, 8, 24, 3, 3).
        own = np.zeros((*directions.shape[:2], 4, 3, 3, 3))
        for i in range(3):
            own[:, :, :, i, i, :] = directions
        enhanced = self._enhanced_gradients(cells)
        gradients = np.concatenate([own.reshape(*own.shape[:2], MODES, 3, 3), enhanced], axis=2)
        strain = 0.5 * (gradients + gradients.swapaxes(-1, -2))
        trace = np.trace(strain, axis1=-2, axis2=-1)
        weight = full.volume[cells]
        per_mu = 2.0 * np.einsum("ug,ugaij,ugbij->uab", weight, strain, strain)
        per_lambda = np.einsum("ug,uga,ugb->uab", weight, trace, trace)
        return torch.from_numpy(per_mu), torch.from_numpy(per_lambda)

    def _enhanced_gradients(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Gradients of the enhanced strains at the Gauss points, with mean zero in each cell, (U, 8, 12, 3, 3)."""
        corners = self.mesh.vertices[self.mesh.hexes[cells]]
        weight = self.mesh.quadrature.volume[cells]
        centre = np.einsum("uni,nj->uij", corners, SIGNS) / 8.0  # Jacobian at the cell's centre
        inverse = np.linalg.inv(centre)
        points = SIGNS / np.sqrt(3.0)
        scale = np.linalg.det(centre)[:, None] / weight
        out = np.zeros((len(cells), 8, MODES, 3, 3))
        for a in range(3):
            for i in range(3):
                gradient = centre[:, :, a, None] * inverse[:, i, None, :]
                out[:, :, 3 * a + i] = (scale * points[:, i])[..., None, None] * gradient[:, None]
            volume_change = points[:, a] * points[:, (a + 1) % 3]
            out[:, :, 9 + a] = (scale * volume_change)[..., None, None] * np.eye(3)
        mean = np.einsum("ug,ugaij->uaij", weight, out) / weight.sum(1)[:, None, None, None]
        return np.asarray(out - mean[:, None])

    def stiffness(self, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
        """Stiffness K [N/m] at rest, and its derivative by mu at fixed ratios of the enhanced strains [m].

        Differentiable with respect to mu and lambda [Pa], the Lame parameters at rest, (B). Both (B, U, 12, 12).
        """
        per_mu, per_lambda = self._blocks
        whole = mu[:, None, None, None] * per_mu + lam[:, None, None, None] * per_lambda
        coupling = whole[..., MODES:, :MODES]
        ratios = -torch.linalg.solve(whole[..., MODES:, MODES:], coupling)
        stiffness = whole[..., :MODES, :MODES] + coupling.mT @ ratios
        mixed = per_mu[:, :MODES, MODES:] @ ratios
        by_mu = per_mu[:, :MODES, :MODES] + mixed + mixed.mT + ratios.mT @ per_mu[:, MODES:, MODES:] @ ratios
        return stiffness, by_mu
