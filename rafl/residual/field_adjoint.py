"""Compiled kernels for the derivatives of a scalar through the nodal forces and the features of the residual field.

`by_x` is the derivative of the scalar with respect to x. The arrays are those of `rafl.residual.field_kernels`.
"""

import numpy as np
from numba import njit, prange

from rafl.fem.kernel_layout import DEFORMATION, STRETCH, U, V
from rafl.fem.simd import KERNEL_OPTIONS
from rafl.residual.field_kernels import (
    CELLS_PER_CHUNK,
    DETERMINANT,
    INVERSE,
    LOCAL,
    RATE,
    ROTATED_RATE,
    ROTATION,
    ROWS,
    SAVED_RATE,
    SAVED_ROTATION,
    SAVED_STRETCH,
    SAVED_U,
    SAVED_V,
    STRETCH_TENSOR,
    invert_stretch_tensor,
    product,
    product_transposed,
    transposed_product,
)

# Further rows of the scratch array: derivatives with respect to quantities of the features, nine rows per matrix.
BY_LOCAL = 118
BY_ROTATION = 127
BY_DEFORMATION = 136
BY_RATE = 145
BY_STRETCH_TENSOR = 154
TEMPORARY = 163
TEMPORARY_2 = ROTATED_RATE  # reused when the rotated rate is no longer needed
BY_STRETCH = 172  # 3


@njit(parallel=True, **KERNEL_OPTIONS)
def acceleration_adjoint(by_force, saved, mass, shape, hexes, out):
    """Fill `out` (6, B E 8): derivatives with respect to each point's acceleration, in the world frame (3
    rows), then in the co-rotated frame (3 rows)."""
    cells = len(hexes)
    for c in prange(len(by_force) * cells):
        b, e = c // cells, c % cells
        rotation = saved[b, e, SAVED_ROTATION:]
        for g in range(8):
            p = c * 8 + g
            for i in range(3):
                total = 0.0
                for n in range(8):
                    total += shape[g, n] * by_force[b, hexes[e, n], i]
                out[i, p] = mass[e, g] * total
            for i in range(3):
                out[3 + i, p] = (
                    rotation[i, g] * out[0, p] + rotation[3 + i, g] * out[1, p] + rotation[6 + i, g] * out[2, p]
                )


@njit(parallel=True, **KERNEL_OPTIONS)
def state_adjoint(by_inputs, by_world_acceleration, acceleration, saved, hexes, gradients, gravity, by_q, by_v):
    """Fill derivatives with respect to positions and velocities, both (B, N, 3).

    Args:
        by_inputs: derivatives with respect to the features, (34, B E 8).
        by_world_acceleration: first three rows of the output of `acceleration_adjoint`.
        acceleration: co-rotated accelerations [m/s^2], (3, B E 8).
        saved, hexes, gradients, gravity: as of `local_features`.
        by_q, by_v: outputs.
    """
    cells = len(hexes)
    chunks = (cells + CELLS_PER_CHUNK - 1) // CELLS_PER_CHUNK
    part = np.empty((len(by_q), cells, 8, 6))
    for task in prange(len(by_q) * chunks):
        b = task // chunks
        w = np.empty(ROWS * 8)
        for e in range((task % chunks) * CELLS_PER_CHUNK, min(cells, (task % chunks + 1) * CELLS_PER_CHUNK)):
            cell = saved[b, e]
            for r in range(9):
                for g in range(8):
                    w[(DEFORMATION + r) * 8 + g] = cell[r, g]
                    w[(RATE + r) * 8 + g] = cell[SAVED_RATE + r, g]
                    w[(U + r) * 8 + g] = cell[SAVED_U + r, g]
                    w[(V + r) * 8 + g] = cell[SAVED_V + r, g]
            for r in range(3):
                for g in range(8):
                    w[(STRETCH + r) * 8 + g] = cell[SAVED_STRETCH + r, g]
            _by_deformation_and_rate(w, by_inputs, by_world_acceleration, acceleration, gravity, (b * cells + e) * 8)
            own = part[b, e]
            for n in range(8):
                for i in range(3):
                    x = 0.0
                    y = 0.0
                    for j in range(3):
                        for g in range(8):
                            slope = gradients[e, (3 * n + j) * 8 + g]
                            x += w[(BY_DEFORMATION + 3 * i + j) * 8 + g] * slope
                            y += w[(BY_RATE + 3 * i + j) * 8 + g] * slope
                    own[n, i] = x
                    own[n, 3 + i] = y
    for b in prange(len(by_q)):
        by_q[b] = 0.0
        by_v[b] = 0.0
        for e in range(cells):
            for n in range(8):
                for i in range(3):
                    by_q[b, hexes[e, n], i] += part[b, e, n, i]
                    by_v[b, hexes[e, n], i] += part[b, e, n, 3 + i]


@njit(**KERNEL_OPTIONS)
def _by_deformation_and_rate(w, by_inputs, by_world_acceleration, acceleration, gravity, first):
    """Derivatives with respect to F and dF/dt of one cell."""
    product_transposed(w, ROTATION, U, V)
    transposed_product(w, STRETCH_TENSOR, ROTATION, DEFORMATION)
    invert_stretch_tensor(w)
    transposed_product(w, ROTATED_RATE, ROTATION, RATE)
    product(w, LOCAL, ROTATED_RATE, INVERSE)
    _by_local(w, by_inputs, first)
    for i in range(3):
        for j in range(3):
            for g in range(8):
                p = first + g
                w[(BY_ROTATION + 3 * i + j) * 8 + g] = (
                    gravity[i] * by_inputs[31 + j, p] + by_world_acceleration[i, p] * acceleration[j, p]
                )
                # through det F - 1, with d det F / dF = det F R S^-T; and through F^T F - I
                w[(BY_DEFORMATION + 3 * i + j) * 8 + g] = w[DETERMINANT * 8 + g] * by_inputs[12, p] * (
                    w[(ROTATION + 3 * i) * 8 + g] * w[(INVERSE + 3 * j) * 8 + g]
                    + w[(ROTATION + 3 * i + 1) * 8 + g] * w[(INVERSE + 3 * j + 1) * 8 + g]
                    + w[(ROTATION + 3 * i + 2) * 8 + g] * w[(INVERSE + 3 * j + 2) * 8 + g]
                ) + (
                    w[(DEFORMATION + 3 * i) * 8 + g] * (by_inputs[3 + j, p] + by_inputs[3 + 3 * j, p])
                    + w[(DEFORMATION + 3 * i + 1) * 8 + g] * (by_inputs[6 + j, p] + by_inputs[3 + 3 * j + 1, p])
                    + w[(DEFORMATION + 3 * i + 2) * 8 + g] * (by_inputs[9 + j, p] + by_inputs[3 + 3 * j + 2, p])
                )
    # LOCAL = R^T RATE S^-1, differentiated factor by factor
    product_transposed(w, TEMPORARY, BY_LOCAL, INVERSE)  # with respect to R^T RATE
    product(w, BY_RATE, ROTATION, TEMPORARY)
    product_transposed(w, BY_STRETCH_TENSOR, RATE, TEMPORARY)
    _accumulate(w, BY_ROTATION, BY_STRETCH_TENSOR, 1.0)
    transposed_product(w, TEMPORARY, ROTATED_RATE, BY_LOCAL)  # with respect to S^-1
    product_transposed(w, BY_STRETCH_TENSOR, TEMPORARY, INVERSE)
    transposed_product(w, TEMPORARY, INVERSE, BY_STRETCH_TENSOR)  # with respect to S, up to the sign
    product(w, BY_STRETCH_TENSOR, ROTATION, TEMPORARY)
    _accumulate(w, BY_DEFORMATION, BY_STRETCH_TENSOR, -1.0)
    product_transposed(w, BY_STRETCH_TENSOR, DEFORMATION, TEMPORARY)
    _accumulate(w, BY_ROTATION, BY_STRETCH_TENSOR, -1.0)
    _add_by_decomposition(w, by_inputs, first)


@njit(**KERNEL_OPTIONS)
def _accumulate(w, out, a, sign):
    for r in range(9):
        for g in range(8):
            w[(out + r) * 8 + g] += sign * w[(a + r) * 8 + g]


@njit(**KERNEL_OPTIONS)
def _by_local(w, by_inputs, first):
    """Derivatives with respect to the co-rotated velocity gradient."""
    for g in range(8):
        p = first + g
        trace = w[LOCAL * 8 + g] + w[(LOCAL + 4) * 8 + g] + w[(LOCAL + 8) * 8 + g]
        x = 0.5 * (w[(LOCAL + 7) * 8 + g] - w[(LOCAL + 5) * 8 + g])
        y = 0.5 * (w[(LOCAL + 2) * 8 + g] - w[(LOCAL + 6) * 8 + g])
        z = 0.5 * (w[(LOCAL + 3) * 8 + g] - w[(LOCAL + 1) * 8 + g])
        size = 0.0
        for i in range(3):
            for j in range(3):
                d = 0.5 * (w[(LOCAL + 3 * i + j) * 8 + g] + w[(LOCAL + 3 * j + i) * 8 + g])
                d = d - trace / 3.0 if i == j else d
                w[(TEMPORARY + 3 * i + j) * 8 + g] = d
                size += d * d
        shear = 0.5 * by_inputs[26, p] / np.sqrt(0.5 * size + 1e-20)
        spin = 4.0 * by_inputs[30, p] / np.sqrt(4.0 * (x * x + y * y + z * z) + 1e-30)
        mean = 0.0
        for i in range(3):
            for j in range(3):
                w[(TEMPORARY + 3 * i + j) * 8 + g] = (
                    by_inputs[17 + 3 * i + j, p] + shear * w[(TEMPORARY + 3 * i + j) * 8 + g]
                )
            mean += w[(TEMPORARY + 4 * i) * 8 + g] / 3.0
        for i in range(3):
            w[(TEMPORARY + 4 * i) * 8 + g] += by_inputs[13 + i, p] + by_inputs[16, p] - mean
            for j in range(3):
                w[(BY_LOCAL + 3 * i + j) * 8 + g] = 0.0
        for i in range(3):
            for j in range(3):
                half = 0.5 * w[(TEMPORARY + 3 * i + j) * 8 + g]
                w[(BY_LOCAL + 3 * i + j) * 8 + g] += half
                w[(BY_LOCAL + 3 * j + i) * 8 + g] += half
        x = 0.5 * (by_inputs[27, p] + spin * x)
        y = 0.5 * (by_inputs[28, p] + spin * y)
        z = 0.5 * (by_inputs[29, p] + spin * z)
        w[(BY_LOCAL + 7) * 8 + g] += x
        w[(BY_LOCAL + 5) * 8 + g] -= x
        w[(BY_LOCAL + 2) * 8 + g] += y
        w[(BY_LOCAL + 6) * 8 + g] -= y
        w[(BY_LOCAL + 3) * 8 + g] += z
        w[(BY_LOCAL + 1) * 8 + g] -= z


@njit(**KERNEL_OPTIONS)
def _add_by_decomposition(w, by_inputs, first):
    """Add to the derivatives with respect to F those through rotation and stretches, by the formulae of
    `rafl.residual.features`."""
    for g in range(8):
        p = first + g
        for i in range(3):
            rank = 0  # number of smaller stretches; equal stretches are ordered by index
            for j in range(3):
                before = w[(STRETCH + j) * 8 + g] < w[(STRETCH + i) * 8 + g]
                before = before or (w[(STRETCH + j) * 8 + g] == w[(STRETCH + i) * 8 + g] and j < i)
                rank += before
            w[(BY_STRETCH + i) * 8 + g] = by_inputs[rank, p]
    transposed_product(w, TEMPORARY_2, U, BY_ROTATION)
    product(w, TEMPORARY, TEMPORARY_2, V)  # U^T by_R V
    for i in range(3):
        for j in range(3):
            for g in range(8):
                total = w[(STRETCH + i) * 8 + g] + w[(STRETCH + j) * 8 + g]
                total = total if abs(total) > 1e-9 else 1e-9
                w[(TEMPORARY_2 + 3 * i + j) * 8 + g] = (
                    w[(TEMPORARY + 3 * i + j) * 8 + g] - w[(TEMPORARY + 3 * j + i) * 8 + g]
                ) / total
    for i in range(3):
        for g in range(8):
            w[(TEMPORARY_2 + 4 * i) * 8 + g] += w[(BY_STRETCH + i) * 8 + g]
    product(w, TEMPORARY, U, TEMPORARY_2)
    product_transposed(w, TEMPORARY_2, TEMPORARY, V)
    _accumulate(w, BY_DEFORMATION, TEMPORARY_2, 1.0)
