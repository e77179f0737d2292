"""An elastic law of one's own: Gent's rubber, which cannot be stretched beyond the length of its chains."""

from dataclasses import replace
from typing import Any

import rafl
from rafl.fem.laws import log

LIMIT = 30  # |F|^2 - 3 of straight chains: five times the length


def gent(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Energy density [Pa] at principal stretches s0, s1, s2, with Lame parameters mu, lam [Pa]."""
    square, volume = s0**2 + s1**2 + s2**2 - 3, s0 * s1 * s2 - 1
    chains = -mu * LIMIT / 2 * log(1 - square / LIMIT)
    return chains - mu * volume + (mu - 2 * mu / LIMIT + lam) / 2 * volume**2


rafl.register_law("gent", gent)
specimen = rafl.read_specimen("specimen.yaml")
tip = {}
for law in ("corotated", "gent"):
    rubber = replace(specimen, material=replace(specimen.material, law=law))
    motion = rafl.predict(rubber, load_g=80, frames=20)
    tip[law] = 1e3 * motion.markers[:, -1, 2]
    print(f"{law}: the tip hangs at {tip[law][0]:.2f} mm and swings up to {tip[law].max():.2f} mm")
