"""Material parameters and gravity as tensors, so that a simulation can be differentiated with respect to them."""

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from rafl.fem.laws import LAWS
from rafl.fem.learned.energy import shared_weights
from rafl.fem.material import Material, lame

# Ranges of the parameters; the lower bound is left out for those in ABOVE_LOW.
PHYSICAL_RANGES = {
    **dict.fromkeys(("youngs_modulus", "density", "branch_times"), (0.0, math.inf)),
    **dict.fromkeys(("mass_damping", "stiffness_damping", "viscosity", "branch_shares"), (0.0, math.inf)),
    **dict.fromkeys(("energy_weights", "dissipation_weights"), (0.0, math.inf)),
    "poissons_ratio": (-1.0, 0.5),
    "gravity": (-math.inf, math.inf),
}
ABOVE_LOW = ("youngs_modulus", "density", "branch_times", "poissons_ratio", "gravity")


@dataclass(frozen=True)
class Parameters:
    """Material and gravity as tensors: scalars, or one number per trajectory (B); gravity (3) or (B, 3).

    Shares and times of K branches are (K) or (B, K), and so are the weights of a learned energy and viscosity.

    Units are those of `rafl.fem.material.Material`; gravity in m/s^2.
    """

    youngs_modulus: Tensor
    poissons_ratio: Tensor
    density: Tensor
    mass_damping: Tensor
    stiffness_damping: Tensor
    viscosity: Tensor
    branch_shares: Tensor
    branch_times: Tensor
    energy_weights: Tensor
    dissipation_weights: Tensor
    gravity: Tensor

    @classmethod
    def of(cls, material: Material, gravity: tuple[float, float, float], /, **replacements: Any) -> "Parameters":
        """Parameters of a material under gravity [m/s^2], some of them replaced by name.

        Raises:
            ValueError: an unknown name, or a value outside its physical range.
        """
        values = {item.name: getattr(material, item.name, gravity) for item in fields(cls)} | replacements
        tensors = {key: torch.as_tensor(value, dtype=torch.float64) for key, value in values.items()}
        for key in replacements:
            _check_physical(key, tensors.get(key))
        return cls(**tensors)

    @property
    def viscous(self) -> bool:
        """Whether there are branches or a learned viscosity, or viscosity is non-zero or requires a gradient."""
        has_units = self.branch_times.shape[-1] > 0 or self.dissipation_weights.shape[-1] > 0
        return has_units or _acts(self.viscosity)

    @property
    def stiffness_damped(self) -> bool:
        """Whether stiffness damping is non-zero or requires a gradient."""
        return _acts(self.stiffness_damping)

    @property
    def damped(self) -> bool:
        """Whether viscous stress or stiffness damping acts."""
        return self.viscous or self.stiffness_damped

    def _law_lame(self) -> tuple[Tensor, Tensor]:
        """Parameters mu and lambda of the law [Pa]: mu without what a learned energy has of it at rest."""
        mu, lam = lame(self.youngs_modulus, self.poissons_ratio)
        return (mu * shared_weights(self.energy_weights)[1] if self.energy_weights.shape[-1] else mu), lam

    def rest_lame(self, law: str, batch: int) -> tuple[Tensor, Tensor]:
        """Lame parameters mu and lambda of the linearisation at rest [Pa], (B) each, learned energy included."""
        own, lam = self._law_lame()
        mu, rest_lam = LAWS[law].rest_lame(own, lam)
        if self.energy_weights.shape[-1]:
            whole, _ = lame(self.youngs_modulus, self.poissons_ratio)
            mu = mu + (whole - own)
        return mu.expand(batch), rest_lam.expand(batch)

    def energy(self, batch: int) -> Tensor | None:
        """Weights of the learned energy [Pa], (B, K), or None without it."""
        units = self.energy_weights.shape[-1]
        mu, _ = lame(self.youngs_modulus, self.poissons_ratio)
        return (0.5 * mu[..., None] * shared_weights(self.energy_weights)[0]).expand(batch, units) if units else None

    def dissipation(self, law: str, batch: int) -> Tensor | None:
        """Weights of the learned viscosity times mu at rest [Pa], (B, K), or None without it."""
        units = self.dissipation_weights.shape[-1]
        return self.rest_lame(law, batch)[0][:, None] * self.dissipation_weights.expand(batch, units) if units else None

    def branches(self, law: str, batch: int) -> tuple[Tensor, Tensor]:
        """Moduli [Pa] and relaxation times [s] of the branches, (B, K) each."""
        mu, _ = self.rest_lame(law, batch)
        shape = (batch, self.branch_times.shape[-1])
        return mu[:, None] * self.branch_shares.expand(shape), self.branch_times.expand(shape)

    def moduli(self, law: str, batch: int) -> Tensor:
        """Columns of `rafl.fem.constitutive_state.MODULI`, (B, 4)."""
        mu, lam = self._law_lame()
        rest_mu, rest_lam = self.rest_lame(law, batch)
        beta = self.stiffness_damping
        columns = (mu, lam, beta * rest_mu, beta * rest_lam)
        return torch.stack([column.expand(batch) for column in columns], dim=-1)


def _check_physical(key: str, value: Tensor | None) -> None:
    """Raise ValueError unless a parameter may have a value (of any shape)."""
    if value is None or key not in {item.name for item in fields(Parameters)}:
        raise ValueError(f"expected one of {', '.join(item.name for item in fields(Parameters))}, got {key!r}")
    low, high = PHYSICAL_RANGES[key]
    number = value.detach()
    inside = (number > low if key in ABOVE_LOW else number >= low) & (number < high)
    if not bool(inside.all()):
        bound = "above" if key in ABOVE_LOW else "of at least"
        raise ValueError(f"expected {key} {bound} {low:g} and below {high:g}, got {number[~inside].ravel()[0]:g}")


def _acts(value: Tensor) -> bool:
    return value.requires_grad or bool((value.detach() != 0.0).any())
