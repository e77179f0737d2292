"""Calls of a law's derivatives from compiled kernels, which are the same for every law."""

from typing import Any

from numba import types
from numba.extending import intrinsic

# Of derivatives(w, mu, lam); see `rafl.fem.kernel_layout`.
KERNEL_SIGNATURE = types.void(types.float64[::1], types.float64, types.float64)


def _fill_derivatives(typing: Any, address: Any, w: Any, mu: Any, lam: Any) -> Any:
    """Call the compiled derivatives of a law at an address, as numba calls a function that is an argument.

    A function as an argument would take 30 us to unpack whenever Python calls the kernel; an address takes none.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        prototype = context.get_value_type(types.FunctionType(KERNEL_SIGNATURE).ftype)
        builder.call(builder.inttoptr(args[0], prototype), args[1:])
        return context.get_dummy_value()

    return types.void(types.intp, *KERNEL_SIGNATURE.args), codegen


# Compiled function (address, w, mu, lam).
fill_derivatives: Any = intrinsic(_fill_derivatives)
