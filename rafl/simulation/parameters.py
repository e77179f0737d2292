"""Material parameters and gravity as tensors, so that a simulation can be differentiated with respect to them."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from rafl.fem.laws import LAWS
from rafl.fem.material import Material, lame


@dataclass(frozen=True)
class Parameters:
    """Material and gravity as tensors: scalars, or one number per trajectory (B); gravity (3) or (B, 3).

    Units are those of `rafl.fem.material.Material`; gravity in m/s^2.
    """

    youngs_modulus: Tensor
    poissons_ratio: Tensor
    density: Tensor
    mass_damping: Tensor
    stiffness_damping: Tensor
    viscosity: Tensor
    gravity: Tensor

    @classmethod
    def of(cls, material: Material, gravity: tuple[float, float, float], /, **replacements: Any) -> "Parameters":
        """Parameters of a material under gravity [m/s^2], some of them replaced by name."""
        values = {item.name: getattr(material, item.name, gravity) for item in fields(cls)} | replacements
        return cls(**{key: torch.as_tensor(value, dtype=torch.float64) for key, value in values.items()})

    @property
    def damped(self) -> bool:
        """Whether stiffness damping or viscosity is non-zero or requires a gradient."""
        return any(
            value.requires_grad or bool((value.detach() != 0.0).any())
            for value in (self.stiffness_damping, self.viscosity)
        )

    def moduli(self, law: str, batch: int) -> Tensor:
        """Columns of `rafl.fem.constitutive_state.MODULI`, (B, 5)."""
        mu, lam = lame(self.youngs_modulus, self.poissons_ratio)
        rest_mu, rest_lam = LAWS[law].rest_lame(mu, lam)
        beta = self.stiffness_damping
        columns = (mu, lam, self.viscosity, beta * rest_mu, beta * rest_lam)
        return torch.stack([column.expand(batch) for column in columns], dim=-1)
