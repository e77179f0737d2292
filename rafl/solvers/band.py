"""Assembly, factorisation and solution of a batch of symmetric banded systems.

A band is a flat array of the matrix columns, one after another. Column c starts at matrix row 8 * (c // 8), so
neighbouring columns have their SIMD rows of eight at the same offsets. Its values above the diagonal are undefined.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rafl.fem.simd import KERNEL_OPTIONS, SIMD_LANES, add_weighted_vectors

_add_columns = add_weighted_vectors(SIMD_LANES)


def column_length(width: int) -> int:
    """Number of values stored per column of a band; `width` is the bandwidth, including the diagonal."""
    return SIMD_LANES * ((width + 2 * SIMD_LANES - 2) // SIMD_LANES)


def allocate_bands(batch: int, n: int, width: int) -> NDArray[np.float64]:
    """Zeroed bands (B, size) of n columns, aligned to rows of eight doubles."""
    size = SIMD_LANES * ((n + SIMD_LANES - 1) // SIMD_LANES) * column_length(width)
    flat = np.zeros(batch * size + SIMD_LANES)
    skip = (-flat.ctypes.data // 8) % SIMD_LANES
    return flat[skip : skip + batch * size].reshape(batch, size)


@njit(parallel=True, **KERNEL_OPTIONS)
def factor_bands(stiffness, diagonal, entries, destination, rows, bands, length, pivots):
    """Assemble K + diagonal and factor it into L D L^T, for each trajectory.

    Args:
        stiffness: cell stiffnesses, (R, E * 384) [N/m].
        diagonal: added to the matrix, (R, n).
        entries, destination: indices into a trajectory's stiffness and into its band, (M).
        rows: index in `bands` of each trajectory, (R).
        bands: output, (B, size); L below the diagonal, D on it.
        length: stored values per column; see `column_length`.
        pivots: output; the smallest pivot of each trajectory, (R).
    """
    n = diagonal.shape[1]
    for r in prange(len(rows)):
        band = bands[rows[r]]
        band[:] = 0.0
        _add_entries(stiffness[r], entries, destination, band)
        for c in range(n):
            band[c * length + c % SIMD_LANES] += diagonal[r, c]
        pivots[r] = _factor_band(band, n, length)


@njit(**KERNEL_OPTIONS)
def _add_entries(stiffness, entries, destination, flat):
    """Add stiffness[entries] to flat[destination]."""
    for m in range(len(entries)):
        flat[destination[m]] += stiffness[entries[m]]


@njit(parallel=True, **KERNEL_OPTIONS)
def scatter_entries(stiffness, entries, destination, rows, flat):
    """Overwrite `rows` (R) of flat (B, size) with the sums of stiffness[:, entries] (R, M) at `destination` (M)."""
    parts = 16
    length = flat.shape[1] // parts + 1
    for task in prange(len(rows) * parts):
        start = (task % parts) * length
        flat[rows[task // parts], start : start + length] = 0.0
    for r in prange(len(rows)):
        _add_entries(stiffness[r], entries, destination, flat[rows[r]])


@njit(**KERNEL_OPTIONS)
def _factor_band(band, n, length):
    """Factor one band in place, eight columns at a time; return its smallest pivot."""
    factors = np.zeros(SIMD_LANES)
    inverse = np.zeros(SIMD_LANES)  # of the pivots
    smallest = np.inf
    for first in range(0, n, SIMD_LANES):
        count = min(SIMD_LANES, n - first)
        panel = first * length  # column k of the panel is at panel + k * length and starts at row `first`
        for k in range(count):
            for earlier in range(k):
                factors[earlier] = -band[panel + earlier * length + k] * inverse[earlier]
            _add_columns(band, panel + k * length, factors, 0, band, panel, length, length)
            factors[:] = 0.0
            pivot = band[panel + k * length + k]
            smallest = min(smallest, pivot)
            inverse[k] = 1.0 / pivot
        for c in range(SIMD_LANES, min(length, n - first)):
            for k in range(count):
                factors[k] = -band[panel + k * length + c] * inverse[k]
            start = SIMD_LANES * (c // SIMD_LANES)
            _add_columns(band, panel + c * length, factors, 0, band, panel + start, length, length - start)
        factors[:] = 0.0
        for k in range(count):
            column = panel + k * length
            for r in range(k + 1, length):
                band[column + r] *= inverse[k]
    return smallest


@njit(parallel=True, cache=True, error_model="numpy", fastmath=True)
def solve_bands(bands, length, rows, x):
    """Solve for x (R, C, n) in place: C right-hand sides for each factored band."""
    n = x.shape[2]
    columns = x.shape[1]
    for task in prange(len(rows) * columns):
        band = bands[rows[task // columns]]
        y = x[task // columns, task % columns]
        for c in range(n):
            diagonal_row = c % SIMD_LANES
            column = band[c * length + diagonal_row : (c + 1) * length]
            value = y[c]
            for r in range(1, min(length - diagonal_row, n - c)):
                y[c + r] -= value * column[r]
        for c in range(n - 1, -1, -1):
            diagonal_row = c % SIMD_LANES
            column = band[c * length + diagonal_row : (c + 1) * length]
            total = 0.0
            for r in range(1, min(length - diagonal_row, n - c)):
                total += column[r] * y[c + r]
            y[c] = y[c] / column[0] - total
