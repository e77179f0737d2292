"""SIMD arithmetic on rows of eight doubles, for use inside compiled kernels.

A cell has eight Gauss points and eight nodes, so its arithmetic has rows of eight. LLVM vectorises such rows
by itself only if all indices are constants; otherwise it must assume that arrays overlap. The functions here
emit vector instructions directly. They run on any processor: LLVM splits the rows for narrower registers.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

SIMD_LANES = 8  # doubles in a row
# Options of `numba.njit` for every kernel.
KERNEL_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "fastmath": {"contract"}}
_ROW = ir.VectorType(ir.DoubleType(), SIMD_LANES)
_FIRST_LANE = ir.Constant(ir.IntType(32), 0)
_ALL_FROM_FIRST = ir.Constant(ir.VectorType(ir.IntType(32), SIMD_LANES), None)
_CONTRACT = ("contract",)  # allows one fused instruction for a product and a sum


class _Rows:
    """Emits loads and stores of rows of one array argument."""

    def __init__(self, context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> None:
        self.builder = builder
        data = cgutils.create_struct_proxy(array_type)(context, builder, array).data
        self.start = builder.gep(data, [index])

    def _at(self, offset: int) -> Any:
        return self.builder.gep(self.start, [ir.Constant(ir.IntType(64), offset)])

    def load(self, offset: int) -> Any:
        return self.builder.load(self.builder.bitcast(self._at(offset), _ROW.as_pointer()), align=8)

    def broadcast(self, offset: int) -> Any:
        """Load one number into all SIMD lanes."""
        undefined = ir.Constant(_ROW, ir.Undefined)
        one = self.builder.insert_element(undefined, self.builder.load(self._at(offset)), _FIRST_LANE)
        return self.builder.shuffle_vector(one, undefined, _ALL_FROM_FIRST)

    def store(self, value: Any, offset: int) -> None:
        self.builder.store(value, self.builder.bitcast(self._at(offset), _ROW.as_pointer()), align=8)


def _add_product(builder: Any, total: Any, a: Any, b: Any) -> Any:
    product = builder.fmul(a, b, flags=_CONTRACT)
    return product if total is None else builder.fadd(total, product, flags=_CONTRACT)


def _three_array_function(build: Any) -> Any:
    """Compiled function (out, o, a, i, b, j) -> None with the body that `build(builder, out, a, b)` emits."""

    @intrinsic
    def function(typing: Any, out: Any, o: Any, a: Any, i: Any, b: Any, j: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            rows = [_Rows(context, builder, kinds[k], args[k], args[k + 1]) for k in (0, 2, 4)]
            build(builder, *rows)
            return context.get_dummy_value()

        return types.void(out, types.intp, a, types.intp, b, types.intp), codegen

    return function


def _product_sum(count: int, a_stride: int, b_stride: int, *, broadcast: bool, add: bool) -> Any:
    def build(builder: Any, out: _Rows, a: _Rows, b: _Rows) -> None:
        total = out.load(0) if add else None
        for m in range(count):
            factor = (a.broadcast if broadcast else a.load)(m * a_stride)
            total = _add_product(builder, total, factor, b.load(m * b_stride))
        out.store(total, 0)

    return _three_array_function(build)


def weighted_rows(count: int, weight_stride: int, row_stride: int, *, add: bool = False) -> Any:
    """Compiled function (out, o, weights, i, rows, j): a weighted sum of rows.

    With sw = weight_stride, sr = row_stride and m < count, out[o:o+8] = sum_m weights[i + m sw] rows[j + m sr: +8].
    `add` adds the sum to out instead.
    """
    return _product_sum(count, weight_stride, row_stride, broadcast=True, add=add)


def lane_products(count: int, a_stride: int, b_stride: int) -> Any:
    """Compiled function (out, o, a, i, b, j): a sum of elementwise products of rows.

    With sa = a_stride, sb = b_stride and m < count, out[o:o+8] = sum_m a[i + m sa: +8] * b[j + m sb: +8].
    """
    return _product_sum(count, a_stride, b_stride, broadcast=False, add=False)


def add_weighted_vectors(count: int) -> Any:
    """Compiled function (out, o, weights, i, rows, j, stride, n): add a weighted sum of vectors.

    For m < count and k < n: out[o + k] += sum_m weights[i + m] rows[j + m stride + k]. It works on blocks of
    eight, so it also updates up to seven elements past n.
    """

    @intrinsic
    def function(typing: Any, out: Any, o: Any, weights: Any, i: Any, rows: Any, j: Any, stride: Any, n: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            weight = _Rows(context, builder, kinds[2], args[2], args[3])
            factors = [weight.broadcast(m) for m in range(count)]
            step, elements = ir.Constant(args[7].type, SIMD_LANES), args[7]
            blocks = builder.sdiv(builder.add(elements, ir.Constant(elements.type, SIMD_LANES - 1)), step)
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
    """Compiled function (out, o, a, i, b, j): out (8, 8) += a^T b for a, b (count, 8), all in row-major order."""

    def build(builder: Any, out: _Rows, a: _Rows, b: _Rows) -> None:
        totals = [out.load(SIMD_LANES * n) for n in range(SIMD_LANES)]
        for m in range(count):
            row = b.load(SIMD_LANES * m)
            for n in range(SIMD_LANES):
                totals[n] = _add_product(builder, totals[n], a.broadcast(SIMD_LANES * m + n), row)
        for n in range(SIMD_LANES):
            out.store(totals[n], SIMD_LANES * n)

    return _three_array_function(build)
