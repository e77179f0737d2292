"""Symmetric banded systems: assembly from cells, factorisation and solution, a batch at a time.

A band is a flat array of columns. Column c begins at row 8 * (c // 8), so that rows of eight start on the
same places in neighbouring columns; what stands above the diagonal there means nothing.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from rafl.fem.simd import KERNEL, LANES, add_rows

_eliminate = add_rows(LANES)


def column_length(width: int) -> int:
    """Places of each column of a band of `width`, the diagonal included."""
    return LANES * ((width + 2 * LANES - 2) // LANES)


def allocate(batch: int, n: int, width: int) -> NDArray[np.float64]:
    """Bands (B, size) of n columns, aligned to rows of eight."""
    size = LANES * ((n + LANES - 1) // LANES) * column_length(width)
    flat = np.zeros(batch * size + LANES)
    skip = (-flat.ctypes.data // 8) % LANES
    return flat[skip : skip + batch * size].reshape(batch, size)


@njit(parallel=True, **KERNEL)
def factor_bands(stiffness, diagonal, entries, destination, rows, bands, length, pivots):
    """Assemble and factor K + diagonal = L D L^T for each trajectory.

    Args:
        stiffness: of the cells, (R, E * 384) [N/m].
        diagonal: added to the matrix, (R, n).
        entries, destination: entries of a trajectory's stiffness, and their flat places in its band, (M).
        rows: where in `bands` each goes, (R).
        bands: filled, (B, size); L below the diagonal, D on it.
        length: of a column.
        pivots: filled with the smallest pivot of each, (R).
    """
    n = diagonal.shape[1]
    for r in prange(len(rows)):
        band = bands[rows[r]]
        band[:] = 0.0
        _add_entries(stiffness[r], entries, destination, band)
        for c in range(n):
            band[c * length + c % LANES] += diagonal[r, c]
        pivots[r] = _factor(band, n, length)


@njit(**KERNEL)
def _add_entries(stiffness, entries, destination, flat):
    for m in range(len(entries)):
        flat[destination[m]] += stiffness[entries[m]]


@njit(parallel=True, **KERNEL)
def scatter(stiffness, entries, destination, rows, flat):
    """Sum entries (M) of the cells' (R, E * 384) into rows of flat (B, size), at `destination` (M)."""
    pieces = 16
    length = flat.shape[1] // pieces + 1
    for task in prange(len(rows) * pieces):
        start = (task % pieces) * length
        flat[rows[task // pieces], start : start + length] = 0.0
    for r in prange(len(rows)):
        _add_entries(stiffness[r], entries, destination, flat[rows[r]])


@njit(**KERNEL)
def _factor(band, n, length):
    """Factor one band in place, eight columns at a time; returns its smallest pivot."""
    factors = np.zeros(LANES)
    inverse = np.zeros(LANES)  # of the pivots
    smallest = np.inf
    for first in range(0, n, LANES):
        count = min(LANES, n - first)
        panel = first * length  # its column k at panel + k * length, from row `first` on
        for k in range(count):
            for earlier in range(k):
                factors[earlier] = -band[panel + earlier * length + k] * inverse[earlier]
            _eliminate(band, panel + k * length, factors, 0, band, panel, length, length)
            factors[:] = 0.0
            pivot = band[panel + k * length + k]
            smallest = min(smallest, pivot)
            inverse[k] = 1.0 / pivot
        for c in range(LANES, min(length, n - first)):
            for k in range(count):
                factors[k] = -band[panel + k * length + c] * inverse[k]
            start = LANES * (c // LANES)
            _eliminate(band, panel + c * length, factors, 0, band, panel + start, length, length - start)
        factors[:] = 0.0
        for k in range(count):
            column = panel + k * length
            for r in range(k + 1, length):
                band[column + r] *= inverse[k]
    return smallest


@njit(parallel=True, cache=True, error_model="numpy", fastmath=True)
def solve_bands(bands, length, rows, x):
    """Solve in place for x (R, C, n), C right sides of each factored band."""
    n = x.shape[2]
    columns = x.shape[1]
    for task in prange(len(rows) * columns):
        band = bands[rows[task // columns]]
        y = x[task // columns, task % columns]
        for c in range(n):
            own = c % LANES
            column = band[c * length + own : (c + 1) * length]
            value = y[c]
            for r in range(1, min(length - own, n - c)):
                y[c + r] -= value * column[r]
        for c in range(n - 1, -1, -1):
            own = c % LANES
            column = band[c * length + own : (c + 1) * length]
            total = 0.0
            for r in range(1, min(length - own, n - c)):
                total += column[r] * y[c + r]
            y[c] = y[c] / column[0] - total
