"""What a specimen is made of."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.mesh import HexMesh


def lame(youngs_modulus: Any, poissons_ratio: Any) -> tuple[Any, Any]:
    """Lame's mu and lambda [Pa] from E [Pa] and nu; floats, arrays and tensors alike."""
    e, nu = youngs_modulus, poissons_ratio
    mu = e / (2.0 * (1.0 + nu))
    lam = e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return mu, lam


@dataclass(frozen=True)
class Material:
    """A homogeneous, nearly incompressible rubber.

    Attributes:
        youngs_modulus: E [Pa].
        poissons_ratio: nu, below 0.5.
        density: rho [kg/m^3].
        mass: how the nodes carry it. `uniform`: rho times the mean cell volume at every node, as the
            paper's simulator has it (a beam then weighs about twice its truth); `lumped`: each
            node's share of its cells, which adds up to the true mass.
    """

    youngs_modulus: float = 215856.0
    poissons_ratio: float = 0.45
    density: float = 1070.0
    mass: str = "uniform"

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's mu and lambda [Pa]."""
        return lame(self.youngs_modulus, self.poissons_ratio)

    def node_mass(self, mesh: HexMesh) -> NDArray[np.float64]:
        """Mass at every node [kg], (N,)."""
        if self.mass == "uniform":
            return np.full(len(mesh.vertices), self.density * mesh.volumes.mean())
        share = np.einsum("gn,eg->en", mesh.quadrature.shape, mesh.quadrature.volume)
        mass = np.zeros(len(mesh.vertices))
        np.add.at(mass, mesh.hexes, self.density * share)
        return mass
