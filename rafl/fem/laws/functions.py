"""Functions of the energies of elastic laws. They take what an energy is called with: symbols of sympy."""

from typing import Any

# sympy is imported when a function is called, so that commands that build no law start without it.


def log(x: Any) -> Any:
    """Natural logarithm."""
    import sympy

    return sympy.log(x)


def exp(x: Any) -> Any:
    """Exponential function."""
    import sympy

    return sympy.exp(x)


def sqrt(x: Any) -> Any:
    """Square root."""
    import sympy

    return sympy.sqrt(x)
