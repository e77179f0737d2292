"""The strains and strain rates that some motions reach, to tell what a model has seen."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from rafl.fem.mesh import HexMesh
from rafl.fem.strain import green_strain, magnitude

MARGIN = 0.1  # by which a range must be left before it counts; recordings of one shape scatter by as much
QUANTILE = 0.99  # over cells and frames: single cells beside the clamp do not count


@dataclass(frozen=True)
class StrainRange:
    """Largest strain and strain rate of some motions.

    Attributes:
        strain: magnitude of the Green strain.
        rate: of its change [1/s].
    """

    strain: float
    rate: float

    @classmethod
    def of(cls, mesh: HexMesh, positions: Tensor, time_step: float) -> "StrainRange":
        """Range of vertex positions (T, B, N, 3) [m], one frame every `time_step` [s]."""
        frames, batch = positions.shape[:2]
        flat = positions.detach().reshape(frames * batch, -1, 3).numpy()
        strain, _ = green_strain(mesh, mesh.mean_quadrature, flat, np.zeros_like(flat))
        strain = strain[:, :, 0].reshape(frames, batch, -1, 6)
        rate = np.diff(strain, axis=0) / time_step
        size, speed = magnitude(strain), magnitude(rate)
        return cls(float(np.quantile(size, QUANTILE)), float(np.quantile(speed, QUANTILE)))

    def exceeds(self, other: "StrainRange") -> bool:
        """Whether strain or rate are larger than those of another range by more than `MARGIN`."""
        return self.strain > (1.0 + MARGIN) * other.strain or self.rate > (1.0 + MARGIN) * other.rate

    def united(self, other: "StrainRange") -> "StrainRange":
        """The range that covers both."""
        return StrainRange(max(self.strain, other.strain), max(self.rate, other.rate))
