"""The moduli of a body and the memory of its viscous stress, as the element kernels need them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = Any  # NumPy arrays or, placed on the device of an engine, torch tensors

# Columns of `moduli`. Internal forces are linear in each.
MODULI = ("mu", "lambda", "stiffness damping times rest mu", "stiffness damping times rest lambda")
DAMPING = (2, 3)  # columns


@dataclass(frozen=True)
class HourglassStiffness:
    """Stiffness of the hourglass modes of every shape of cell, see `rafl.fem.enhanced.hourglass`; all (B, U, 12, 12).

    Attributes:
        elastic: [N/m].
        viscous: for a viscous modulus of 1 Pa [N/m/Pa].
        damping: stiffness damping [N s/m].
    """

    elastic: Array
    viscous: Array
    damping: Array

    def select(self, index: NDArray[np.int64]) -> "HourglassStiffness":
        """The stiffness of the bodies `index` of the batch."""
        return HourglassStiffness(self.elastic[index], self.viscous[index], self.damping[index])


@dataclass(frozen=True)
class ConstitutiveState:
    """Moduli of a batch of bodies, and the history that their viscous stress depends on.

    The second Piola-Kirchhoff stress of the viscous parts is 2 (g E - memory), with E the Green strain and g the
    viscous modulus; see `rafl.simulation.viscous_memory`.

    Attributes:
        moduli: mu, lambda [Pa]; stiffness damping times rest mu and lambda [Pa s]; (B, 4).
        viscous_modulus: g at every integration point [Pa], (B, E, P), or None without viscosity.
        memory: of the viscous stress at every integration point [Pa], components 00 11 22 01 12 02, (B, E, P, 6), or
            None without viscosity.
        velocity_offset, velocity_factor: nodal velocities are velocity_factor * q - velocity_offset, (B, N, 3) [m/s]
            and [1/s], for stiffness damping; None without it.
        hourglass: for `enhanced` integration, else None.
        hourglass_memory: of the viscous forces of the hourglass modes, for `enhanced` integration with viscosity
            [Pa m], (B, E, 12), else None.
        energy_weights: of the learned energy [Pa], (B, K), see `rafl.fem.learned.energy`; None without it.
    """

    moduli: Array
    viscous_modulus: Array | None = None
    memory: Array | None = None
    velocity_offset: Array | None = None
    velocity_factor: float = 1.0
    hourglass: HourglassStiffness | None = None
    hourglass_memory: Array | None = None
    energy_weights: Array | None = None

    def select(self, index: NDArray[np.int64]) -> "ConstitutiveState":
        """The state of the bodies `index` of the batch."""

        def chosen(array: Array | None) -> Array | None:
            return None if array is None else array[index]

        return ConstitutiveState(
            self.moduli[index],
            chosen(self.viscous_modulus),
            chosen(self.memory),
            chosen(self.velocity_offset),
            self.velocity_factor,
            None if self.hourglass is None else self.hourglass.select(index),
            chosen(self.hourglass_memory),
            chosen(self.energy_weights),
        )
