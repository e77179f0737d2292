"""The moduli of a body and the history of its damping, as the element kernels need them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Columns of `moduli`. Internal forces are linear in each.
MODULI = ("mu", "lambda", "viscosity", "stiffness damping times rest mu", "stiffness damping times rest lambda")


@dataclass(frozen=True)
class ConstitutiveState:
    """Moduli of a batch of bodies, and the history that their damping depends on.

    Attributes:
        moduli: mu, lambda [Pa]; viscosity, stiffness damping times rest mu and lambda [Pa s]; (B, 5).
        velocity_offset, velocity_factor: nodal velocities are velocity_factor * q - velocity_offset,
            (B, N, 3) [m/s] and [1/s]. Without an offset the bodies are undamped.
        strain_offset, strain_factor: Green strain rates at every integration point are
            strain_factor * E - strain_offset, components 00 11 22 01 12 02, (B, E, P, 6) [1/s] and [1/s].
    """

    moduli: Array
    velocity_offset: Array | None = None
    velocity_factor: float = 1.0
    strain_offset: Array | None = None
    strain_factor: float = 1.0

    @property
    def damped(self) -> bool:
        """Whether damping forces act."""
        return self.velocity_offset is not None

    def select(self, index: NDArray[np.int64]) -> "ConstitutiveState":
        """The state of the bodies `index` of the batch."""
        return ConstitutiveState(
            self.moduli[index],
            None if self.velocity_offset is None else self.velocity_offset[index],
            self.velocity_factor,
            None if self.strain_offset is None else self.strain_offset[index],
            self.strain_factor,
        )
