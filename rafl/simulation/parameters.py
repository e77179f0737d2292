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

    Shares and times of K branches are (K) or (B, K).

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
    gravity: Tensor

    @classmethod
    def of(cls, material: Material, gravity: tuple[float, float, float], /, **replacements: Any) -> "Parameters":
        """Parameters of a material under gravity [m/s^2], some of them replaced by name."""
        values = {item.name: getattr(material, item.name, gravity) for item in fields(cls)} | replacements
        return cls(**{key: torch.as_tensor(value, dtype=torch.float64) for key, value in values.items()})

    @property
    def viscous(self) -> bool:
        """Whether there are branches, or viscosity is non-zero or requires a gradient."""
        return self.branch_times.shape[-1] > 0 or _acts(self.viscosity)

    @property
    def stiffness_damped(self) -> bool:
        """Whether stiffness damping is non-zero or requires a gradient."""
        return _acts(self.stiffness_damping)

    @property
    def damped(self) -> bool:
        """Whether viscous stress or stiffness damping acts."""
        return self.viscous or self.stiffness_damped

    def rest_lame(self, law: str, batch: int) -> tuple[Tensor, Tensor]:
        """Lame parameters mu and lambda of the law's linearisation at rest [Pa], (B) each."""
        mu, lam = LAWS[law].rest_lame(*lame(self.youngs_modulus, self.poissons_ratio))
        return mu.expand(batch), lam.expand(batch)

    def branches(self, law: str, batch: int) -> tuple[Tensor, Tensor]:
        """Moduli [Pa] and relaxation times [s] of the branches, (B, K) each."""
        mu, _ = self.rest_lame(law, batch)
        shape = (batch, self.branch_times.shape[-1])
        return mu[:, None] * self.branch_shares.expand(shape), self.branch_times.expand(shape)

    def moduli(self, law: str, batch: int) -> Tensor:
        """Columns of `rafl.fem.constitutive_state.MODULI`, (B, 5), without a viscous modulus."""
        mu, lam = lame(self.youngs_modulus, self.poissons_ratio)
        rest_mu, rest_lam = self.rest_lame(law, batch)
        beta = self.stiffness_damping
        columns = (mu, lam, torch.zeros_like(mu), beta * rest_mu, beta * rest_lam)
        return torch.stack([column.expand(batch) for column in columns], dim=-1)


def _acts(value: Tensor) -> bool:
    return value.requires_grad or bool((value.detach() != 0.0).any())
