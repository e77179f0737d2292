"""Expansion of an elastic energy about rest, in symmetric polynomials of the stretches, with sympy.

An energy of a strain e is of the order e^2, the difference of numbers of the order 1. An `Expansion` cancels the
numbers exactly and keeps the rest in a form that floating-point numbers can compute.
"""

from dataclasses import dataclass

import sympy as sp
from sympy import Expr
from sympy.codegen.cfunctions import expm1, log1p

STRETCHES = sp.symbols("s0 s1 s2")
STRAINS = sp.symbols("e0 e1 e2")  # stretch minus 1
DIGITS = 40
IN_STRAINS = {s: 1 + e for s, e in zip(STRETCHES, STRAINS, strict=True)}


class NotSymmetricError(Exception):
    """An expression is no function of symmetric polynomials."""


@dataclass(frozen=True)
class Expansion:
    """A function of invariants that vanish at rest: constant + linear + remainder.

    Attributes:
        plain: the function as written.
        constant: its value at rest.
        linear: its part of first order, a sum of multiples of invariants.
        remainder: the rest, written so that it loses at most the rounding error times a strain to cancellation.
    """

    plain: Expr
    constant: Expr
    linear: Expr = sp.S.Zero
    remainder: Expr = sp.S.Zero

    @classmethod
    def zero(cls) -> "Expansion":
        """The function 0."""
        return cls(sp.S.Zero, sp.S.Zero)

    @property
    def deviation(self) -> Expr:
        """The function less its value at rest."""
        return self.linear + self.remainder

    def __add__(self, other: "Expansion") -> "Expansion":
        return Expansion(
            self.plain + other.plain,
            self.constant + other.constant,
            self.linear + other.linear,
            self.remainder + other.remainder,
        )

    def __mul__(self, other: "Expansion") -> "Expansion":
        return Expansion(
            self.plain * other.plain,
            self.constant * other.constant,
            self.constant * other.linear + other.constant * self.linear,
            self.constant * other.remainder + other.constant * self.remainder + self.deviation * other.deviation,
        )

    def times(self, factor: Expr) -> "Expansion":
        """The function times a factor that does not depend on the stretches."""
        return self * Expansion(factor, factor)

    def _applied(self, plain: Expr, value: Expr, slope: Expr, curved: Expr) -> "Expansion":
        """plain = value + slope * deviation + curved."""
        return Expansion(plain, value, slope * self.linear, slope * self.remainder + curved)

    def power(self, n: Expr) -> "Expansion":
        """The function to the power n, a number.

        Raises:
            ValueError: a zero at rest, to a power that is not smooth there.
        """
        c, d = self.constant, self.deviation
        if n.is_Integer and n > 0:
            curved = sum(sp.binomial(n, k) * c ** (n - k) * d**k for k in range(2, int(n) + 1))
            return self._applied(self.plain**n, c**n, n * c ** (n - 1), curved)
        if c == 0 or (c < 0 and not n.is_Integer):
            raise ValueError(f"expected an energy that is smooth at rest, got the base {c} of the power {n} there")
        if n == -1:
            return self._applied(1 / self.plain, 1 / c, -1 / c**2, d**2 / (c**2 * (c + d)))
        if n.is_Integer:
            return self.power(sp.Integer(-1)).power(-n)
        if n == sp.Rational(1, 2):
            root = sp.sqrt(c)
            curved = -(d**2) / (2 * root * (root + sp.sqrt(c + d)) ** 2)
            return self._applied(sp.sqrt(self.plain), root, 1 / (2 * root), curved)
        # sympy would look for roots of fractions with long numerators.
        value = sp.S.One if c == 1 else sp.Float(c, DIGITS) ** sp.Float(n, DIGITS)
        curved = value * (expm1(n * log1p(d / c)) - n * d / c)
        return self._applied(self.plain**n, value, value * n / c, curved)

    def log(self) -> "Expansion":
        """Natural logarithm of the function.

        Raises:
            ValueError: it is not defined at rest.
        """
        c, d = self.constant, self.deviation
        if not c > 0:
            raise ValueError(f"expected an energy that is smooth at rest, got the logarithm of {c} there")
        return self._applied(sp.log(self.plain), sp.log(c), 1 / c, log1p(d / c) - d / c)

    def exp(self) -> "Expansion":
        """Exponential of the function."""
        c, d = self.constant, self.deviation
        return self._applied(sp.exp(self.plain), sp.exp(c), sp.exp(c), sp.exp(c) * (expm1(d) - d))


class Invariants:
    """Symmetric polynomials of the stretches, each zero at rest, in the order in which they were first needed.

    Attributes:
        polynomials: in the strains, by symbol.
    """

    def __init__(self) -> None:
        self.polynomials: dict[sp.Symbol, Expr] = {}

    def expansion(self, polynomial: Expr) -> Expansion:
        """Expansion of a symmetric polynomial of the stretches.

        Raises:
            NotSymmetricError: it is not symmetric, or no polynomial.
        """
        if not polynomial.is_polynomial(*STRETCHES) or not is_symmetric_polynomial(polynomial):
            raise NotSymmetricError
        expanded = sp.expand(polynomial.subs(IN_STRAINS, simultaneous=True))
        constant = expanded.subs(dict.fromkeys(STRAINS, 0))
        if expanded == constant:
            return Expansion(constant, constant)
        factor, primitive = sp.Poly(expanded - constant, *STRAINS).primitive()
        if primitive.LC() < 0:
            factor, primitive = -factor, -primitive
        linear = factor * self._symbol(primitive.as_expr())
        return Expansion(constant + linear, constant, linear)

    def _symbol(self, polynomial: Expr) -> sp.Symbol:
        for symbol, known in self.polynomials.items():
            if known == polynomial:
                return symbol
        symbol = sp.Symbol(f"p{len(self.polynomials)}")
        self.polynomials[symbol] = polynomial
        return symbol


def is_symmetric_polynomial(polynomial: Expr) -> bool:
    """Whether a polynomial of the stretches stays the same under permutations of them."""
    return all(sp.expand(polynomial - exchanged(polynomial, i, i + 1)) == 0 for i in (0, 1))


def exchanged(expression: Expr, i: int, j: int) -> Expr:
    """The expression with two stretches, and their strains, exchanged."""
    swap = {x[i]: x[j] for x in (STRETCHES, STRAINS)} | {x[j]: x[i] for x in (STRETCHES, STRAINS)}
    return expression.subs(swap, simultaneous=True)


def in_invariants(expression: Expr, invariants: Invariants) -> tuple[Expansion, Expr]:
    """Expansion of the part of an expression that is a function of symmetric polynomials, and the other part."""
    total, other = Expansion.zero(), sp.S.Zero
    pooled = sp.S.Zero
    for term in sp.Add.make_args(expression):
        try:
            total += _expansion(term, invariants)
        except NotSymmetricError:
            pooled += term
    if pooled != 0:
        try:
            total += _rational(pooled, invariants)
        except NotSymmetricError:
            other = pooled
    return total, other


def in_strains(expression: Expr) -> Expansion:
    """Expansion of any expression of the stretches; its invariants are the strains themselves."""
    if not expression.has(*STRETCHES):
        return Expansion(expression, expression)
    if expression in IN_STRAINS:
        return Expansion(expression, sp.S.One, IN_STRAINS[expression] - 1)
    parts = [in_strains(part) for part in expression.args]
    return _combined(expression, parts)


def _expansion(expression: Expr, invariants: Invariants) -> Expansion:
    """Expansion of an expression in invariants, as close to the way it is written as possible.

    Raises:
        NotSymmetricError: it is no function of symmetric polynomials.
    """
    if not expression.has(*STRETCHES):
        return Expansion(expression, expression)
    if expression.is_Add:
        found, other = in_invariants(expression, invariants)
        if other != 0:
            raise NotSymmetricError
        return found
    if expression.is_Mul:
        result, pooled = Expansion(sp.S.One, sp.S.One), sp.S.One
        for factor in expression.args:
            try:
                result *= _expansion(factor, invariants)
            except NotSymmetricError:
                pooled *= factor
        return result if pooled == 1 else result * _rational(pooled, invariants)
    if expression.is_Symbol:
        raise NotSymmetricError
    return _combined(expression, [_expansion(part, invariants) for part in expression.args])


def _combined(expression: Expr, parts: list[Expansion]) -> Expansion:
    """Expansion of an expression from those of its arguments."""
    if expression.is_Add or expression.is_Mul:
        total = parts[0]
        for part in parts[1:]:
            total = total + part if expression.is_Add else total * part
        return total
    if expression.is_Pow and not parts[1].deviation:
        return parts[0].power(parts[1].constant)
    if expression.is_Pow:
        return (parts[0].log() * parts[1]).exp()
    if isinstance(expression, sp.log) and len(parts) == 1:
        return parts[0].log()
    if isinstance(expression, sp.exp):
        return parts[0].exp()
    raise ValueError(f"expected an energy of + - * / **, log, exp and sqrt, got {expression.func} in it")


def _rational(expression: Expr, invariants: Invariants) -> Expansion:
    """Expansion of a quotient of symmetric polynomials.

    Raises:
        NotSymmetricError: it is none.
    """
    if not expression.is_rational_function(*STRETCHES):
        raise NotSymmetricError
    above, below = sp.fraction(sp.cancel(sp.together(expression)))
    quotient = invariants.expansion(above)
    return quotient if below == 1 else quotient * invariants.expansion(below).power(sp.Integer(-1))
