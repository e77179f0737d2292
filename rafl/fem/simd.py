"""Arithmetic on eight doubles at a time, inside compiled kernels.

A cell has eight Gauss points and eight nodes, so its arithmetic falls into rows of eight. LLVM finds
such rows by itself where all indices are constants; where they are not, it must assume that arrays
overlap, and these functions say what is meant. Any processor runs them: where its registers are
narrower LLVM splits the rows.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
KERNEL: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"contract"}}  # options of every kernel
_ROW = ir.VectorType(ir.DoubleType(), LANES)
_FIRST = ir.Constant(ir.IntType(32), 0)
_EVERY_FIRST = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
_CONTRACT = ("contract",)  # a product and a sum may become one instruction


class _Rows:
    """Builds loads and stores of rows of one array argument."""

    def __init__(self, context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> None:
        self.builder = builder
        data = cgutils.create_struct_proxy(array_type)(context, builder, array).data
        self.start = builder.gep(data, [index])

    def _at(self, offset: int) -> Any:
        return self.builder.gep(self.start, [ir.Constant(ir.IntType(64), offset)])

    def load(self, offset: int) -> Any:
        return self.builder.load(self.builder.bitcast(self._at(offset), _ROW.as_pointer()), align=8)

    def spread(self, offset: int) -> Any:
        """One number in all lanes."""
        undefined = ir.Constant(_ROW, ir.Undefined)
        one = self.builder.insert_element(undefined, self.builder.load(self._at(offset)), _FIRST)
        return self.builder.shuffle_vector(one, undefined, _EVERY_FIRST)

    def store(self, value: Any, offset: int) -> None:
        self.builder.store(value, self.builder.bitcast(self._at(offset), _ROW.as_pointer()), align=8)


def _add_product(builder: Any, total: Any, a: Any, b: Any) -> Any:
    product = builder.fmul(a, b, flags=_CONTRACT)
    return product if total is None else builder.fadd(total, product, flags=_CONTRACT)


def _three_arrays(build: Any) -> Any:
    """The compiled function (out, o, a, i, b, j) -> None whose body `build(builder, out, a, b)` writes."""

    @intrinsic
    def function(typing: Any, out: Any, o: Any, a: Any, i: Any, b: Any, j: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            rows = [_Rows(context, builder, kinds[k], args[k], args[k + 1]) for k in (0, 2, 4)]
            build(builder, *rows)
            return context.get_dummy_value()

        return types.void(out, types.intp, a, types.intp, b, types.intp), codegen

    return function


def _sum_of_products(count: int, a_stride: int, b_stride: int, *, spread: bool, add: bool) -> Any:
    def build(builder: Any, out: _Rows, a: _Rows, b: _Rows) -> None:
        total = out.load(0) if add else None
        for m in range(count):
            factor = (a.spread if spread else a.load)(m * a_stride)
            total = _add_product(builder, total, factor, b.load(m * b_stride))
        out.store(total, 0)

    return _three_arrays(build)


def weighted_rows(count: int, weight_stride: int, row_stride: int, *, add: bool = False) -> Any:
    """Compiled (out, o, weights, i, rows, j): out[o:o+8] (+)= sum_m weights[i + m ws] rows[j + m rs: +8]."""
    return _sum_of_products(count, weight_stride, row_stride, spread=True, add=add)


def lane_products(count: int, a_stride: int, b_stride: int) -> Any:
    """Compiled (out, o, a, i, b, j): out[o:o+8] = sum_m a[i + m as: +8] b[j + m bs: +8], lane by lane."""
    return _sum_of_products(count, a_stride, b_stride, spread=False, add=False)


def add_rows(count: int) -> Any:
    """Compiled (out, o, weights, i, rows, j, stride, n).

    For n places, eight at a time and up to seven more: out[o + k] += sum_m weights[i + m] rows[j + m stride + k].
    """

    @intrinsic
    def function(typing: Any, out: Any, o: Any, weights: Any, i: Any, rows: Any, j: Any, stride: Any, n: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            by = _Rows(context, builder, kinds[2], args[2], args[3])
            factors = [by.spread(m) for m in range(count)]
            step, places = ir.Constant(args[7].type, LANES), args[7]
            blocks = builder.sdiv(builder.add(places, ir.Constant(places.type, LANES - 1)), step)
            with cgutils.for_range(builder, blocks) as loop:
                shift = builder.mul(loop.index, step)
                target = _Rows(context, builder, kinds[0], args[0], builder.add(args[1], shift))
                first = _Rows(context, builder, kinds[4], args[4], builder.add(args[5], shift))
                total = target.load(0)
                for factor in factors:
                    total = _add_product(builder, total, factor, first.load(0))
                    first.start = builder.gep(first.start, [args[6]])
                target.store(total, 0)
            return context.get_dummy_value()

        return types.void(out, types.intp, weights, types.intp, rows, types.intp, types.intp, types.intp), codegen

    return function


def transposed_product(count: int) -> Any:
    """Compiled (out, o, a, i, b, j): out (8, 8) += a^T b for a, b (count, 8), all row after row."""

    def build(builder: Any, out: _Rows, a: _Rows, b: _Rows) -> None:
        totals = [out.load(LANES * n) for n in range(LANES)]
        for m in range(count):
            row = b.load(LANES * m)
            for n in range(LANES):
                totals[n] = _add_product(builder, totals[n], a.spread(LANES * m + n), row)
        for n in range(LANES):
            out.store(totals[n], LANES * n)

    return _three_arrays(build)
