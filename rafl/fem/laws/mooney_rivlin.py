"""Mooney-Rivlin rubber; J = det F, I = |F|^2 - 3 and K = |cof F|^2 - 3, which is to areas what I is to lengths:

psi(F) = mu/2 ((1 - m) I + m K) - (1 + m) mu (J - 1) + (mu - m mu + lambda)/2 (J - 1)^2.

At rest the law is linear elasticity with mu and lambda. It is finite and smooth for all stretches, negative ones
(inverted cells) included: the terms in J vanish if the rubber keeps its volume. Source of the first term: Rivlin, Large
Elastic Deformations of Isotropic Materials IV (1948), with C1 = (1 - m) mu / 2 and C2 = m mu / 2.
"""

from typing import Any

# Share m of the stiffness that is of areas, from 0 (neo-Hookean) to 1; outside, the energy of large strains is
# negative. By the best fit to tension of Dragon Skin FX-Pro with Slacker, a very soft rubber, up to 100 % strain
# (`make bench-laws`). Of the shares from 0 to 1, 0 fits Dragon Skin 10 best.
SHARE = 0.22


def energy(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Energy density [Pa] at the stretches."""
    lengths = s0**2 + s1**2 + s2**2 - 3
    areas = (s0 * s1) ** 2 + (s1 * s2) ** 2 + (s2 * s0) ** 2 - 3
    volume = s0 * s1 * s2 - 1
    distortion = (1 - SHARE) * lengths + SHARE * areas
    return mu / 2 * distortion - (1 + SHARE) * mu * volume + (mu - SHARE * mu + lam) / 2 * volume**2
