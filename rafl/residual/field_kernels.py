"""Compiled kernels for the features of the residual field and the nodal forces.

They are tested against the tensors of `rafl.residual.features`; their derivatives are in `rafl.residual.field_adjoint`.
A row has eight SIMD lanes, one per Gauss point of a cell. Arrays for the network have one row per feature,
(34, points), with the points in order of the cells.
"""

import numpy as np
from numba import njit, prange

from rafl.fem.kernel_layout import DEFORMATION, STRETCH, U, V
from rafl.fem.simd import KERNEL_OPTIONS, lane_products, weighted_rows
from rafl.fem.svd import signed_svd_simd

CELLS_PER_CHUNK = 16  # cells a thread takes at a time
SAVED_ROWS = 48  # rows per cell that the forward kernel saves for the derivatives

# Rows of the scratch array after those of the decomposition (0 to 63); nine rows per matrix unless noted.
RATE = 64  # dF/dt: sum over nodes of v (x) gradient
ROTATION = 73  # R = U V^T
STRETCH_TENSOR = 82  # right stretch tensor S = R^T F
INVERSE = 91  # S^-1
LOCAL = 100  # co-rotated velocity gradient R^T dF/dt S^-1
ROTATED_RATE = 109  # R^T dF/dt
DETERMINANT = 175  # 1; the rows before it are those of `rafl.residual.field_adjoint`
ROWS = 176

# First rows of the quantities in `saved`; F starts at row 0.
SAVED_RATE, SAVED_U, SAVED_V, SAVED_ROTATION, SAVED_STRETCH = 9, 18, 27, 36, 45

_gather = weighted_rows(8, 3, 24)  # sum over nodes of position times gradient
_row_by_column = lane_products(3, 8, 24)  # (A B)_ij
_column_by_column = lane_products(3, 24, 24)  # (A^T B)_ij
_row_by_row = lane_products(3, 8, 8)  # (A B^T)_ij


@njit(**KERNEL_OPTIONS)
def product(w, out, a, b):
    """Fill the matrix at row `out` with A B, of the matrices at rows `a` and `b`."""
    for i in range(3):
        for j in range(3):
            _row_by_column(w, (out + 3 * i + j) * 8, w, (a + 3 * i) * 8, w, (b + j) * 8)


@njit(**KERNEL_OPTIONS)
def transposed_product(w, out, a, b):
    """Fill the matrix at row `out` with A^T B."""
    for i in range(3):
        for j in range(3):
            _column_by_column(w, (out + 3 * i + j) * 8, w, (a + i) * 8, w, (b + j) * 8)


@njit(**KERNEL_OPTIONS)
def product_transposed(w, out, a, b):
    """Fill the matrix at row `out` with A B^T."""
    for i in range(3):
        for j in range(3):
            _row_by_row(w, (out + 3 * i + j) * 8, w, (a + 3 * i) * 8, w, (b + 3 * j) * 8)


@njit(**KERNEL_OPTIONS)
def invert_stretch_tensor(w):
    """Inverse and determinant of the right stretch tensor."""
    for i in range(3):
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            p, r = (i + 1) % 3, (i + 2) % 3
            for g in range(8):  # cofactor (j, i)
                w[(INVERSE + 3 * i + j) * 8 + g] = (
                    w[(STRETCH_TENSOR + 3 * k + p) * 8 + g] * w[(STRETCH_TENSOR + 3 * m + r) * 8 + g]
                    - w[(STRETCH_TENSOR + 3 * k + r) * 8 + g] * w[(STRETCH_TENSOR + 3 * m + p) * 8 + g]
                )
    for g in range(8):
        determinant = (
            w[STRETCH_TENSOR * 8 + g] * w[INVERSE * 8 + g]
            + w[(STRETCH_TENSOR + 1) * 8 + g] * w[(INVERSE + 3) * 8 + g]
            + w[(STRETCH_TENSOR + 2) * 8 + g] * w[(INVERSE + 6) * 8 + g]
        )
        w[DETERMINANT * 8 + g] = determinant
    for i in range(9):
        for g in range(8):
            w[(INVERSE + i) * 8 + g] /= w[DETERMINANT * 8 + g]


@njit(**KERNEL_OPTIONS)
def _local_motion(w):
    """Rotation, right stretch tensor, its inverse and the co-rotated velocity gradient, from F and dF/dt."""
    signed_svd_simd(w)
    product_transposed(w, ROTATION, U, V)
    transposed_product(w, STRETCH_TENSOR, ROTATION, DEFORMATION)
    invert_stretch_tensor(w)
    transposed_product(w, ROTATED_RATE, ROTATION, RATE)
    product(w, LOCAL, ROTATED_RATE, INVERSE)


@njit(parallel=True, **KERNEL_OPTIONS)
def local_features(q, v, hexes, gradients, gravity, saved, inputs):
    """Fill the features `inputs` (34, B E 8), and `saved` (B, E, SAVED_ROWS, 8) for the derivatives.

    Args:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        hexes: (E, 8).
        gradients: shape function gradients [1/m], (E, 8 nodes * 3 * 8 points).
        gravity: [m/s^2], (3).
        saved, inputs: outputs.
    """
    cells = len(hexes)
    chunks = (cells + CELLS_PER_CHUNK - 1) // CELLS_PER_CHUNK
    for task in prange(len(q) * chunks):
        b = task // chunks
        w = np.empty(ROWS * 8)
        x = np.empty(48)
        for e in range((task % chunks) * CELLS_PER_CHUNK, min(cells, (task % chunks + 1) * CELLS_PER_CHUNK)):
            for n in range(8):
                for i in range(3):
                    x[3 * n + i] = q[b, hexes[e, n], i]
                    x[24 + 3 * n + i] = v[b, hexes[e, n], i]
            own = gradients[e]
            for i in range(3):
                for j in range(3):
                    _gather(w, (DEFORMATION + 3 * i + j) * 8, x, i, own, j * 8)
                    _gather(w, (RATE + 3 * i + j) * 8, x, 24 + i, own, j * 8)
            _local_motion(w)
            _write_features(w, gravity, inputs, (b * cells + e) * 8)
            out = saved[b, e]
            for r in range(9):
                for g in range(8):
                    out[r, g] = w[(DEFORMATION + r) * 8 + g]
                    out[SAVED_RATE + r, g] = w[(RATE + r) * 8 + g]
                    out[SAVED_U + r, g] = w[(U + r) * 8 + g]
                    out[SAVED_V + r, g] = w[(V + r) * 8 + g]
                    out[SAVED_ROTATION + r, g] = w[(ROTATION + r) * 8 + g]
            for r in range(3):
                for g in range(8):
                    out[SAVED_STRETCH + r, g] = w[(STRETCH + r) * 8 + g]


@njit(**KERNEL_OPTIONS)
def _write_features(w, gravity, inputs, first):
    """Fill the features of the eight points from column `first` on, in the order of `rafl.residual.features`."""
    for g in range(8):
        p = first + g
        a, b, c = w[STRETCH * 8 + g], w[(STRETCH + 1) * 8 + g], w[(STRETCH + 2) * 8 + g]
        inputs[0, p] = min(a, b, c) - 1.0
        inputs[1, p] = max(min(a, b), min(max(a, b), c)) - 1.0
        inputs[2, p] = max(a, b, c) - 1.0
        inputs[12, p] = w[DETERMINANT * 8 + g] - 1.0
    for i in range(3):
        for j in range(3):
            unit = 1.0 if i == j else 0.0
            for g in range(8):
                inputs[3 + 3 * i + j, first + g] = (
                    w[(DEFORMATION + i) * 8 + g] * w[(DEFORMATION + j) * 8 + g]
                    + w[(DEFORMATION + 3 + i) * 8 + g] * w[(DEFORMATION + 3 + j) * 8 + g]
                    + w[(DEFORMATION + 6 + i) * 8 + g] * w[(DEFORMATION + 6 + j) * 8 + g]
                    - unit
                )
    for g in range(8):
        p = first + g
        trace = w[LOCAL * 8 + g] + w[(LOCAL + 4) * 8 + g] + w[(LOCAL + 8) * 8 + g]
        inputs[16, p] = trace
        size = 0.0
        for i in range(3):
            inputs[13 + i, p] = w[(LOCAL + 4 * i) * 8 + g]
            for j in range(3):
                d = 0.5 * (w[(LOCAL + 3 * i + j) * 8 + g] + w[(LOCAL + 3 * j + i) * 8 + g])
                d = d - trace / 3.0 if i == j else d
                inputs[17 + 3 * i + j, p] = d
                size += d * d
        inputs[26, p] = np.sqrt(0.5 * size + 1e-20)
        x = 0.5 * (w[(LOCAL + 7) * 8 + g] - w[(LOCAL + 5) * 8 + g])
        y = 0.5 * (w[(LOCAL + 2) * 8 + g] - w[(LOCAL + 6) * 8 + g])
        z = 0.5 * (w[(LOCAL + 3) * 8 + g] - w[(LOCAL + 1) * 8 + g])
        inputs[27, p] = x
        inputs[28, p] = y
        inputs[29, p] = z
        inputs[30, p] = np.sqrt(4.0 * (x * x + y * y + z * z) + 1e-30)
        for i in range(3):
            inputs[31 + i, p] = (
                w[(ROTATION + i) * 8 + g] * gravity[0]
                + w[(ROTATION + 3 + i) * 8 + g] * gravity[1]
                + w[(ROTATION + 6 + i) * 8 + g] * gravity[2]
            )


@njit(parallel=True, **KERNEL_OPTIONS)
def nodal_forces(acceleration, saved, mass, shape, hexes, force):
    """Fill nodal forces `force` (B, N, 3) [N] from co-rotated accelerations (3, B E 8) [m/s^2].

    The force is the sum over points of shape function * mass * R acceleration.
    """
    cells = len(hexes)
    part = np.empty((len(force), cells, 8, 3))
    for c in prange(len(force) * cells):
        b, e = c // cells, c % cells
        rotation = saved[b, e, SAVED_ROTATION:]
        own = part[b, e]
        own[:] = 0.0
        for g in range(8):
            a0, a1, a2 = (acceleration[0, c * 8 + g], acceleration[1, c * 8 + g], acceleration[2, c * 8 + g])
            for i in range(3):
                point_force = mass[e, g] * (
                    rotation[3 * i, g] * a0 + rotation[3 * i + 1, g] * a1 + rotation[3 * i + 2, g] * a2
                )
                for n in range(8):
                    own[n, i] += shape[g, n] * point_force
    for b in prange(len(force)):
        force[b] = 0.0
        for e in range(cells):
            for n in range(8):
                for i in range(3):
                    force[b, hexes[e, n], i] += part[b, e, n, i]
