"""Linear corotated elasticity: psi(F) = mu |F - R|^2 + (lambda / 2) tr^2(R^T F - I), with polar rotation R.

Finite and smooth for all stretches, negative ones (inverted cells) included.
"""

from typing import Any


def energy(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Energy density [Pa] at the stretches."""
    return mu * ((s0 - 1) ** 2 + (s1 - 1) ** 2 + (s2 - 1) ** 2) + lam / 2 * (s0 + s1 + s2 - 3) ** 2
