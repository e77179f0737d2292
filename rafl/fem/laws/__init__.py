"""Elastic laws, one per module: energy densities of the principal stretches, linear in mu and lambda.

A law is one function, its energy. `rafl.fem.laws.derivation` computes the derivatives from it; those of the laws here
are kept in `generated`. The projective law is written by hand, because its energy has no closed form.
"""

import re
from importlib import import_module
from types import ModuleType

from rafl.fem.laws import corotated, mooney_rivlin, neo_hookean, projective, yeoh
from rafl.fem.laws.functions import exp, log, sqrt
from rafl.fem.laws.law import Energy, Law

__all__ = ["BUILT_IN", "ENERGIES", "LAWS", "Law", "exp", "log", "register_law", "sqrt"]

# Modules with an energy, by the name of the law.
ENERGIES: dict[str, ModuleType] = {
    "corotated": corotated,
    "neo-hookean": neo_hookean,
    "yeoh": yeoh,
    "mooney-rivlin": mooney_rivlin,
}


def _built_in(name: str, module: ModuleType) -> Law:
    """The law of a module here. Its derivatives are computed only if `make laws` has not written them yet."""
    package, _, stem = module.__name__.rpartition(".")
    try:
        return Law.of_module(name, import_module(f"{package}.generated.{stem}"))
    except ModuleNotFoundError:
        return Law.of_energy(name, module.energy)


LAWS: dict[str, Law] = {"projective": Law.of_module("projective", projective)}
LAWS |= {name: _built_in(name, module) for name, module in ENERGIES.items()}
BUILT_IN = tuple(LAWS)


def register_law(name: str, energy: Energy) -> Law:
    """Register an elastic law of your own. `Material(law=name)` then works like one of the package's.

    Args:
        name: of the law, as in a material: letters, digits and - _ .
        energy: function (s0, s1, s2, mu, lam) of the principal stretches and the Lame parameters [Pa] that returns the
            energy density [Pa]. It is called once, with symbols, and may use + - * / ** and log, exp and sqrt of
            `rafl.fem.laws`. It must stay the same if stretches are exchanged, be linear in mu and lam, be smooth at
            rest (all stretches 1) and have neither energy nor slope there. For E and nu of a material to be those of
            small strains, mu and lam must be the Lame parameters at rest; `rest_lame` of the result tells.

    A law of the same name is replaced, unless it is one of the package's. Register a law in each program that uses it:
    files store its name only. The first call with an energy takes some seconds to compute its derivatives; they are
    kept, compiled, in numba's cache folder.

    Where an energy is not defined, for instance log(s0 * s1 * s2) in an inverted cell, the solver shortens its steps.
    If a time step begins there, it raises a SimulationError. Powers of (s0 * s1 * s2 - 1) are defined everywhere.

    Raises:
        ValueError: the name is that of a law of the package, or the energy is not admissible; says why.
    """
    if name in BUILT_IN or not re.fullmatch(r"[\w.-]+", name):
        raise ValueError(
            f"expected a name of letters, digits and - _ . that is none of {', '.join(BUILT_IN)}, got {name!r}; "
            "choose another"
        )
    LAWS[name] = Law.of_energy(name, energy)
    return LAWS[name]
