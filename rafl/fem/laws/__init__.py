"""Elastic laws, one per module: energy densities of the principal stretches, linear in mu and lambda.

Each module has `derivatives` for the compiled kernels, `reference_derivatives` on tensors, and `rest_lame`.
"""

from types import ModuleType

from rafl.fem.laws import corotated, neo_hookean, projective

# Kernels identify a law by its index in this order.
LAWS: dict[str, ModuleType] = {"projective": projective, "corotated": corotated, "neo-hookean": neo_hookean}
