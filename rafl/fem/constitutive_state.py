"""What a body answers a deformation with: elasticity and, where it has any, damping."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Columns of `moduli`; internal forces are linear in each.
MODULI = ("mu", "lambda", "viscosity", "stiffness damping times rest mu", "stiffness damping times rest lambda")


@dataclass(frozen=True)
class Resistance:
    """Moduli of a batch of bodies, and the past that their damping refers to.

    Attributes:
        moduli: mu, lambda [Pa]; viscosity, stiffness damping times rest mu and lambda [Pa s], (B, 5).
        drift, rate: nodal velocities are rate * q - drift, (B, N, 3) [m/s], [1/s].
        strain, strain_rate: Green strain rates are strain_rate * E - strain at every integration point,
            components 00 11 22 01 12 02, (B, E, P, 6) [1/s], [1/s].
    """

    moduli: Array
    drift: Array | None = None
    rate: float = 1.0
    strain: Array | None = None
    strain_rate: float = 1.0

    @property
    def damped(self) -> bool:
        """Whether there is a past."""
        return self.drift is not None

    def rows(self, index: NDArray[np.int64]) -> "Resistance":
        """Those of some bodies."""
        return Resistance(
            self.moduli[index],
            None if self.drift is None else self.drift[index],
            self.rate,
            None if self.strain is None else self.strain[index],
            self.strain_rate,
        )
