"""The tangent of a cell with stabilised hourglass modes."""

from numba import njit

from rafl.fem.enhanced.layout import (
    BLOCK,
    COLUMNS,
    CURVATURE,
    DRIVEN,
    INVERSE,
    LOCAL,
    LOCAL_FORCE,
    MODE_STIFFNESS,
    MOMENT,
    NODAL_PRODUCT,
    ROTATION,
    SCRATCH,
    STRETCH_TENSOR,
    SWEEP,
    TENSOR,
    TURN,
)
from rafl.fem.kernel_layout import TANGENT
from rafl.fem.simd import KERNEL_OPTIONS, lane_products

_over_columns = lane_products(COLUMNS, 24, 64)
_nodes_over_columns = lane_products(COLUMNS, 64, 64)


@njit(**KERNEL_OPTIONS)
def _fill_turn(w):
    """Fill omega per column of R^T dF0, L_j = G^-1 [e_j], and the sweep [Y_k]."""
    for j in range(3):
        a = (j + 1) % 3
        b = (j + 2) % 3
        for i in range(3):
            for g in range(8):
                # [e_j] e_a = e_b and [e_j] e_b = -e_a.
                w[(TURN + 9 * i + 3 * j + j) * 8 + g] = 0.0
                w[(TURN + 9 * i + 3 * j + a) * 8 + g] = w[(INVERSE + 3 * i + b) * 8 + g]
                w[(TURN + 9 * i + 3 * j + b) * 8 + g] = -w[(INVERSE + 3 * i + a) * 8 + g]
    for k in range(4):
        for j in range(3):
            a = (j + 1) % 3
            b = (j + 2) % 3
            for g in range(8):
                # Column j of [Y] is Y x e_j: components Y_b along e_a and -Y_a along e_b.
                w[(SWEEP + 9 * k + 3 * j + j) * 8 + g] = 0.0
                w[(SWEEP + 9 * k + 3 * a + j) * 8 + g] = w[(LOCAL + 3 * k + b) * 8 + g]
                w[(SWEEP + 9 * k + 3 * b + j) * 8 + g] = -w[(LOCAL + 3 * k + a) * 8 + g]


@njit(**KERNEL_OPTIONS)
def _fill_local_tangent(w, project):
    """Fill the tangent of the hourglass energy in the turned frame, rows and columns 3 * column + component."""
    for r in range(12):
        for j in range(3):
            for g in range(8):
                total = 0.0
                for c in range(12):
                    total += w[(MODE_STIFFNESS + 12 * r + c) * 8 + g] * w[(SWEEP + 3 * c + j) * 8 + g]
                w[(DRIVEN + 3 * r + j) * 8 + g] = total
    for i in range(3):
        for j in range(3):
            for g in range(8):
                total = 0.0
                for r in range(12):
                    # The transpose of [Y_k] is minus itself.
                    total -= w[(SWEEP + 3 * r + i) * 8 + g] * w[(DRIVEN + 3 * r + j) * 8 + g]
                w[(CURVATURE + 3 * i + j) * 8 + g] = total
    if not project:
        for k in range(4):
            for i in range(3):
                a = (i + 1) % 3
                b = (i + 2) % 3
                for g in range(8):
                    y_a = w[(LOCAL + 3 * k + a) * 8 + g]
                    y_b = w[(LOCAL + 3 * k + b) * 8 + g]
                    t_a = w[(LOCAL_FORCE + 3 * k + a) * 8 + g]
                    t_b = w[(LOCAL_FORCE + 3 * k + b) * 8 + g]
                    t_i = w[(LOCAL_FORCE + 3 * k + i) * 8 + g]
                    # -[T] [Y] = (T . Y) I - Y T^T.
                    w[(CURVATURE + 3 * i + i) * 8 + g] += t_a * y_a + t_b * y_b
                    w[(CURVATURE + 3 * a + i) * 8 + g] -= y_a * t_i
                    w[(CURVATURE + 3 * b + i) * 8 + g] -= y_b * t_i
                    # Minus [T_k]: column i has -T_b along e_a and T_a along e_b.
                    w[(DRIVEN + 9 * k + 3 * a + i) * 8 + g] -= t_b
                    w[(DRIVEN + 9 * k + 3 * b + i) * 8 + g] += t_a
        for i in range(3):
            for g in range(8):
                w[(SCRATCH + i) * 8 + g] = (
                    w[(STRETCH_TENSOR + 3 * i) * 8 + g] * w[MOMENT * 8 + g]
                    + w[(STRETCH_TENSOR + 3 * i + 1) * 8 + g] * w[(MOMENT + 1) * 8 + g]
                    + w[(STRETCH_TENSOR + 3 * i + 2) * 8 + g] * w[(MOMENT + 2) * 8 + g]
                )
        for j in range(3):
            a = (j + 1) % 3
            b = (j + 2) % 3
            for g in range(8):
                w[(CURVATURE + 3 * a + j) * 8 + g] += w[(SCRATCH + b) * 8 + g]
                w[(CURVATURE + 3 * b + j) * 8 + g] -= w[(SCRATCH + a) * 8 + g]
    for r in range(12):
        for c in range(12):
            for g in range(8):
                w[(TENSOR + 21 * (9 + r) + 9 + c) * 8 + g] = w[(MODE_STIFFNESS + 12 * r + c) * 8 + g]
        for c in range(9):
            for g in range(8):
                total = (
                    w[(DRIVEN + 3 * r) * 8 + g] * w[(TURN + c) * 8 + g]
                    + w[(DRIVEN + 3 * r + 1) * 8 + g] * w[(TURN + 9 + c) * 8 + g]
                    + w[(DRIVEN + 3 * r + 2) * 8 + g] * w[(TURN + 18 + c) * 8 + g]
                )
                w[(TENSOR + 21 * (9 + r) + c) * 8 + g] = total
                w[(TENSOR + 21 * c + 9 + r) * 8 + g] = total
    for c in range(9):
        for i in range(3):
            for g in range(8):
                w[(SCRATCH + i) * 8 + g] = (
                    w[(CURVATURE + 3 * i) * 8 + g] * w[(TURN + c) * 8 + g]
                    + w[(CURVATURE + 3 * i + 1) * 8 + g] * w[(TURN + 9 + c) * 8 + g]
                    + w[(CURVATURE + 3 * i + 2) * 8 + g] * w[(TURN + 18 + c) * 8 + g]
                )
        if not project:
            # Column c = 3 j + m of R^T dF0: minus n where the trace changes, plus n_j along e_m.
            column = c // 3
            m = c % 3
            for g in range(8):
                w[(SCRATCH + m) * 8 + g] += w[(MOMENT + column) * 8 + g]
            if column == m:
                for i in range(3):
                    for g in range(8):
                        w[(SCRATCH + i) * 8 + g] -= w[(MOMENT + i) * 8 + g]
        for r in range(9):
            for g in range(8):
                w[(TENSOR + 21 * r + c) * 8 + g] = -(
                    w[(TURN + r) * 8 + g] * w[SCRATCH * 8 + g]
                    + w[(TURN + 9 + r) * 8 + g] * w[(SCRATCH + 1) * 8 + g]
                    + w[(TURN + 18 + r) * 8 + g] * w[(SCRATCH + 2) * 8 + g]
                )
        if not project:
            # Minus [e_j x n] omega.
            for j in range(3):
                for i in range(3):
                    a = (i + 1) % 3
                    b = (i + 2) % 3
                    for g in range(8):
                        # (e_j x n)_i, by component.
                        p_a = _cross(w, j, a, g)
                        p_b = _cross(w, j, b, g)
                        w[(TENSOR + 21 * (3 * j + i) + c) * 8 + g] -= (
                            p_a * w[(TURN + 9 * b + c) * 8 + g] - p_b * w[(TURN + 9 * a + c) * 8 + g]
                        )


@njit(**KERNEL_OPTIONS)
def _cross(w, j, i, g):
    """Component i of e_j x n in lane g."""
    if i == (j + 2) % 3:
        return w[(MOMENT + (j + 1) % 3) * 8 + g]
    if i == (j + 1) % 3:
        return -w[(MOMENT + (j + 2) % 3) * 8 + g]
    return 0.0


@njit(**KERNEL_OPTIONS)
def _rotate_tangent(w):
    """Turn every 3 x 3 block of the local tangent back to the frame of space: R T R^T."""
    for p in range(COLUMNS):
        for q in range(COLUMNS):
            base = TENSOR + 63 * p + 3 * q
            for i in range(3):
                for m in range(3):
                    for g in range(8):
                        w[(SCRATCH + 3 * i + m) * 8 + g] = (
                            w[(ROTATION + 3 * i) * 8 + g] * w[(base + m) * 8 + g]
                            + w[(ROTATION + 3 * i + 1) * 8 + g] * w[(base + 21 + m) * 8 + g]
                            + w[(ROTATION + 3 * i + 2) * 8 + g] * w[(base + 42 + m) * 8 + g]
                        )
            for i in range(3):
                for k in range(3):
                    for g in range(8):
                        w[(base + 21 * i + k) * 8 + g] = (
                            w[(SCRATCH + 3 * i) * 8 + g] * w[(ROTATION + 3 * k) * 8 + g]
                            + w[(SCRATCH + 3 * i + 1) * 8 + g] * w[(ROTATION + 3 * k + 1) * 8 + g]
                            + w[(SCRATCH + 3 * i + 2) * 8 + g] * w[(ROTATION + 3 * k + 2) * 8 + g]
                        )


@njit(**KERNEL_OPTIONS)
def _add_mean_tangent(w):
    """Add TANGENT, of the mean deformation gradient, to the tangent by column and component."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    for g in range(8):
                        w[(TENSOR + 21 * (3 * j + i) + 3 * m + k) * 8 + g] += w[
                            (TANGENT + 9 * (3 * i + j) + 3 * k + m) * 8 + g
                        ]


@njit(**KERNEL_OPTIONS)
def fill_tensor(w, hourglass, viscous_modulus, velocity_factor, project):
    """Fill the tangent by column and component from TANGENT and the stiffness of the hourglass modes (3, 144 * 8).

    viscous_modulus (8) is zero without viscosity.
    """
    for r in range(144):
        for g in range(8):
            w[(MODE_STIFFNESS + r) * 8 + g] = hourglass[0, r * 8 + g] + viscous_modulus[g] * hourglass[1, r * 8 + g]
    _fill_turn(w)
    _fill_local_tangent(w, project)
    _rotate_tangent(w)
    _add_mean_tangent(w)
    if velocity_factor > 0.0:
        for r in range(12):
            for c in range(12):
                for g in range(8):
                    w[(TENSOR + 21 * (9 + r) + 9 + c) * 8 + g] += velocity_factor * hourglass[2, (12 * r + c) * 8 + g]


@njit(**KERNEL_OPTIONS)
def fill_block(w, columns, i, k):
    """Fill the block of components i and k of the stiffness from the tangent by column and component."""
    for p in range(COLUMNS):
        for n in range(8):
            _over_columns(w, (NODAL_PRODUCT + 8 * p + n) * 8, w, (TENSOR + 21 * (3 * p + i) + k) * 8, columns, 8 * n)
    for n in range(8):
        for m in range(8):
            _nodes_over_columns(w, (BLOCK + 8 * n + m) * 8, columns, 8 * n, w, (NODAL_PRODUCT + m) * 8)
