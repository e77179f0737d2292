"""Stable neo-Hookean rubber: psi(F) = mu/2 (|F|^2 - 3) - mu (J - 1) + (mu + lambda)/2 (J - 1)^2, J = det F.

At rest the law is linear elasticity with mu and lambda. It is finite and smooth for all stretches, negative ones
(inverted cells) included. Source: Smith, De Goes and Kim, Stable Neo-Hookean Flesh Simulation (2018), without the
logarithmic term.
"""

from typing import Any


def energy(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Energy density [Pa] at the stretches."""
    square, volume = s0**2 + s1**2 + s2**2, s0 * s1 * s2
    return mu / 2 * (square - 3) - mu * (volume - 1) + (mu + lam) / 2 * (volume - 1) ** 2
