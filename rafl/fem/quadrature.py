"""Quadrature rules for the elastic energy of a cell."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh, QuadraturePoints


@dataclass(frozen=True)
class QuadratureRule:
    """Integration points in groups of eight, and the fraction of the moduli at each.

    Attributes:
        mesh: the rest shape.
        points: shape functions, gradients and volumes of all P points, including padding points of volume 0.
        group_shares: fraction of mu and of lambda that each group of points integrates, (P / 8, 2); of the only point
            for `enhanced`.
    """

    mesh: HexMesh
    points: QuadraturePoints
    group_shares: NDArray[np.float64]

    @classmethod
    def from_scheme(cls, mesh: HexMesh, scheme: str) -> "QuadratureRule":
        """The rule of one of `rafl.fem.material.INTEGRATION_SCHEMES`.

        `full` takes eight Gauss points. `selective` integrates mu at these points, and lambda at one point of
        the cell's mean gradient (B-bar), padded to a group of eight. `enhanced` has the mean gradient only.
        """
        full = mesh.quadrature
        if scheme == "full":
            return cls(mesh, full, np.ones((1, 2)))
        mean = mesh.mean_quadrature
        if scheme == "enhanced":
            return cls(mesh, mean, np.ones((1, 2)))
        points = QuadraturePoints(
            np.concatenate([full.shape, np.repeat(mean.shape, 8, axis=0)]),
            np.concatenate([full.gradient, np.repeat(mean.gradient, 8, axis=1)], axis=1),
            np.concatenate([full.volume, np.pad(mean.volume, ((0, 0), (0, 7)))], axis=1),
        )
        return cls(mesh, points, np.array([[1.0, 0.0], [0.0, 1.0]]))

    @property
    def point_shares(self) -> NDArray[np.float64]:
        """Fraction of mu and of lambda that each point integrates, (P, 2)."""
        return np.repeat(self.group_shares, len(self.points.shape) // len(self.group_shares), axis=0)

    def max_rest_stiffness(self, moduli: NDArray[np.float64]) -> NDArray[np.float64]:
        """Upper bound [N/m] of the diagonal of the cells' tangents at rest, (B), for moduli (B, 4)."""
        return (2.0 * moduli[:, 0] + moduli[:, 1]) * self._stiffness_per_modulus

    @cached_property
    def _stiffness_per_modulus(self) -> float:
        full = self.mesh.quadrature
        return float(np.einsum("epni,ep->en", full.gradient**2, full.volume).max())
