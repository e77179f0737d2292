"""Four routines of SciPy's BLAS and LAPACK on parts of larger arrays, in place, without holding the interpreter.

SciPy's own wrappers keep other threads waiting. Matrices are given column after column (Fortran order).
"""

import ctypes
from typing import Any

from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

Array = NDArray[Any]

_name = ctypes.pythonapi.PyCapsule_GetName
_name.restype, _name.argtypes = ctypes.c_char_p, [ctypes.py_object]
_address = ctypes.pythonapi.PyCapsule_GetPointer
_address.restype, _address.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]

_ONE, _MINUS_ONE = (ctypes.byref(ctypes.c_double(value)) for value in (1.0, -1.0))


def _routine(module: Any, name: str, arguments: int) -> Any:
    capsule = module.__pyx_capi__[name]
    address = _address(capsule, _name(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(address)


_potrf = _routine(cython_lapack, "dpotrf", 5)
_trsm = _routine(cython_blas, "dtrsm", 11)
_syrk = _routine(cython_blas, "dsyrk", 10)
_gemm = _routine(cython_blas, "dgemm", 13)


def _int(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))


def _at(array: Array) -> int:
    assert array.flags.f_contiguous
    return array.ctypes.data


def cholesky(a: Array) -> bool:
    """Replace the lower triangle of a (n, n) by its Cholesky factor; False where it has none."""
    info = ctypes.c_int()
    n = len(a)
    _potrf(b"L", _int(n), _at(a), _int(max(n, 1)), ctypes.byref(info))
    return info.value == 0


def solve_triangle(lower: Array, b: Array, *, transposed: bool = False) -> None:
    """Replace b (n, m) by L^-1 b, or by L^-T b; lower (n, n)."""
    _solve(b"L", lower, b, transposed)


def solve_transposed_right(lower: Array, b: Array) -> None:
    """Replace b (m, n) by b L^-T; lower (n, n)."""
    _solve(b"R", lower, b, transposed=True)


def _solve(side: bytes, lower: Array, b: Array, transposed: bool) -> None:
    rows, columns = b.shape
    _trsm(
        side,
        b"L",
        b"T" if transposed else b"N",
        b"N",
        _int(rows),
        _int(columns),
        _ONE,
        _at(lower),
        _int(len(lower)),
        _at(b),
        _int(rows),
    )


def subtract_square(c: Array, a: Array) -> None:
    """Take a a^T from the lower triangle of c (n, n)."""
    n, inner = a.shape
    _syrk(b"L", b"N", _int(n), _int(inner), _MINUS_ONE, _at(a), _int(n), _ONE, _at(c), _int(n))


def subtract_product(c: Array, a: Array, b: Array, *, transposed: bool = False) -> None:
    """Take a b, or a^T b, from c."""
    rows, columns = c.shape
    _gemm(
        b"T" if transposed else b"N",
        b"N",
        _int(rows),
        _int(columns),
        _int(len(b)),
        _MINUS_ONE,
        _at(a),
        _int(a.shape[0]),
        _at(b),
        _int(len(b)),
        _ONE,
        _at(c),
        _int(rows),
    )
