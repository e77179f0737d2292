"""Symmetric banded systems: assembly from cells, factorisation and solution, a batch at a time."""

import numpy as np
from numba import njit, prange

from rafl.lanes import KERNEL, add_rows

PANEL = 8  # columns eliminated together

_eliminate = add_rows(PANEL)


@njit(parallel=True, **KERNEL)
def factor_bands(stiffness, diagonal, destination, rows, bands, width, pivots):  # type: ignore[no-untyped-def]
    """Assemble and factor K + diagonal = L D L^T for each trajectory.

    Args:
        stiffness: of the cells, (R, E, 384) [N/m].
        diagonal: added to the matrix, (R, n).
        destination: flat place of each entry in its band, negative where it has none, (E, 384).
        rows: where in `bands` each goes, (R).
        bands: filled, (B, n * width + 8); column c of L from the diagonal down at c * width, D on the diagonal.
        pivots: filled with the smallest pivot of each, (R).
    """
    n = bands.shape[1] // width
    for r in prange(len(rows)):
        band = bands[rows[r]]
        _scatter(stiffness[r], destination, band)
        for c in range(n):
            band[c * width] += diagonal[r, c]
        pivots[r] = _factor(band, n, width)


@njit(**KERNEL)
def _scatter(stiffness, destination, flat):  # type: ignore[no-untyped-def]
    flat[:] = 0.0
    for e in range(destination.shape[0]):
        for m in range(destination.shape[1]):
            place = destination[e, m]
            if place >= 0:
                flat[place] += stiffness[e, m]


@njit(parallel=True, **KERNEL)
def scatter(stiffness, destination, rows, flat):  # type: ignore[no-untyped-def]
    """Sum the cells' entries (R, E, 384) into rows of flat (B, size), at places (E, 384) or nowhere (-1)."""
    for r in prange(len(rows)):
        _scatter(stiffness[r], destination, flat[rows[r]])


@njit(**KERNEL)
def _factor(band, n, width):  # type: ignore[no-untyped-def]
    """Factor one flat band in place; returns its smallest pivot.

    Columns are eliminated in panels. Rows of eight may run over a column's end: what they subtract
    there is zero, and the array has eight places to spare.
    """
    stride = width + PANEL + 8
    panel = np.zeros(PANEL * stride)  # column k of the panel from row `first` on, at k * stride
    scaled = np.zeros(8)
    smallest = np.inf
    for first in range(0, n, PANEL):
        count = min(PANEL, n - first)
        panel[:] = 0.0
        scaled[:] = 0.0
        for k in range(count):
            start = k * stride
            for r in range(min(width, n - first - k)):
                panel[start + k + r] = band[(first + k) * width + r]
            for earlier in range(k):
                scaled[earlier] = -panel[earlier * stride + k] / panel[earlier * stride + earlier]
            for r in range(k, width + k, 8):
                _eliminate(panel, start + r, scaled, 0, panel, r, stride)
            scaled[:] = 0.0
            smallest = min(smallest, panel[start + k])
        below = min(width + count - 1, n - first)
        for c in range(count, below):
            for k in range(count):
                scaled[k] = -panel[k * stride + c] / panel[k * stride + k]
            start = (first + c) * width - c
            for r in range(c, below, 8):
                _eliminate(band, start + r, scaled, 0, panel, r, stride)
        for k in range(count):
            pivot = panel[k * stride + k]
            column = (first + k) * width
            band[column] = pivot
            for r in range(1, min(width, n - first - k)):
                band[column + r] = panel[k * stride + k + r] / pivot
    return smallest


@njit(parallel=True, cache=True, error_model="numpy", fastmath=True)
def solve_bands(bands, width, rows, x):  # type: ignore[no-untyped-def]
    """Solve in place for x (R, C, n), C right sides of each factored band."""
    n = bands.shape[1] // width
    columns = x.shape[1]
    for task in prange(len(rows) * columns):
        band = bands[rows[task // columns]]
        y = x[task // columns, task % columns]
        for c in range(n):
            value = y[c]
            column = band[c * width : (c + 1) * width]
            for r in range(1, min(width, n - c)):
                y[c + r] -= value * column[r]
        for c in range(n - 1, -1, -1):
            column = band[c * width : (c + 1) * width]
            total = 0.0
            for r in range(1, min(width, n - c)):
                total += column[r] * y[c + r]
            y[c] = y[c] / column[0] - total
