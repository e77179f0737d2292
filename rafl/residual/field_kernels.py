"""The residual field's features, their derivatives and its nodal forces, compiled.

`rafl.residual.features` says the same in tensors and is what these kernels are tested against. One lane of a row is a Gauss
point of a cell; numbers for the network stand feature by feature, (34, points), and points cell by cell.
"""

import numpy as np
from numba import njit, prange

from rafl.fem.kernel_layout import DEFORMATION, STRETCH, U, V
from rafl.fem.simd import KERNEL, lane_products, weighted_rows
from rafl.fem.svd import signed_svd_lanes

CHUNK = 16  # cells a thread takes at a time
KEPT = 48  # rows of a cell that the derivatives need again

# Rows of the scratch besides those of the decomposition (0 to 63), nine to a matrix.
RATE = 64  # sum over nodes of v (x) gradient
TURN = 73  # R = U V^T
STRETCHED = 82  # R^T F
INVERSE = 91  # of that
LOCAL = 100  # R^T RATE INVERSE, the co-rotated velocity gradient
MIDDLE = 109
BY_LOCAL = 118  # derivatives by these, from here on
BY_TURN = 127
BY_DEFORMATION = 136
BY_RATE = 145
BY_STRETCHED = 154
SPIN = 163
BY_STRETCH = 172  # 3
DETERMINANT = 175
ROWS = 176

# Where in `kept` each point's quantities stand.
KEPT_RATE, KEPT_U, KEPT_V, KEPT_TURN, KEPT_STRETCH = 9, 18, 27, 36, 45

_gather = weighted_rows(8, 3, 24)  # sum over nodes of position times gradient
_row_by_column = lane_products(3, 8, 24)  # (A B)_ij
_column_by_column = lane_products(3, 24, 24)  # (A^T B)_ij
_row_by_row = lane_products(3, 8, 8)  # (A B^T)_ij


@njit(**KERNEL)
def _product(w, out, a, b):
    for i in range(3):
        for j in range(3):
            _row_by_column(w, (out + 3 * i + j) * 8, w, (a + 3 * i) * 8, w, (b + j) * 8)


@njit(**KERNEL)
def _transposed_product(w, out, a, b):
    for i in range(3):
        for j in range(3):
            _column_by_column(w, (out + 3 * i + j) * 8, w, (a + i) * 8, w, (b + j) * 8)


@njit(**KERNEL)
def _product_transposed(w, out, a, b):
    for i in range(3):
        for j in range(3):
            _row_by_row(w, (out + 3 * i + j) * 8, w, (a + 3 * i) * 8, w, (b + 3 * j) * 8)


@njit(**KERNEL)
def _invert(w):
    """The right stretch tensor's inverse and its determinant."""
    for i in range(3):
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            p, r = (i + 1) % 3, (i + 2) % 3
            for g in range(8):  # the cofactor of (j, i)
                w[(INVERSE + 3 * i + j) * 8 + g] = (
                    w[(STRETCHED + 3 * k + p) * 8 + g] * w[(STRETCHED + 3 * m + r) * 8 + g]
                    - w[(STRETCHED + 3 * k + r) * 8 + g] * w[(STRETCHED + 3 * m + p) * 8 + g]
                )
    for g in range(8):
        determinant = (
            w[STRETCHED * 8 + g] * w[INVERSE * 8 + g]
            + w[(STRETCHED + 1) * 8 + g] * w[(INVERSE + 3) * 8 + g]
            + w[(STRETCHED + 2) * 8 + g] * w[(INVERSE + 6) * 8 + g]
        )
        w[DETERMINANT * 8 + g] = determinant
    for i in range(9):
        for g in range(8):
            w[(INVERSE + i) * 8 + g] /= w[DETERMINANT * 8 + g]


@njit(**KERNEL)
def _local_motion(w):
    """From F and RATE: rotation, right stretch tensor and its inverse, co-rotated velocity gradient."""
    signed_svd_lanes(w)
    _product_transposed(w, TURN, U, V)
    _transposed_product(w, STRETCHED, TURN, DEFORMATION)
    _invert(w)
    _transposed_product(w, MIDDLE, TURN, RATE)
    _product(w, LOCAL, MIDDLE, INVERSE)


@njit(parallel=True, **KERNEL)
def local_features(q, v, hexes, slopes, gravity, kept, inputs):
    """Fill inputs (34, B E 8) and what the derivatives need again, kept (B, E, KEPT, 8).

    Args:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        hexes: (E, 8).
        slopes: shape function gradients [1/m], (E, 8 nodes * 3 * 8 points).
        gravity: [m/s^2], (3).
        kept, inputs: outputs.
    """
    cells = len(hexes)
    chunks = (cells + CHUNK - 1) // CHUNK
    for task in prange(len(q) * chunks):
        b = task // chunks
        w = np.empty(ROWS * 8)
        x = np.empty(48)
        for e in range((task % chunks) * CHUNK, min(cells, (task % chunks + 1) * CHUNK)):
            for n in range(8):
                for i in range(3):
                    x[3 * n + i] = q[b, hexes[e, n], i]
                    x[24 + 3 * n + i] = v[b, hexes[e, n], i]
            own = slopes[e]
            for i in range(3):
                for j in range(3):
                    _gather(w, (DEFORMATION + 3 * i + j) * 8, x, i, own, j * 8)
                    _gather(w, (RATE + 3 * i + j) * 8, x, 24 + i, own, j * 8)
            _local_motion(w)
            _write_features(w, gravity, inputs, (b * cells + e) * 8)
            out = kept[b, e]
            for r in range(9):
                for g in range(8):
                    out[r, g] = w[(DEFORMATION + r) * 8 + g]
                    out[KEPT_RATE + r, g] = w[(RATE + r) * 8 + g]
                    out[KEPT_U + r, g] = w[(U + r) * 8 + g]
                    out[KEPT_V + r, g] = w[(V + r) * 8 + g]
                    out[KEPT_TURN + r, g] = w[(TURN + r) * 8 + g]
            for r in range(3):
                for g in range(8):
                    out[KEPT_STRETCH + r, g] = w[(STRETCH + r) * 8 + g]


@njit(**KERNEL)
def _write_features(w, gravity, inputs, first):
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
                w[(TURN + i) * 8 + g] * gravity[0]
                + w[(TURN + 3 + i) * 8 + g] * gravity[1]
                + w[(TURN + 6 + i) * 8 + g] * gravity[2]
            )


@njit(parallel=True, **KERNEL)
def nodal_forces(acceleration, kept, mass, shape, hexes, force):
    """Fill force (B, N, 3): sum over points of shape function times mass times R times acceleration (3, B E 8)."""
    cells = len(hexes)
    part = np.empty((len(force), cells, 8, 3))
    for c in prange(len(force) * cells):
        b, e = c // cells, c % cells
        turn = kept[b, e, KEPT_TURN:]
        own = part[b, e]
        own[:] = 0.0
        for g in range(8):
            a0, a1, a2 = (acceleration[0, c * 8 + g], acceleration[1, c * 8 + g], acceleration[2, c * 8 + g])
            for i in range(3):
                pull = mass[e, g] * (turn[3 * i, g] * a0 + turn[3 * i + 1, g] * a1 + turn[3 * i + 2, g] * a2)
                for n in range(8):
                    own[n, i] += shape[g, n] * pull
    for b in prange(len(force)):
        force[b] = 0.0
        for e in range(cells):
            for n in range(8):
                for i in range(3):
                    force[b, hexes[e, n], i] += part[b, e, n, i]


@njit(parallel=True, **KERNEL)
def by_acceleration(by_force, kept, mass, shape, hexes, out):
    """Fill out (6, B E 8): derivatives by the pull on each point in the world's frame, then by its acceleration."""
    cells = len(hexes)
    for c in prange(len(by_force) * cells):
        b, e = c // cells, c % cells
        turn = kept[b, e, KEPT_TURN:]
        for g in range(8):
            p = c * 8 + g
            for i in range(3):
                total = 0.0
                for n in range(8):
                    total += shape[g, n] * by_force[b, hexes[e, n], i]
                out[i, p] = mass[e, g] * total
            for i in range(3):
                out[3 + i, p] = turn[i, g] * out[0, p] + turn[3 + i, g] * out[1, p] + turn[6 + i, g] * out[2, p]


@njit(parallel=True, **KERNEL)
def by_state(by_inputs, by_pull, acceleration, kept, hexes, slopes, gravity, by_q, by_v):
    """Fill derivatives by positions and velocities, both (B, N, 3).

    Args:
        by_inputs: derivatives by the features, (34, B E 8).
        by_pull: first three rows of `by_acceleration`.
        acceleration: co-rotated, (3, B E 8).
        kept, hexes, slopes, gravity: as of `local_features`.
        by_q, by_v: outputs.
    """
    cells = len(hexes)
    chunks = (cells + CHUNK - 1) // CHUNK
    part = np.empty((len(by_q), cells, 8, 6))
    for task in prange(len(by_q) * chunks):
        b = task // chunks
        w = np.empty(ROWS * 8)
        for e in range((task % chunks) * CHUNK, min(cells, (task % chunks + 1) * CHUNK)):
            stored = kept[b, e]
            for r in range(9):
                for g in range(8):
                    w[(DEFORMATION + r) * 8 + g] = stored[r, g]
                    w[(RATE + r) * 8 + g] = stored[KEPT_RATE + r, g]
                    w[(U + r) * 8 + g] = stored[KEPT_U + r, g]
                    w[(V + r) * 8 + g] = stored[KEPT_V + r, g]
            for r in range(3):
                for g in range(8):
                    w[(STRETCH + r) * 8 + g] = stored[KEPT_STRETCH + r, g]
            _by_motion(w, by_inputs, by_pull, acceleration, gravity, (b * cells + e) * 8)
            own = part[b, e]
            for n in range(8):
                for i in range(3):
                    x = 0.0
                    y = 0.0
                    for j in range(3):
                        for g in range(8):
                            slope = slopes[e, (3 * n + j) * 8 + g]
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


@njit(**KERNEL)
def _by_motion(w, by_inputs, by_pull, acceleration, gravity, first):
    """Derivatives by F and by the velocity gradient's numerator, of one cell."""
    _product_transposed(w, TURN, U, V)
    _transposed_product(w, STRETCHED, TURN, DEFORMATION)
    _invert(w)
    _transposed_product(w, MIDDLE, TURN, RATE)
    _product(w, LOCAL, MIDDLE, INVERSE)
    _by_local(w, by_inputs, first)
    for i in range(3):
        for j in range(3):
            for g in range(8):
                p = first + g
                w[(BY_TURN + 3 * i + j) * 8 + g] = (
                    gravity[i] * by_inputs[31 + j, p] + by_pull[i, p] * acceleration[j, p]
                )
                # of F^T F - 1, and of det F - 1: cofactor = det R S^-T
                w[(BY_DEFORMATION + 3 * i + j) * 8 + g] = w[DETERMINANT * 8 + g] * by_inputs[12, p] * (
                    w[(TURN + 3 * i) * 8 + g] * w[(INVERSE + 3 * j) * 8 + g]
                    + w[(TURN + 3 * i + 1) * 8 + g] * w[(INVERSE + 3 * j + 1) * 8 + g]
                    + w[(TURN + 3 * i + 2) * 8 + g] * w[(INVERSE + 3 * j + 2) * 8 + g]
                ) + (
                    w[(DEFORMATION + 3 * i) * 8 + g] * (by_inputs[3 + j, p] + by_inputs[3 + 3 * j, p])
                    + w[(DEFORMATION + 3 * i + 1) * 8 + g] * (by_inputs[6 + j, p] + by_inputs[3 + 3 * j + 1, p])
                    + w[(DEFORMATION + 3 * i + 2) * 8 + g] * (by_inputs[9 + j, p] + by_inputs[3 + 3 * j + 2, p])
                )
    # LOCAL = R^T RATE S^-1
    _product_transposed(w, SPIN, BY_LOCAL, INVERSE)  # by R^T RATE
    _product(w, BY_RATE, TURN, SPIN)
    _product_transposed(w, BY_STRETCHED, RATE, SPIN)
    _accumulate(w, BY_TURN, BY_STRETCHED, 1.0)
    _transposed_product(w, SPIN, MIDDLE, BY_LOCAL)  # by S^-1
    _product_transposed(w, BY_STRETCHED, SPIN, INVERSE)
    _transposed_product(w, SPIN, INVERSE, BY_STRETCHED)  # by S, sign to come
    _product(w, BY_STRETCHED, TURN, SPIN)
    _accumulate(w, BY_DEFORMATION, BY_STRETCHED, -1.0)
    _product_transposed(w, BY_STRETCHED, DEFORMATION, SPIN)
    _accumulate(w, BY_TURN, BY_STRETCHED, -1.0)
    _by_decomposition(w, by_inputs, first)


@njit(**KERNEL)
def _accumulate(w, out, a, sign):
    for r in range(9):
        for g in range(8):
            w[(out + r) * 8 + g] += sign * w[(a + r) * 8 + g]


@njit(**KERNEL)
def _by_local(w, by_inputs, first):
    """Derivatives by the co-rotated velocity gradient."""
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
                w[(SPIN + 3 * i + j) * 8 + g] = d
                size += d * d
        shear = 0.5 * by_inputs[26, p] / np.sqrt(0.5 * size + 1e-20)
        spin = 4.0 * by_inputs[30, p] / np.sqrt(4.0 * (x * x + y * y + z * z) + 1e-30)
        mean = 0.0
        for i in range(3):
            for j in range(3):
                w[(SPIN + 3 * i + j) * 8 + g] = by_inputs[17 + 3 * i + j, p] + shear * w[(SPIN + 3 * i + j) * 8 + g]
            mean += w[(SPIN + 4 * i) * 8 + g] / 3.0
        for i in range(3):
            w[(SPIN + 4 * i) * 8 + g] += by_inputs[13 + i, p] + by_inputs[16, p] - mean
            for j in range(3):
                w[(BY_LOCAL + 3 * i + j) * 8 + g] = 0.0
        for i in range(3):
            for j in range(3):
                half = 0.5 * w[(SPIN + 3 * i + j) * 8 + g]
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


@njit(**KERNEL)
def _by_decomposition(w, by_inputs, first):
    """Adds to the derivatives by F those through rotation and stretches; see `rafl.residual.features` for the formulae."""
    for g in range(8):
        p = first + g
        for i in range(3):
            rank = 0  # how many stretches are smaller; equal ones count by their number
            for j in range(3):
                before = w[(STRETCH + j) * 8 + g] < w[(STRETCH + i) * 8 + g]
                before = before or (w[(STRETCH + j) * 8 + g] == w[(STRETCH + i) * 8 + g] and j < i)
                rank += before
            w[(BY_STRETCH + i) * 8 + g] = by_inputs[rank, p]
    _transposed_product(w, MIDDLE, U, BY_TURN)
    _product(w, SPIN, MIDDLE, V)  # U^T by_R V
    for i in range(3):
        for j in range(3):
            for g in range(8):
                total = w[(STRETCH + i) * 8 + g] + w[(STRETCH + j) * 8 + g]
                total = total if abs(total) > 1e-9 else 1e-9
                w[(MIDDLE + 3 * i + j) * 8 + g] = (
                    w[(SPIN + 3 * i + j) * 8 + g] - w[(SPIN + 3 * j + i) * 8 + g]
                ) / total
    for i in range(3):
        for g in range(8):
            w[(MIDDLE + 4 * i) * 8 + g] += w[(BY_STRETCH + i) * 8 + g]
    _product(w, SPIN, U, MIDDLE)
    _product_transposed(w, MIDDLE, SPIN, V)
    _accumulate(w, BY_DEFORMATION, MIDDLE, 1.0)
