"""Energies of elastic laws of one's own, all with the Lame parameters mu and lambda at rest."""

from typing import Any

from rafl.fem.laws import exp, log, sqrt


def gent(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Gent, A New Constitutive Relation for Rubber (1996): the chains are straight at |F|^2 - 3 = 30."""
    volume = s0 * s1 * s2
    chains = -15 * mu * log(1 - (s0**2 + s1**2 + s2**2 - 3) / 30)
    return chains - mu * log(volume) + (lam - mu / 15) / 2 * (volume + 1 / volume - 2)


def ogden(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Ogden, Large Deformation Isotropic Elasticity (1972), two terms: powers of single stretches."""
    first = 1.2 / 1.5 * (s0**1.5 + s1**1.5 + s2**1.5 - 3)
    second = 0.1 / 2 * (s0**-2 + s1**-2 + s2**-2 - 3)
    return mu * (first + second) - 1.1 * mu * log(s0 * s1 * s2) + lam / 2 * log(s0 * s1 * s2) ** 2


def hencky(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Quadratic in logarithmic strains."""
    return mu * (log(s0) ** 2 + log(s1) ** 2 + log(s2) ** 2) + lam / 2 * log(s0 * s1 * s2) ** 2


def isochoric(s0: Any, s1: Any, s2: Any, mu: Any, lam: Any) -> Any:
    """Exponential in lengths, and the root of areas, both without change of volume."""
    volume = s0 * s1 * s2
    lengths = volume ** (-2 / 3) * (s0**2 + s1**2 + s2**2)
    areas = volume ** (-4 / 3) * ((s0 * s1) ** 2 + (s1 * s2) ** 2 + (s2 * s0) ** 2)
    distortion = 2 * (exp(0.2 * (lengths - 3)) - 1) + 0.6 * (sqrt(areas / 3) - 1)
    return mu * distortion + (lam + 2 / 3 * mu) / 2 * (volume - 1) ** 2


OWN_ENERGIES = {energy.__name__: energy for energy in (gent, ogden, hencky, isochoric)}
