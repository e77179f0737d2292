"""Where a cell's energy is integrated."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh, Quadrature


@dataclass(frozen=True)
class Integration:
    """Integration points in groups of eight, and what they carry.

    Attributes:
        points: shape functions, gradients and volumes of all points P, those of no weight included.
        shares: how much of mu and of lambda the points of each group carry, (P / 8, 2).
    """

    points: Quadrature
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: HexMesh, name: str) -> "Integration":
        """`full`: eight Gauss points; `selective`: lambda's part of each cell's mean strain only (B-bar)."""
        full = mesh.quadrature
        if name == "full":
            return cls(full, np.ones((1, 2)))
        mean = mesh.mean
        points = Quadrature(
            np.concatenate([full.shape, np.repeat(mean.shape, 8, axis=0)]),
            np.concatenate([full.gradient, np.repeat(mean.gradient, 8, axis=1)], axis=1),
            np.concatenate([full.volume, np.pad(mean.volume, ((0, 0), (0, 7)))], axis=1),
        )
        return cls(points, np.array([[1.0, 0.0], [0.0, 1.0]]))

    @property
    def point_shares(self) -> NDArray[np.float64]:
        """How much of mu and of lambda each point carries, (P, 2)."""
        return np.repeat(self.shares, 8, axis=0)

    def stiffest(self, moduli: NDArray[np.float64]) -> NDArray[np.float64]:
        """A bound on the tangents' diagonal at rest [N/m], (B), of moduli (B, 5)."""
        return (2.0 * moduli[:, 0] + moduli[:, 1]) * self._stiffness_per_modulus

    @cached_property
    def _stiffness_per_modulus(self) -> float:
        return float(np.einsum("epni,ep->en", self.points.gradient**2, self.points.volume).max())
