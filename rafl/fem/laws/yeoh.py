"""Yeoh rubber, up to the second term of the series; J = det F and I = |F|^2 - 3:

psi(F) = mu/2 (I + C2 I^2) - mu (J - 1) + (mu - 4 C2 mu + lambda)/2 (J - 1)^2.

At rest the law is linear elasticity with mu and lambda. It is finite and smooth for all stretches, negative ones
(inverted cells) included: the terms in J vanish if the rubber keeps its volume. Source of the first term: Yeoh, Some
Forms of the Strain Energy Function for Rubber (1993).
"""

from typing import Any

# Stiffening at large strain, by the best fit to tension of Dragon Skin 10 up to 100 % strain (`make bench-laws`). The
# series' third term is left out: it would be negative there, and the stress would fall beyond three times the length.
C2 = 0.126


def energy(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Energy density [Pa] at the stretches."""
    square, volume = s0**2 + s1**2 + s2**2 - 3, s0 * s1 * s2 - 1
    return mu / 2 * (square + C2 * square**2) - mu * volume + (mu - 4 * C2 * mu + lam) / 2 * volume**2
