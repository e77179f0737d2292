"""Elastic laws, one a file: energy densities of the principal stretches, linear in mu and lambda.

Each has `derivatives` for the kernels, `plain_derivatives` in tensors, and `rest_lame`.
"""

from types import ModuleType

from rafl.fem.laws import corotated, neo_hookean, projective

# In the order of the numbers that kernels know them by.
LAWS: dict[str, ModuleType] = {"projective": projective, "corotated": corotated, "neo-hookean": neo_hookean}
