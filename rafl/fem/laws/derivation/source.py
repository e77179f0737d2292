"""A law's derivatives as the text of a Python module, for numba's kernels and on tensors."""

from typing import Any

import sympy as sp
from sympy import Expr
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter

from rafl.fem.laws.derivation.derivatives import Derivatives
from rafl.fem.laws.derivation.expansion import STRAINS, STRETCHES

MODULE = '''"""Derivatives of the elastic law {name}; not to be edited.

`rafl.fem.laws.derivation` has computed them. {origin}
"""

{numpy}import torch

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH


def rest_lame(mu, lam):
    """Lame parameters of the law's linearisation at rest."""
    return {rest_mu}, {rest_lam}


def derivatives(w, mu, lam):
    """Fill ENERGY, FIRST, SECOND and FLIP from the stretches; see `rafl.fem.kernel_layout`."""
    for g in range(8):
{kernel}


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
{tensors}
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
'''
SECOND_NAMES = ("00", "11", "22", "01", "12", "20")
RESULTS = ("psi", *(f"psi_{k}" for k in "012"), *(f"psi_{k}" for k in SECOND_NAMES), "flip_01", "flip_12", "flip_20")
ROWS = ("ENERGY", "FIRST", "SECOND", "FLIP")
SETTINGS = {"fully_qualified_modules": False}
FIRST_ROWS = (0, 1, 4, 10)  # of these blocks in RESULTS


class _Printer(PythonCodePrinter):  # type: ignore[misc]  # sympy has no types
    """Prints numbers as floats, functions as those of numpy."""

    library = "np"

    def parenthesize(self, item: Any, level: int, strict: bool = False) -> str:
        if item.is_Rational and item > 0:
            return self._print_Rational(item)
        return str(super().parenthesize(item, level, strict))

    def _print_Rational(self, expr: Any) -> str:
        return repr(float(expr))

    _print_Integer = _print_One = _print_NegativeOne = _print_Zero = _print_Half = _print_Rational

    def _print_Pow(self, expr: Any, rational: bool = False, sqrt: str = "") -> str:
        base, exponent = expr.args
        if expr.is_number:
            return repr(float(expr))
        if exponent.is_Rational and exponent < 0:
            return f"1.0 / {self.parenthesize(base**-exponent, PRECEDENCE['Mul'])}"
        if exponent == sp.S.Half:
            return f"{self.library}.sqrt({self._print(base)})"
        power = str(exponent) if exponent.is_Integer else self.parenthesize(exponent, PRECEDENCE["Atom"], True)
        return f"{self.parenthesize(base, PRECEDENCE['Atom'], True)} ** {power}"

    def _print_function(self, expr: Any) -> str:
        if expr.is_number:
            return repr(float(expr))
        name = {sp.Abs: "abs"}.get(type(expr), type(expr).__name__)
        return f"{self.library}.{name}({', '.join(map(self._print, expr.args))})"

    _print_log = _print_exp = _print_log1p = _print_expm1 = _print_Abs = _print_function

    def _print_Piecewise(self, expr: Any) -> str:
        (near, condition), (other, _) = expr.args
        return f"({self._print(near)} if {self._print(condition)} else {self._print(other)})"


class _TensorPrinter(_Printer):
    """Prints functions as those of torch."""

    library = "torch"

    def _print_Piecewise(self, expr: Any) -> str:
        (near, condition), (other, _) = expr.args
        return f"torch.where({self._print(condition)}, {self._print(near)}, {self._print(other)})"


def module_source(name: str, derivatives: Derivatives, origin: str) -> str:
    """Text of the module of a law.

    Args:
        name: of the law.
        derivatives: of its energy.
        origin: sentence on where the energy is from.
    """
    statements = _statements(derivatives)
    scalar, tensor = _Printer(SETTINGS), _TensorPrinter(SETTINGS)
    rest_mu, rest_lam = (scalar.doprint(x) for x in derivatives.rest_lame)
    loads = [(str(s), f"w[{_row('STRETCH', k)} * 8 + g]") for k, s in enumerate(STRETCHES)]
    rows = loads + [(_target(left), scalar.doprint(right)) for left, right in statements]
    tensors = [(left, tensor.doprint(right)) for left, right in statements]
    kernel = "\n".join(f"        {left} = {right}" for left, right in rows)
    return MODULE.format(
        name=name,
        origin=origin,
        rest_mu=rest_mu,
        rest_lam=rest_lam,
        numpy="import numpy as np\n" if "np." in kernel else "",
        kernel=kernel,
        tensors="\n".join(f"    {left} = {right}" for left, right in tensors),
    )


def _statements(derivatives: Derivatives) -> list[tuple[str, Expr]]:
    """Assignments in order, with common subexpressions taken out; names and values of `RESULTS` among them."""
    statements = [(str(e), s - 1) for s, e in zip(STRETCHES, STRAINS, strict=True)]
    statements += [(str(p), polynomial) for p, polynomial in derivatives.invariants.items()]
    values = [derivatives.energy, *derivatives.first, *derivatives.second, *derivatives.flip]
    common, values = sp.cse(values, symbols=sp.numbered_symbols("t"), order="canonical")
    return statements + [(str(t), value) for t, value in common] + list(zip(RESULTS, values, strict=True))


def _row(block: str, k: int) -> str:
    return f"({block} + {k})" if k else block


def _target(name: str) -> str:
    """Where the kernel puts a value: a row of the scratch for a result, else a variable."""
    if name not in RESULTS:
        return name
    number = RESULTS.index(name)
    first = max(k for k in FIRST_ROWS if k <= number)
    return f"w[{_row(ROWS[FIRST_ROWS.index(first)], number - first)} * 8 + g]"
