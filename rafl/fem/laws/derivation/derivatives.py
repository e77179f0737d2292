"""Derivatives of an energy by the principal stretches, exact where they would be quotients of small differences.

The energy is written as psi = q(s) + h(p_0, p_1, ...), where q and the p_k are symmetric polynomials of the stretches.
With d_ij q = (q_i - q_j) / (s_i - s_j), which is a polynomial too,

    psi_i  = q_i + sum_k h_k p_k,i
    psi_ij = q_ij + sum_kl h_kl p_k,i p_l,j + sum_k h_k p_k,ij
    flip   = d_ij q + sum_k h_k d_ij p_k.

A part of the energy that is no function of symmetric polynomials, such as a sum of powers s_i^a, has no such form. Its
flip is half the mean of psi_ii - 2 psi_ij + psi_jj over -1 < t < 1 at the stretches m +- t (s_i - s_j) / 2,
m = (s_i + s_j) / 2. If |s_i - s_j| <= NEAR |m|, two Gauss points give that mean with a relative error of the order
(NEAR / 2)^4; otherwise the quotient is computed, with a rounding error of the order 1e-16 / NEAR.
"""

from dataclasses import dataclass

import sympy as sp
from sympy import Expr

from rafl.fem.laws.derivation.energy import LAM, MU, coefficients, rest_lame
from rafl.fem.laws.derivation.expansion import STRAINS, STRETCHES, Expansion, Invariants, in_invariants, in_strains

NEAR = 1e-3
PAIRS = ((0, 1), (1, 2), (2, 0))
SECOND_PAIRS = ((0, 0), (1, 1), (2, 2), *PAIRS)
IN_STRETCHES = {e: s - 1 for s, e in zip(STRETCHES, STRAINS, strict=True)}


@dataclass(frozen=True)
class Derivatives:
    """Expressions of the stretches, the strains e = s - 1, mu, lam and the invariants.

    Attributes:
        invariants: polynomials in the strains, by symbol.
        energy: psi.
        first: psi_i, (3).
        second: psi_ij in the order 00 11 22 01 12 20, (6).
        flip: (psi_i - psi_j) / (s_i - s_j) of the pairs 01 12 20, (3).
        rest_lame: mu and lambda of the linearisation at rest.
    """

    invariants: dict[sp.Symbol, Expr]
    energy: Expr
    first: list[Expr]
    second: list[Expr]
    flip: list[Expr]
    rest_lame: tuple[Expr, Expr]


def derive(psi: Expr) -> Derivatives:
    """Derivatives of an energy.

    Raises:
        ValueError: the energy is not admissible; see `rafl.fem.laws.derivation.energy`.
    """
    invariants = Invariants()
    symmetric, separate = Expansion.zero(), Expansion.zero()
    for modulus, factor in zip((MU, LAM), coefficients(psi), strict=True):
        part, other = in_invariants(factor, invariants)
        symmetric += part.times(modulus)
        separate += in_strains(other).times(modulus)
    q = _second_order(symmetric.linear.subs(invariants.polynomials) + separate.linear)
    h = _collected(symmetric.plain - symmetric.constant - symmetric.linear)
    g = separate.plain - separate.constant - separate.linear
    used = {p: polynomial for p, polynomial in invariants.polynomials.items() if h.has(p)}
    first = [
        _derivative(q + g, i) + sum(h.diff(p) * _factored(_derivative(x, i)) for p, x in used.items()) for i in range(3)
    ]
    second = [
        _derivative(q + g, i, j)
        + sum(
            h.diff(p, r) * _factored(_derivative(x, i)) * _factored(_derivative(y, j))
            for p, x in used.items()
            for r, y in used.items()
        )
        + sum(h.diff(p) * _factored(_derivative(x, i, j)) for p, x in used.items())
        for i, j in SECOND_PAIRS
    ]
    flip = [
        sum((m * _divided_difference(q.coeff(m), i, j) for m in (MU, LAM)), _separate_flip(g, i, j))
        + sum(h.diff(p) * _factored(_divided_difference(x, i, j)) for p, x in used.items())
        for i, j in PAIRS
    ]
    energy = q + _collected(symmetric.remainder) + separate.remainder
    return Derivatives(used, energy, first, second, flip, rest_lame(psi))


def _derivative(expression: Expr, *stretches: int) -> Expr:
    """Derivative of an expression of stretches and strains by the stretches of these indices."""
    for i in stretches:
        expression = expression.diff(STRETCHES[i]) + expression.diff(STRAINS[i])
    return expression


def _second_order(polynomial: Expr) -> Expr:
    """Terms of second and higher order in the strains, as mu a + lam b.

    The terms of first order are zero but for rounded constants of the energy, which `coefficients` has judged.
    """
    total = sp.S.Zero
    for modulus in (MU, LAM):
        terms = sp.Poly(sp.expand(polynomial).coeff(modulus), *STRAINS).terms()
        kept = {powers: factor for powers, factor in terms if sum(powers) > 1}
        total += modulus * sp.Poly(kept or {(0, 0, 0): 0}, *STRAINS).as_expr()
    return total


def _collected(expression: Expr) -> Expr:
    """The expression with its terms sorted by what they hold besides mu and lam."""
    factors: dict[Expr, Expr] = {}
    for term in sp.Add.make_args(sp.expand_mul(expression)):
        modulus, rest = term.as_independent(*(term.free_symbols - {MU, LAM}), as_Add=False)
        factors[rest] = factors.get(rest, sp.S.Zero) + modulus
    return sp.Add(*(factor * rest for rest, factor in factors.items()))


def _factored(polynomial: Expr) -> Expr:
    """A polynomial in the strains as a product of polynomials in the stretches."""
    return sp.factor(polynomial.subs(IN_STRETCHES, simultaneous=True))


def _divided_difference(polynomial: Expr, i: int, j: int) -> Expr:
    """(p_i - p_j) / (s_i - s_j) of a symmetric polynomial in the strains."""
    e = STRAINS
    return sp.cancel((polynomial.diff(e[i]) - polynomial.diff(e[j])) / (e[i] - e[j]))


def _separate_flip(g: Expr, i: int, j: int) -> Expr:
    """(g_i - g_j) / (s_i - s_j) of any symmetric function; see the top of this file."""
    if g == 0:
        return sp.S.Zero
    si, sj = STRETCHES[i], STRETCHES[j]
    gap, mean = si - sj, (si + sj) / 2
    shift = gap / (2 * sp.sqrt(3))
    curvature = _derivative(g, i, i) - 2 * _derivative(g, i, j) + _derivative(g, j, j)
    near = curvature.subs({si: mean + shift, sj: mean - shift}, simultaneous=True) / 2
    is_near = sp.Abs(gap) <= sp.Rational(str(NEAR)) * sp.Abs(mean)
    return sp.Piecewise((near, is_near), ((_derivative(g, i) - _derivative(g, j)) / gap, True))
