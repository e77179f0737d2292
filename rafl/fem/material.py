"""Material parameters of a specimen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.fem.laws import LAWS
from rafl.fem.learned.energy import UNITS as ENERGY_UNITS
from rafl.fem.learned.viscosity import UNITS as VISCOSITY_UNITS
from rafl.fem.mesh import HexMesh

MASS_MODELS = ("lumped", "uniform")
INTEGRATION_SCHEMES = ("full", "selective", "enhanced")

# Law, mass model and integration of the paper's simulator, and those that are closer to a real specimen.
PRESETS: dict[str, dict[str, str]] = {
    "paper": {"law": "projective", "mass": "uniform"},
    "physical": {"law": "corotated", "mass": "lumped", "integration": "enhanced"},
}
# Time integration of a simulator of either preset: one of `rafl.simulation.time_integration.INTEGRATORS`, and the steps
# per frame. With one step of 10 ms a mode of 8 Hz swings too slowly by 2.8 %, with two steps by 0.7 %, with three by
# 0.3 %; one of 14 Hz by 8, 2.3 and 1.0 %. Four steps would take a third more time for 0.2 and 0.6 %.
PRESET_TIME_INTEGRATION = {"paper": ("implicit-euler", 1), "physical": ("generalised-alpha", 3)}


def lame(youngs_modulus: Any, poissons_ratio: Any) -> tuple[Any, Any]:
    """Lame parameters mu and lambda [Pa] from E [Pa] and nu, for floats, arrays and tensors."""
    e, nu = youngs_modulus, poissons_ratio
    mu = e / (2.0 * (1.0 + nu))
    lam = e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return mu, lam


SOFTEST = 1e3  # Young's modulus [Pa] below which no silicone is; the softest on sale have some 10 kPa
LIGHTEST = 10.0  # density [kg/m^3] below which no solid is that can be filmed; soft foams have some 20


def _modulus_hint(youngs_modulus: float) -> str:
    """A sentence about a Young's modulus [Pa] that looks as if it were given in kPa or MPa; else empty."""
    if youngs_modulus >= SOFTEST:
        return ""
    unit, factor = ("kPa", 1e3) if youngs_modulus >= 1e-2 * SOFTEST else ("MPa", 1e6)
    return (
        f"Young's modulus {youngs_modulus:g} Pa is below {SOFTEST:g} Pa, softer than any silicone; if it is in {unit}, "
        f"write {factor * youngs_modulus:g}"
    )


def _density_hint(density: float) -> str:
    """A sentence about a density [kg/m^3] that looks as if it were given in g/cm^3; else empty."""
    if density >= LIGHTEST:
        return ""
    return (
        f"density {density:g} kg/m3 is below {LIGHTEST:g} kg/m3, lighter than any foam; if it is in g/cm3, write "
        f"{1e3 * density:g}"
    )


def unit_hints(youngs_modulus: float, density: float) -> list[str]:
    """Sentences about a Young's modulus [Pa] and a density [kg/m^3] that look as if given in other units."""
    return [hint for hint in (_modulus_hint(youngs_modulus), _density_hint(density)) if hint]


@dataclass(frozen=True)
class Material:
    """A homogeneous, nearly incompressible rubber.

    The defaults are those of the paper's simulator. A specimen file takes the preset `physical` instead, which is
    closer to a real specimen: `Material(mass="lumped", law="corotated", integration="enhanced")`.

    Attributes:
        youngs_modulus: E [Pa].
        poissons_ratio: nu, below 0.5.
        density: rho [kg/m^3].
        mass: mass model. `lumped`: every node has its share of the adjacent cells' mass; the sum is the true mass.
            `uniform`: every node has rho times the mean cell volume, as in the paper's simulator. The sum is about
            twice the true mass of the paper's beams, and more on coarser meshes.
        law: elastic law: `projective`, `corotated`, `neo-hookean`, `yeoh`, `mooney-rivlin`, or one that you have
            registered with `rafl.register_law`.
        integration: `full`: eight points per cell. `selective`: the lambda term sees the cell's mean
            strain only (B-bar), so nearly incompressible cells do not lock in volume. `enhanced`: the law sees each
            cell's mean deformation, and the hourglass modes have a stiffness that locks neither in volume nor in
            bending, see `rafl.fem.enhanced.hourglass`.
        mass_damping: Rayleigh coefficient alpha [1/s]; the damping force is alpha M v.
        stiffness_damping: Rayleigh coefficient beta [s]; the damping force is beta K v, with K the stiffness
            at rest. It also damps rigid rotation; use `viscosity` for large rotations.
        viscosity: Kelvin-Voigt coefficient eta [Pa s]; second Piola-Kirchhoff stress 2 eta dE/dt.
        branch_shares, branch_times: of the Maxwell branches: shear modulus relative to mu at rest, and relaxation time
            [s]; see `rafl.simulation.viscous_memory`. E is the relaxed modulus.
        energy_weights: of a learned strain energy, see `rafl.fem.learned.energy`, relative to mu / 2. E and nu stay
            those of small strains: the law takes what the learned energy leaves of mu. Empty for none.
        dissipation_weights: of a learned viscosity, see `rafl.fem.learned.viscosity`, relative to mu. Empty for none.

    Raises:
        ValueError: unknown name, or a value outside its physical range.
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
    branch_shares: tuple[float, ...] = ()
    branch_times: tuple[float, ...] = ()
    energy_weights: tuple[float, ...] = ()
    dissipation_weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for key, known in (("mass", MASS_MODELS), ("law", tuple(LAWS)), ("integration", INTEGRATION_SCHEMES)):
            if getattr(self, key) not in known:
                advice = "; register a law of your own first (rafl.register_law)" if key == "law" else ""
                raise ValueError(f"expected {key} to be one of {', '.join(known)}, got {getattr(self, key)!r}{advice}")
        for key in ("youngs_modulus", "poissons_ratio", "density", "mass_damping", "stiffness_damping", "viscosity"):
            if not np.isfinite(getattr(self, key)):
                raise ValueError(f"expected a finite {key}, got {getattr(self, key)}")
        if not (self.youngs_modulus > 0 and -1 < self.poissons_ratio < 0.5 and self.density > 0):
            raise ValueError(
                "expected a Young's modulus and a density above 0 and a Poisson's ratio between -1 and 0.5, "
                f"got {self.youngs_modulus}, {self.density}, {self.poissons_ratio}"
            )
        if min(self.mass_damping, self.stiffness_damping, self.viscosity) < 0:
            raise ValueError(
                "expected mass_damping, stiffness_damping and viscosity of at least 0, "
                f"got {self.mass_damping}, {self.stiffness_damping}, {self.viscosity}"
            )
        if len(self.branch_shares) != len(self.branch_times):
            raise ValueError(
                f"expected as many branch_shares as branch_times, got {len(self.branch_shares)} and "
                f"{len(self.branch_times)}"
            )
        finite = np.isfinite(self.branch_shares).all() and np.isfinite(self.branch_times).all()
        if not finite or min(self.branch_shares, default=0.0) < 0 or min(self.branch_times, default=1.0) <= 0:
            raise ValueError(
                "expected branch_shares of at least 0 and branch_times above 0, "
                f"got {self.branch_shares} and {self.branch_times}"
            )
        for key, units in (("energy_weights", ENERGY_UNITS), ("dissipation_weights", VISCOSITY_UNITS)):
            weights = getattr(self, key)
            if len(weights) not in (0, units) or not all(0.0 <= weight < np.inf for weight in weights):
                raise ValueError(f"expected {units} {key} of at least 0, or none, got {weights}")

    @property
    def lame(self) -> tuple[float, float]:
        """Lame parameters mu and lambda [Pa]."""
        return lame(self.youngs_modulus, self.poissons_ratio)

    def node_volume(self, mesh: HexMesh) -> NDArray[np.float64]:
        """Mass of every node divided by the density [m^3], (N,)."""
        if self.mass == "uniform":
            return np.full(len(mesh.vertices), mesh.volumes.mean())
        rule = mesh.quadrature
        share = np.einsum("gn,eg->en", rule.shape, rule.volume)
        return np.bincount(mesh.hexes.ravel(), share.ravel(), len(mesh.vertices)).astype(np.float64)
