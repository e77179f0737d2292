"""What a specimen is made of."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.fem.laws import LAWS
from rafl.fem.mesh import HexMesh

MASSES = ("lumped", "uniform")
INTEGRATIONS = ("full", "selective")

# Named pairs of law and mass: the paper's simulator, and what a real specimen is closer to.
PRESETS: dict[str, dict[str, str]] = {
    "paper": {"law": "projective", "mass": "uniform"},
    "physical": {"law": "corotated", "mass": "lumped"},
}


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
        law: elastic law, one of `rafl.fem.laws.LAWS`.
        integration: `full`, at eight points a cell; `selective`, lambda's part of the cell's mean
            strain only (B-bar), so that nearly incompressible cells do not lock in bending.
        mass_damping: Rayleigh's alpha [1/s]; force alpha M v.
        stiffness_damping: Rayleigh's beta [s]; force beta K v, K the stiffness at rest. It resists
            rigid turning too: for large rotations take `viscosity`.
        viscosity: Kelvin and Voigt's eta [Pa s]; second Piola-Kirchhoff stress 2 eta dE/dt.

    Raises:
        ValueError: a name that is none of these, or a value that no material has.
    """

    youngs_modulus: float = 215856.0
    poissons_ratio: float = 0.45
    density: float = 1070.0
    mass: str = "uniform"
    law: str = "projective"
    integration: str = "full"
    mass_damping: float = 0.0
    stiffness_damping: float = 0.0
    viscosity: float = 0.0

    def __post_init__(self) -> None:
        for key, known in (("mass", MASSES), ("law", tuple(LAWS)), ("integration", INTEGRATIONS)):
            if getattr(self, key) not in known:
                raise ValueError(f"expected {key} to be one of {', '.join(known)}, got {getattr(self, key)!r}")
        if not (self.youngs_modulus > 0 and -1 < self.poissons_ratio < 0.5 and self.density > 0):
            raise ValueError(
                "expected a Young's modulus and a density above 0 and a Poisson's ratio between -1 and 0.5, "
                f"got {self.youngs_modulus}, {self.density}, {self.poissons_ratio}"
            )
        if min(self.mass_damping, self.stiffness_damping, self.viscosity) < 0:
            raise ValueError("expected mass_damping, stiffness_damping and viscosity not to be negative")

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's mu and lambda [Pa]."""
        return lame(self.youngs_modulus, self.poissons_ratio)

    def node_volume(self, mesh: HexMesh) -> NDArray[np.float64]:
        """What, times density, is the mass at every node [m^3], (N,)."""
        if self.mass == "uniform":
            return np.full(len(mesh.vertices), mesh.volumes.mean())
        rule = mesh.quadrature
        share = np.einsum("gn,eg->en", rule.shape, rule.volume)
        return np.bincount(mesh.hexes.ravel(), share.ravel(), len(mesh.vertices)).astype(np.float64)
