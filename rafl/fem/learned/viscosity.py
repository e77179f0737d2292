"""A learned viscosity: non-negative, of the strain and of its rate at each integration point.

The second Piola-Kirchhoff stress is 2 eta dE/dt, with the Green strain E and

    eta = mu sum_k w_k psi_k,    psi_k = 1 / sqrt(rate_k^2 + |dE/dt|^2)    or    TIME |E| / sqrt(strain_k^2 + |E|^2).

The first kind is friction: far above rate_k its stress 2 mu w_k no longer grows with the rate. The second acts where
the body is strained. With weights w_k >= 0 the power 2 eta |dE/dt|^2 that is dissipated is never negative. Over a step,
eta is that of the strain and the rate at its start, so the power stays non-negative whatever the step.
"""

from torch import Tensor

from rafl.fem.strain import MULTIPLICITY

RATES = (0.1, 1.0, 10.0)  # [1/s]; beams of 10 cm that swing at some hertz strain by 0.1 to 10 a second
STRAINS = (0.03, 0.3)  # from those of small swings to the largest of soft bodies in bending
TIME = 1e-3  # [s]; silicone of 50 kPa with a viscosity of 50 Pa s has such a time
UNITS = len(RATES) + len(STRAINS)


def learned_viscosity(weights: Tensor, strain: Tensor, rate: Tensor) -> Tensor:
    """Viscosity relative to mu [s], (B, E, P); weights (B, UNITS); strain and its rate [1/s] (B, E, P, 6)."""
    multiplicity = strain.new_tensor(MULTIPLICITY)
    strain_square, rate_square = ((x**2 * multiplicity).sum(-1) for x in (strain, rate))
    friction = [(r**2 + rate_square).rsqrt() for r in RATES]
    # The square root of the strain has no slope at zero; |E| is rounded there.
    size = (strain_square + (0.01 * STRAINS[0]) ** 2).sqrt()
    strained = [TIME * size / (s**2 + strain_square).sqrt() for s in STRAINS]
    total = strain.new_zeros(strain.shape[:-1])
    for k, unit in enumerate(friction + strained):
        total = total + weights[:, k, None, None] * unit
    return total
