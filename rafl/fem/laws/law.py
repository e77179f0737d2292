"""Elastic laws: isotropic energy densities of the principal stretches, linear in mu and lambda."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

from numba import cfunc
from torch import Tensor

from rafl.fem.laws.kernel import KERNEL_SIGNATURE
from rafl.fem.simd import KERNEL_OPTIONS

Energy = Callable[[Any, Any, Any, Any, Any], Any]  # psi(s0, s1, s2, mu, lam)


@dataclass(frozen=True, eq=False)
class Law:
    """An elastic law.

    Attributes:
        name: of the law.
        derivatives: function (w, mu, lam) that numba compiles. It fills ENERGY, FIRST, SECOND and FLIP of the scratch
            from the stretches; see `rafl.fem.kernel_layout`.
        reference_derivatives: the same on tensors: stretches s (..., 3), mu and lambda (...) [Pa] give the energy
            (...), first derivatives (..., 3), second derivatives (..., 3, 3) and flips (..., 3) [Pa].
        rest_lame: function of mu and lambda that gives those of the linearisation at rest.
    """

    name: str
    derivatives: Callable[[Any, Any, Any], None]
    reference_derivatives: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
    rest_lame: Callable[[Any, Any], tuple[Any, Any]]

    @classmethod
    def of_module(cls, name: str, module: ModuleType) -> "Law":
        """Law with the functions of a module."""
        return cls(name, module.derivatives, module.reference_derivatives, module.rest_lame)

    @classmethod
    def of_energy(cls, name: str, energy: Energy) -> "Law":
        """Law with an energy; see `rafl.register_law`.

        Raises:
            ValueError: the energy is not admissible; says why.
        """
        from rafl.fem.laws.derivation.module import derivatives_module  # imports sympy, which takes a second

        return cls.of_module(name, derivatives_module(name, energy))

    @cached_property
    def kernel(self) -> Any:
        """`derivatives`, compiled: numba's object, which must be kept as long as its `address` is in use."""
        # numba's cache needs a source file, which a law has unless no folder is writable.
        cached = Path(self.derivatives.__code__.co_filename).exists()
        return cfunc(KERNEL_SIGNATURE, **(KERNEL_OPTIONS | {"cache": cached}))(self.derivatives)
