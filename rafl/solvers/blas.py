"""Four routines of SciPy's BLAS and LAPACK, in place on parts of larger arrays and without the interpreter lock.

SciPy's own wrappers hold the lock, so other threads wait. Matrices are in Fortran order (column-major).
"""

import ctypes
from typing import Any

from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

Array = NDArray[Any]

_capsule_name = ctypes.pythonapi.PyCapsule_GetName
_capsule_name.restype, _capsule_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
_capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_capsule_pointer.restype, _capsule_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]

_ONE, _MINUS_ONE = (ctypes.byref(ctypes.c_double(value)) for value in (1.0, -1.0))


def _routine(module: Any, name: str, arguments: int) -> Any:
    """The function `name` of a Cython module, callable with `arguments` pointers."""
    capsule = module.__pyx_capi__[name]
    address = _capsule_pointer(capsule, _capsule_name(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(address)


_potrf = _routine(cython_lapack, "dpotrf", 5)
_trsm = _routine(cython_blas, "dtrsm", 11)
_syrk = _routine(cython_blas, "dsyrk", 10)
_gemm = _routine(cython_blas, "dgemm", 13)


def _ref(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))


def _data(array: Array) -> int:
    assert array.flags.f_contiguous
    return array.ctypes.data


def cholesky(a: Array) -> bool:
    """Replace the lower triangle of a (n, n) by its Cholesky factor; False if a is not positive definite."""
    info = ctypes.c_int()
    n = len(a)
    _potrf(b"L", _ref(n), _data(a), _ref(max(n, 1)), ctypes.byref(info))
    return info.value == 0


def solve_triangular(lower: Array, b: Array, *, transposed: bool = False) -> None:
    """Replace b (n, m) by L^-1 b or, if `transposed`, L^-T b; L is `lower` (n, n)."""
    _solve_with_triangle(b"L", lower, b, transposed)


def solve_triangular_right(lower: Array, b: Array) -> None:
    """Replace b (m, n) by b L^-T; L is `lower` (n, n)."""
    _solve_with_triangle(b"R", lower, b, transposed=True)


def _solve_with_triangle(side: bytes, lower: Array, b: Array, transposed: bool) -> None:
    rows, columns = b.shape
    _trsm(
        side,
        b"L",
        b"T" if transposed else b"N",
        b"N",
        _ref(rows),
        _ref(columns),
        _ONE,
        _data(lower),
        _ref(len(lower)),
        _data(b),
        _ref(rows),
    )


def subtract_square(c: Array, a: Array) -> None:
    """Subtract a a^T from the lower triangle of c (n, n); a (n, m)."""
    n, inner = a.shape
    _syrk(b"L", b"N", _ref(n), _ref(inner), _MINUS_ONE, _data(a), _ref(n), _ONE, _data(c), _ref(n))


def subtract_product(c: Array, a: Array, b: Array, *, transposed: bool = False) -> None:
    """Subtract a b or, if `transposed`, a^T b from c."""
    rows, columns = c.shape
    _gemm(
        b"T" if transposed else b"N",
        b"N",
        _ref(rows),
        _ref(columns),
        _ref(len(b)),
        _MINUS_ONE,
        _data(a),
        _ref(a.shape[0]),
        _data(b),
        _ref(len(b)),
        _ONE,
        _data(c),
        _ref(rows),
    )
