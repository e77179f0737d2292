"""The energy of a law as a sympy expression, and what an energy must fulfil."""

import math
from collections.abc import Sequence
from fractions import Fraction

import mpmath
import sympy as sp
from sympy import Expr

from rafl.fem.laws.derivation.expansion import STRETCHES, exchanged
from rafl.fem.laws.law import Energy

MU, LAM = sp.symbols("mu lam")
AT_REST = (1.0, 1.0, 1.0)
# Largest deviation, relative to the moduli at rest, that rounded constants of an energy may cause.
ROUNDING = 1e-12
SYMMETRY_POINTS = ((1.03, 0.98, 1.01), (0.97, 1.05, 1.02))  # stretches without a symmetry of their own


def symbolic_energy(energy: Energy) -> Expr:
    """The energy as an expression of `STRETCHES`, `MU` and `LAM`; its decimal numbers are exact fractions.

    Raises:
        ValueError: the function does not compute with symbols.
    """
    s0, s1, s2 = STRETCHES
    try:
        psi = sp.sympify(energy(s0, s1, s2, MU, LAM))
    except Exception as error:
        raise ValueError(
            "expected an energy(s0, s1, s2, mu, lam) of + - * / ** and log, exp, sqrt of rafl.fem.laws, "
            f"which can be called with symbols; got {type(error).__name__}: {error}"
        ) from error
    if not isinstance(psi, Expr) or psi.free_symbols - {*STRETCHES, MU, LAM}:
        raise ValueError(f"expected an energy of s0, s1, s2, mu and lam only, got {psi}")
    return psi.xreplace({number: _fraction(float(number)) for number in psi.atoms(sp.Float)})


def _fraction(number: float) -> Expr:
    """The simple fraction whose nearest float this is, else the number's decimals."""
    simple = Fraction(number).limit_denominator(1000)
    return sp.Rational(simple) if float(simple) == number else sp.Rational(repr(number))


def coefficients(psi: Expr) -> tuple[Expr, Expr]:
    """The factors a, b of psi = a mu + b lam.

    Raises:
        ValueError: psi is not linear in mu and lam, not symmetric, or not zero with zero slope at rest.
    """
    a, b = psi.diff(MU), psi.diff(LAM)
    if (a.free_symbols | b.free_symbols) & {MU, LAM}:
        a, b = sp.simplify(a), sp.simplify(b)
    constant = psi.subs({MU: 0, LAM: 0})
    if (a.free_symbols | b.free_symbols) & {MU, LAM} or sp.simplify(constant) != 0:
        raise ValueError(f"expected an energy that is linear in mu and lam, got {psi}")
    for factor, name in ((a, "mu"), (b, "lam")):
        _check_symmetry(factor, name)
        scale = max(1.0, *(abs(_at_rest(factor.diff(STRETCHES[0], s))) for s in STRETCHES))
        for value, kind in ((_at_rest(factor), "energy"), (_at_rest(factor.diff(STRETCHES[0])), "stress")):
            if not abs(value) <= ROUNDING * scale:
                raise ValueError(f"expected no {kind} at rest (s0 = s1 = s2 = 1), got {value:g} {name}")
    return a, b


def rest_lame(psi: Expr) -> tuple[Expr, Expr]:
    """Lame parameters of the linearisation at rest, from psi_ij = lam_0 (i != j) and psi_ii = 2 mu_0 + lam_0.

    A symmetric energy always has an isotropic linearisation.

    Raises:
        ValueError: its shear modulus does not grow with mu.
    """
    s0, s1, _ = STRETCHES
    found = []
    for factor in coefficients(psi):
        lam = _at_rest(factor.diff(s0, s1))
        found.append([(_at_rest(factor.diff(s0, 2)) - lam) / 2, lam])
    if not found[0][0] > 0:
        raise ValueError(f"expected a shear modulus at rest that grows with mu, got {found[0][0]:g} mu")
    by_mu, by_lam = ([_rounded(number) for number in numbers] for numbers in found)
    return MU * by_mu[0] + LAM * by_lam[0], MU * by_mu[1] + LAM * by_lam[1]


def _rounded(number: float) -> Expr:
    """A simple fraction if the number differs from one by rounding only, else the number."""
    simple = Fraction(number).limit_denominator(1000)
    return sp.Rational(simple) if abs(float(simple) - number) <= ROUNDING else sp.Float(number)


def _at_rest(expression: Expr) -> float:
    value = _value(expression, AT_REST)
    if not math.isfinite(value):
        raise ValueError(f"expected an energy that is smooth at rest, got {value} there for {expression}")
    return value


def _value(expression: Expr, stretches: Sequence[float]) -> float:
    """Value at stretches, accurate to a float; NaN where the expression has none, or a complex one."""
    with mpmath.workdps(40):
        try:
            return float(sp.lambdify(STRETCHES, expression, "mpmath")(*map(mpmath.mpf, stretches)))
        except (ZeroDivisionError, ValueError, TypeError):
            return math.nan


def _check_symmetry(factor: Expr, name: str) -> None:
    """Compare the values at some stretches, in any order.

    Raises:
        ValueError: they differ.
    """
    for point in SYMMETRY_POINTS:
        value = _value(factor, point)
        for i in (0, 1):
            other = _value(exchanged(factor, i, i + 1), point)
            if not abs(value - other) <= ROUNDING * (1 + abs(value)):
                raise ValueError(
                    f"expected an energy that stays the same if s{i} and s{i + 1} are exchanged, "
                    f"got {value:.6g} and {other:.6g} (times {name}) at the stretches {point}"
                )
