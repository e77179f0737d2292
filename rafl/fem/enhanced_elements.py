"""Compiled kernels for cells with one integration point and stabilised hourglass modes; see `rafl.fem.hourglass`.

The SIMD lanes of the scratch array are eight cells. Its first rows are those of `rafl.fem.kernel_layout`, with the mean
deformation gradient of each cell; the rows defined here follow. Vectors and matrices of the hourglass modes are in the
frame that the polar rotation R of the mean deformation gradient carries along. [v] is the matrix of the cross product
with v. A variation of F0 turns the frame by omega = sum_j L_j R^T dF0 e_j with L_j = G^-1 [e_j], G = tr(S) I - S and
S = R^T F0.
"""

import numpy as np
from numba import njit, prange

from rafl.fem.elements import add_damping_stress, add_viscous_stress, fill_stress, fill_tangent, project_semidefinite
from rafl.fem.kernel_layout import DEFORMATION, ENERGY, STRESS, STRETCH, TANGENT, WEIGHT, U, V
from rafl.fem.laws.kernel import fill_derivatives
from rafl.fem.simd import KERNEL_OPTIONS, lane_products
from rafl.fem.svd import signed_svd_simd

COLUMNS = 7  # of the local tangent: three of the deformation gradient, four hourglass vectors
_GROUPS_PER_CHUNK = 4  # groups of eight cells in one task of a thread
_MIN_ROTATION_STIFFNESS = 1e-8  # of G, relative to no stretch: bounds the rotation of a flattened cell

# Rows of the scratch array after those of `rafl.fem.kernel_layout`.
_POSITIONS = 308  # nodal positions (8 nodes, 3 components), 24
_VECTORS = 332  # hourglass vectors Gamma, 12
_ROTATION = 344  # R, 9
_LOCAL = 353  # Y = R^T Gamma, 12
_LOCAL_FORCE = 365  # derivative of the energy by Y, 12
_INVERSE = 377  # G^-1, 9
_STRETCH_TENSOR = 386  # S, 9
_MOMENT = 395  # n = G^-1 sum_k Y_k x T_k, 3
_TURN = 398  # omega per column of R^T dF0: L, (3, 9), 27
_SWEEP = 425  # change of Y per omega: [Y_k], (12, 3), 36
_DRIVEN = 461  # stiffness times sweep, minus [T_k], (12, 3), 36
_CURVATURE = 497  # C = M + [S n], (3, 3), 9
_STIFFNESS = 506  # derivative of the force by Y, (12, 12), 144
_TENSOR = 650  # the tangent by column and component, (21, 21), 441
_PRODUCT = 1091  # tangent times nodal columns, (7, 8), 56
_NODAL = 1147  # nodal forces (8 nodes, 3 components), 24
_VELOCITY = 1171  # nodal velocities (8 nodes, 3), 24
_RATE = 1195  # gradient of the velocity, 9
_RATE_VECTORS = 1204  # hourglass vectors of the velocity, 12
_TEMPORARY = 1216  # 12
_BLOCK = 1228  # one component block of the stiffness, (8, 8), 64
_ROWS = 1292

_over_nodes = lane_products(8, 24, 8)
_over_modes = lane_products(12, 8, 8)
_over_columns = lane_products(COLUMNS, 24, 64)
_nodes_over_columns = lane_products(COLUMNS, 64, 64)


@njit(**KERNEL_OPTIONS)
def _fill_kinematics(w, columns):
    """Fill DEFORMATION and the hourglass vectors from the nodal positions; columns (7 * 8 * 8) of the lanes' cells."""
    for i in range(3):
        for j in range(3):
            _over_nodes(w, (DEFORMATION + 3 * i + j) * 8, w, (_POSITIONS + i) * 8, columns, 64 * j)
        for k in range(4):
            _over_nodes(w, (_VECTORS + 3 * k + i) * 8, w, (_POSITIONS + i) * 8, columns, 64 * (3 + k))


@njit(**KERNEL_OPTIONS)
def _fill_frame(w):
    """Fill R, S, G^-1 and Y from the singular vectors and the hourglass vectors."""
    for i in range(3):
        for j in range(3):
            for g in range(8):
                w[(_ROTATION + 3 * i + j) * 8 + g] = (
                    w[(U + 3 * i) * 8 + g] * w[(V + 3 * j) * 8 + g]
                    + w[(U + 3 * i + 1) * 8 + g] * w[(V + 3 * j + 1) * 8 + g]
                    + w[(U + 3 * i + 2) * 8 + g] * w[(V + 3 * j + 2) * 8 + g]
                )
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        for g in range(8):
            total = w[(STRETCH + b) * 8 + g] + w[(STRETCH + c) * 8 + g]
            total = total if abs(total) > _MIN_ROTATION_STIFFNESS else np.copysign(_MIN_ROTATION_STIFFNESS, total)
            w[(_TEMPORARY + a) * 8 + g] = 1.0 / total
    for i in range(3):
        for j in range(3):
            for g in range(8):
                inverse = 0.0
                stretch = 0.0
                for a in range(3):
                    product = w[(V + 3 * i + a) * 8 + g] * w[(V + 3 * j + a) * 8 + g]
                    inverse += product * w[(_TEMPORARY + a) * 8 + g]
                    stretch += product * w[(STRETCH + a) * 8 + g]
                w[(_INVERSE + 3 * i + j) * 8 + g] = inverse
                w[(_STRETCH_TENSOR + 3 * i + j) * 8 + g] = stretch
    for k in range(4):
        for i in range(3):
            for g in range(8):
                w[(_LOCAL + 3 * k + i) * 8 + g] = (
                    w[_ROTATION * 8 + (3 * 0 + i) * 8 + g] * w[(_VECTORS + 3 * k) * 8 + g]
                    + w[_ROTATION * 8 + (3 * 1 + i) * 8 + g] * w[(_VECTORS + 3 * k + 1) * 8 + g]
                    + w[_ROTATION * 8 + (3 * 2 + i) * 8 + g] * w[(_VECTORS + 3 * k + 2) * 8 + g]
                )


@njit(**KERNEL_OPTIONS)
def _fill_moment(w):
    """Fill n = G^-1 sum_k Y_k x T_k."""
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        for g in range(8):
            moment = 0.0
            for k in range(4):
                moment += (
                    w[(_LOCAL + 3 * k + a) * 8 + g] * w[(_LOCAL_FORCE + 3 * k + b) * 8 + g]
                    - w[(_LOCAL + 3 * k + b) * 8 + g] * w[(_LOCAL_FORCE + 3 * k + a) * 8 + g]
                )
            w[(_TEMPORARY + i) * 8 + g] = moment
    for i in range(3):
        for g in range(8):
            w[(_MOMENT + i) * 8 + g] = (
                w[(_INVERSE + 3 * i) * 8 + g] * w[_TEMPORARY * 8 + g]
                + w[(_INVERSE + 3 * i + 1) * 8 + g] * w[(_TEMPORARY + 1) * 8 + g]
                + w[(_INVERSE + 3 * i + 2) * 8 + g] * w[(_TEMPORARY + 2) * 8 + g]
            )


@njit(**KERNEL_OPTIONS)
def _add_hourglass_force(w, elastic, viscous, viscous_modulus, memory):
    """Fill the local force and n; add the energy of the hourglass modes to ENERGY, per unit of WEIGHT.

    elastic, viscous (144 * 8): rows of stiffness; memory (12, 8).
    """
    for r in range(12):
        _over_modes(w, (_LOCAL_FORCE + r) * 8, w, _LOCAL * 8, elastic, 12 * r * 8)
    for g in range(8):
        w[_TEMPORARY * 8 + g] = 0.0
    for r in range(12):
        for g in range(8):
            w[_TEMPORARY * 8 + g] += 0.5 * w[(_LOCAL + r) * 8 + g] * w[(_LOCAL_FORCE + r) * 8 + g]
    if viscous_modulus > 0.0:
        for g in range(8):
            for r in range(12):
                total = 0.0
                for c in range(12):
                    strain = viscous_modulus * w[(_LOCAL + c) * 8 + g] - memory[c, g]
                    total += viscous[(12 * r + c) * 8 + g] * strain
                own = viscous_modulus * w[(_LOCAL + r) * 8 + g] - memory[r, g]
                w[(_LOCAL_FORCE + r) * 8 + g] += total
                w[_TEMPORARY * 8 + g] += 0.5 / viscous_modulus * own * total
    for g in range(8):
        if w[WEIGHT * 8 + g] > 0.0:
            w[ENERGY * 8 + g] += w[_TEMPORARY * 8 + g] / w[WEIGHT * 8 + g]
    _fill_moment(w)


@njit(**KERNEL_OPTIONS)
def _add_frame_stress(w):
    """Add R (e_j x n), the force that turns the hourglass frame, to column j of STRESS."""
    for j in range(3):
        a = (j + 1) % 3
        b = (j + 2) % 3
        for i in range(3):
            for g in range(8):
                # e_j x n has components n_a along e_b and -n_b along e_a.
                w[(STRESS + 3 * i + j) * 8 + g] += (
                    w[(_ROTATION + 3 * i + b) * 8 + g] * w[(_MOMENT + a) * 8 + g]
                    - w[(_ROTATION + 3 * i + a) * 8 + g] * w[(_MOMENT + b) * 8 + g]
                )


@njit(**KERNEL_OPTIONS)
def _fill_turn(w):
    """Fill omega per column of R^T dF0, L_j = G^-1 [e_j], and the sweep [Y_k]."""
    for j in range(3):
        a = (j + 1) % 3
        b = (j + 2) % 3
        for i in range(3):
            for g in range(8):
                # [e_j] e_a = e_b and [e_j] e_b = -e_a.
                w[(_TURN + 9 * i + 3 * j + j) * 8 + g] = 0.0
                w[(_TURN + 9 * i + 3 * j + a) * 8 + g] = w[(_INVERSE + 3 * i + b) * 8 + g]
                w[(_TURN + 9 * i + 3 * j + b) * 8 + g] = -w[(_INVERSE + 3 * i + a) * 8 + g]
    for k in range(4):
        for j in range(3):
            a = (j + 1) % 3
            b = (j + 2) % 3
            for g in range(8):
                # Column j of [Y] is Y x e_j: components Y_b along e_a and -Y_a along e_b.
                w[(_SWEEP + 9 * k + 3 * j + j) * 8 + g] = 0.0
                w[(_SWEEP + 9 * k + 3 * a + j) * 8 + g] = w[(_LOCAL + 3 * k + b) * 8 + g]
                w[(_SWEEP + 9 * k + 3 * b + j) * 8 + g] = -w[(_LOCAL + 3 * k + a) * 8 + g]


@njit(**KERNEL_OPTIONS)
def _fill_local_tangent(w, project):
    """Fill the tangent of the hourglass energy in the turned frame, rows and columns 3 * column + component."""
    for r in range(12):
        for j in range(3):
            for g in range(8):
                total = 0.0
                for c in range(12):
                    total += w[(_STIFFNESS + 12 * r + c) * 8 + g] * w[(_SWEEP + 3 * c + j) * 8 + g]
                w[(_DRIVEN + 3 * r + j) * 8 + g] = total
    for i in range(3):
        for j in range(3):
            for g in range(8):
                total = 0.0
                for r in range(12):
                    # The transpose of [Y_k] is minus itself.
                    total -= w[(_SWEEP + 3 * r + i) * 8 + g] * w[(_DRIVEN + 3 * r + j) * 8 + g]
                w[(_CURVATURE + 3 * i + j) * 8 + g] = total
    if not project:
        for k in range(4):
            for i in range(3):
                a = (i + 1) % 3
                b = (i + 2) % 3
                for g in range(8):
                    y_a = w[(_LOCAL + 3 * k + a) * 8 + g]
                    y_b = w[(_LOCAL + 3 * k + b) * 8 + g]
                    t_a = w[(_LOCAL_FORCE + 3 * k + a) * 8 + g]
                    t_b = w[(_LOCAL_FORCE + 3 * k + b) * 8 + g]
                    t_i = w[(_LOCAL_FORCE + 3 * k + i) * 8 + g]
                    # -[T] [Y] = (T . Y) I - Y T^T.
                    w[(_CURVATURE + 3 * i + i) * 8 + g] += t_a * y_a + t_b * y_b
                    w[(_CURVATURE + 3 * a + i) * 8 + g] -= y_a * t_i
                    w[(_CURVATURE + 3 * b + i) * 8 + g] -= y_b * t_i
                    # Minus [T_k]: column i has -T_b along e_a and T_a along e_b.
                    w[(_DRIVEN + 9 * k + 3 * a + i) * 8 + g] -= t_b
                    w[(_DRIVEN + 9 * k + 3 * b + i) * 8 + g] += t_a
        for i in range(3):
            for g in range(8):
                w[(_TEMPORARY + i) * 8 + g] = (
                    w[(_STRETCH_TENSOR + 3 * i) * 8 + g] * w[_MOMENT * 8 + g]
                    + w[(_STRETCH_TENSOR + 3 * i + 1) * 8 + g] * w[(_MOMENT + 1) * 8 + g]
                    + w[(_STRETCH_TENSOR + 3 * i + 2) * 8 + g] * w[(_MOMENT + 2) * 8 + g]
                )
        for j in range(3):
            a = (j + 1) % 3
            b = (j + 2) % 3
            for g in range(8):
                w[(_CURVATURE + 3 * a + j) * 8 + g] += w[(_TEMPORARY + b) * 8 + g]
                w[(_CURVATURE + 3 * b + j) * 8 + g] -= w[(_TEMPORARY + a) * 8 + g]
    for r in range(12):
        for c in range(12):
            for g in range(8):
                w[(_TENSOR + 21 * (9 + r) + 9 + c) * 8 + g] = w[(_STIFFNESS + 12 * r + c) * 8 + g]
        for c in range(9):
            for g in range(8):
                total = (
                    w[(_DRIVEN + 3 * r) * 8 + g] * w[(_TURN + c) * 8 + g]
                    + w[(_DRIVEN + 3 * r + 1) * 8 + g] * w[(_TURN + 9 + c) * 8 + g]
                    + w[(_DRIVEN + 3 * r + 2) * 8 + g] * w[(_TURN + 18 + c) * 8 + g]
                )
                w[(_TENSOR + 21 * (9 + r) + c) * 8 + g] = total
                w[(_TENSOR + 21 * c + 9 + r) * 8 + g] = total
    for c in range(9):
        for i in range(3):
            for g in range(8):
                w[(_TEMPORARY + i) * 8 + g] = (
                    w[(_CURVATURE + 3 * i) * 8 + g] * w[(_TURN + c) * 8 + g]
                    + w[(_CURVATURE + 3 * i + 1) * 8 + g] * w[(_TURN + 9 + c) * 8 + g]
                    + w[(_CURVATURE + 3 * i + 2) * 8 + g] * w[(_TURN + 18 + c) * 8 + g]
                )
        if not project:
            # Column c = 3 j + m of R^T dF0: minus n where the trace changes, plus n_j along e_m.
            column = c // 3
            m = c % 3
            for g in range(8):
                w[(_TEMPORARY + m) * 8 + g] += w[(_MOMENT + column) * 8 + g]
            if column == m:
                for i in range(3):
                    for g in range(8):
                        w[(_TEMPORARY + i) * 8 + g] -= w[(_MOMENT + i) * 8 + g]
        for r in range(9):
            for g in range(8):
                w[(_TENSOR + 21 * r + c) * 8 + g] = -(
                    w[(_TURN + r) * 8 + g] * w[_TEMPORARY * 8 + g]
                    + w[(_TURN + 9 + r) * 8 + g] * w[(_TEMPORARY + 1) * 8 + g]
                    + w[(_TURN + 18 + r) * 8 + g] * w[(_TEMPORARY + 2) * 8 + g]
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
                        w[(_TENSOR + 21 * (3 * j + i) + c) * 8 + g] -= (
                            p_a * w[(_TURN + 9 * b + c) * 8 + g] - p_b * w[(_TURN + 9 * a + c) * 8 + g]
                        )


@njit(**KERNEL_OPTIONS)
def _cross(w, j, i, g):
    """Component i of e_j x n in lane g."""
    if i == (j + 2) % 3:
        return w[(_MOMENT + (j + 1) % 3) * 8 + g]
    if i == (j + 1) % 3:
        return -w[(_MOMENT + (j + 2) % 3) * 8 + g]
    return 0.0


@njit(**KERNEL_OPTIONS)
def _rotate_tangent(w):
    """Turn every 3 x 3 block of the local tangent back to the frame of space: R T R^T."""
    for p in range(COLUMNS):
        for q in range(COLUMNS):
            base = _TENSOR + 63 * p + 3 * q
            for i in range(3):
                for m in range(3):
                    for g in range(8):
                        w[(_TEMPORARY + 3 * i + m) * 8 + g] = (
                            w[(_ROTATION + 3 * i) * 8 + g] * w[(base + m) * 8 + g]
                            + w[(_ROTATION + 3 * i + 1) * 8 + g] * w[(base + 21 + m) * 8 + g]
                            + w[(_ROTATION + 3 * i + 2) * 8 + g] * w[(base + 42 + m) * 8 + g]
                        )
            for i in range(3):
                for k in range(3):
                    for g in range(8):
                        w[(base + 21 * i + k) * 8 + g] = (
                            w[(_TEMPORARY + 3 * i) * 8 + g] * w[(_ROTATION + 3 * k) * 8 + g]
                            + w[(_TEMPORARY + 3 * i + 1) * 8 + g] * w[(_ROTATION + 3 * k + 1) * 8 + g]
                            + w[(_TEMPORARY + 3 * i + 2) * 8 + g] * w[(_ROTATION + 3 * k + 2) * 8 + g]
                        )


@njit(**KERNEL_OPTIONS)
def _add_mean_tangent(w):
    """Add TANGENT, of the mean deformation gradient, to the tangent by column and component."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    for g in range(8):
                        w[(_TENSOR + 21 * (3 * j + i) + 3 * m + k) * 8 + g] += w[
                            (TANGENT + 9 * (3 * i + j) + 3 * k + m) * 8 + g
                        ]


@njit(**KERNEL_OPTIONS)
def _fill_tensor(w, hourglass, viscous_modulus, velocity_factor, project):
    """Fill the tangent by column and component from TANGENT and the stiffness of the hourglass modes (3, 144 * 8)."""
    for r in range(144):
        for g in range(8):
            w[(_STIFFNESS + r) * 8 + g] = hourglass[0, r * 8 + g] + viscous_modulus * hourglass[1, r * 8 + g]
    _fill_turn(w)
    _fill_local_tangent(w, project)
    _rotate_tangent(w)
    _add_mean_tangent(w)
    if velocity_factor > 0.0:
        for r in range(12):
            for c in range(12):
                for g in range(8):
                    w[(_TENSOR + 21 * (9 + r) + 9 + c) * 8 + g] += velocity_factor * hourglass[2, (12 * r + c) * 8 + g]


@njit(**KERNEL_OPTIONS)
def _fill_block(w, columns, i, k):
    """Fill the block of components i and k of the stiffness from the tangent by column and component."""
    for p in range(COLUMNS):
        for n in range(8):
            _over_columns(w, (_PRODUCT + 8 * p + n) * 8, w, (_TENSOR + 21 * (3 * p + i) + k) * 8, columns, 8 * n)
    for n in range(8):
        for m in range(8):
            _nodes_over_columns(w, (_BLOCK + 8 * n + m) * 8, columns, 8 * n, w, (_PRODUCT + m) * 8)


@njit(parallel=True, **KERNEL_OPTIONS)
def enhanced_terms(
    q,
    cells,
    hexes,
    columns,
    volume,
    law,
    moduli,
    hourglass,
    per_shape,
    viscous,
    memory,
    hourglass_memory,
    damped,
    velocity_offset,
    velocity_factor,
    project,
    tangent,
    energy,
    gradient,
    stiffness,
):
    """Fill energy (B), nodal gradient (B, N, 3) and, if `tangent`, stiffness (B, E, 6, 8, 8).

    Args:
        q: positions [m], (B, N, 3).
        cells: which cell each lane has, (G, 8); the last group repeats a cell in its unused lanes.
        hexes: (E, 8).
        columns: mean shape function gradients [1/m] and hourglass vectors of each lane, (G, 7 * 8 nodes * 8 lanes).
        volume: of the lanes' cells [m^3], zero in unused lanes, (G, 8).
        law: address of the elastic law's compiled derivatives, `rafl.fem.laws.law.Law.kernel.address`.
        moduli: see `rafl.fem.constitutive_state.MODULI`, (B, 5).
        hourglass: elastic, viscous and damping stiffness by lane, (B, G or 1, 3, 144 * 8 lanes).
        per_shape: whether `hourglass` has one set for all groups.
        viscous: whether viscous stress acts, with the next two arguments.
        memory: of the viscous stress [Pa], (B, E, 1, 6).
        hourglass_memory: [Pa m], (B, E, 12).
        damped: whether stiffness damping acts, with the next two arguments.
        velocity_offset: velocities are velocity_factor * q - velocity_offset, (B, N, 3) [m/s].
        velocity_factor: [1/s].
        project: make the tangent positive semi-definite.
        tangent: whether to compute the stiffness.
        energy, gradient, stiffness: [J], [N], [N/m]; outputs.
    """
    batch, groups = q.shape[0], len(cells)
    chunks = (groups + _GROUPS_PER_CHUNK - 1) // _GROUPS_PER_CHUNK
    force = np.empty((batch, groups, 24, 8))
    chunk_energy = np.empty((batch, chunks))
    for task in prange(batch * chunks):
        t = task // chunks
        chunk = task % chunks
        w = np.zeros(_ROWS * 8)
        lane_memory = np.zeros((8, 6))
        lane_hourglass_memory = np.zeros((12, 8))
        rate = np.zeros((9, 8))
        total = 0.0
        for group in range(chunk * _GROUPS_PER_CHUNK, min(groups, (chunk + 1) * _GROUPS_PER_CHUNK)):
            own = hourglass[t, 0 if per_shape else group]
            for g in range(8):
                e = cells[group, g]
                w[WEIGHT * 8 + g] = volume[group, g]
                for n in range(8):
                    node = hexes[e, n]
                    for i in range(3):
                        w[(_POSITIONS + 3 * n + i) * 8 + g] = q[t, node, i]
                        if damped:
                            w[(_VELOCITY + 3 * n + i) * 8 + g] = (
                                velocity_factor * q[t, node, i] - velocity_offset[t, node, i]
                            )
                if viscous:
                    for c in range(6):
                        lane_memory[g, c] = memory[t, e, 0, c]
                    for c in range(12):
                        lane_hourglass_memory[c, g] = hourglass_memory[t, e, c]
            _fill_kinematics(w, columns[group])
            signed_svd_simd(w)
            fill_derivatives(law, w, moduli[t, 0], moduli[t, 1])
            fill_stress(w)
            if tangent:
                if project:
                    project_semidefinite(w)
                fill_tangent(w)
            viscous_modulus = moduli[t, 2] if viscous else 0.0
            if viscous_modulus > 0.0:
                add_viscous_stress(w, viscous_modulus, lane_memory, project, tangent)
            if damped:
                for i in range(3):
                    for j in range(3):
                        _over_nodes(w, (_RATE + 3 * i + j) * 8, w, (_VELOCITY + i) * 8, columns[group], 64 * j)
                        for g in range(8):
                            rate[3 * i + j, g] = w[(_RATE + 3 * i + j) * 8 + g]
                    for k in range(4):
                        _over_nodes(
                            w, (_RATE_VECTORS + 3 * k + i) * 8, w, (_VELOCITY + i) * 8, columns[group], 64 * (3 + k)
                        )
                add_damping_stress(w, moduli[t, 3], moduli[t, 4], rate, velocity_factor, tangent)
            _fill_frame(w)
            _add_hourglass_force(w, own[0], own[1], viscous_modulus, lane_hourglass_memory)
            _add_frame_stress(w)
            # Forces of the seven columns: stress, then the hourglass forces in the frame of space.
            for k in range(4):
                for i in range(3):
                    for g in range(8):
                        w[(_VECTORS + 3 * k + i) * 8 + g] = (
                            w[(_ROTATION + 3 * i) * 8 + g] * w[(_LOCAL_FORCE + 3 * k) * 8 + g]
                            + w[(_ROTATION + 3 * i + 1) * 8 + g] * w[(_LOCAL_FORCE + 3 * k + 1) * 8 + g]
                            + w[(_ROTATION + 3 * i + 2) * 8 + g] * w[(_LOCAL_FORCE + 3 * k + 2) * 8 + g]
                        )
            if damped:
                for r in range(12):
                    for g in range(8):
                        w[_TEMPORARY * 8 + g] = 0.0
                    for c in range(12):
                        for g in range(8):
                            w[_TEMPORARY * 8 + g] += own[2, (12 * r + c) * 8 + g] * w[(_RATE_VECTORS + c) * 8 + g]
                    for g in range(8):
                        w[(_VECTORS + r) * 8 + g] += w[_TEMPORARY * 8 + g]
                        if w[WEIGHT * 8 + g] > 0.0:
                            w[ENERGY * 8 + g] += (
                                0.5
                                / velocity_factor
                                * w[(_RATE_VECTORS + r) * 8 + g]
                                * w[_TEMPORARY * 8 + g]
                                / w[WEIGHT * 8 + g]
                            )
            for n in range(8):
                for i in range(3):
                    for g in range(8):
                        value = 0.0
                        for j in range(3):
                            value += w[(STRESS + 3 * i + j) * 8 + g] * columns[group, (8 * j + n) * 8 + g]
                        for k in range(4):
                            value += w[(_VECTORS + 3 * k + i) * 8 + g] * columns[group, (8 * (3 + k) + n) * 8 + g]
                        force[t, group, 3 * n + i, g] = value
            for g in range(8):
                total += w[WEIGHT * 8 + g] * w[ENERGY * 8 + g]
            if tangent:
                _fill_tensor(w, own, viscous_modulus, velocity_factor if damped else 0.0, project)
                for block in range(6):
                    _fill_block(w, columns[group], (0, 1, 1, 2, 2, 2)[block], (0, 0, 1, 0, 1, 2)[block])
                    for g in range(8):
                        if volume[group, g] > 0.0:
                            out = stiffness[t, cells[group, g], block]
                            for n in range(8):
                                for m in range(8):
                                    out[n, m] = w[(_BLOCK + 8 * n + m) * 8 + g]
        chunk_energy[t, chunk] = total
    for t in prange(batch):
        energy[t] = chunk_energy[t].sum()
        gradient[t] = 0.0
        for group in range(groups):
            for g in range(8):
                if volume[group, g] > 0.0:
                    e = cells[group, g]
                    for n in range(8):
                        for i in range(3):
                            gradient[t, hexes[e, n], i] += force[t, group, 3 * n + i, g]


@njit(parallel=True, **KERNEL_OPTIONS)
def enhanced_measures(q, direction, cells, hexes, columns, volume, strain, local, strain_change, local_change):
    """Fill Green strain (B, E, 6) and hourglass vectors Y (B, E, 12) [m], and their changes along `direction`.

    q [m] and direction (B, N, 3); components of strain 00 11 22 01 12 02; cells, columns and volume as of
    `enhanced_terms`.
    """
    groups = len(cells)
    for task in prange(q.shape[0] * groups):
        t = task // groups
        group = task % groups
        w = np.zeros(_ROWS * 8)
        change = np.zeros((9, 8))
        change_vectors = np.zeros((12, 8))
        for g in range(8):
            for n in range(8):
                node = hexes[cells[group, g], n]
                for i in range(3):
                    w[(_POSITIONS + 3 * n + i) * 8 + g] = q[t, node, i]
                    for j in range(3):
                        change[3 * i + j, g] += direction[t, node, i] * columns[group, (8 * j + n) * 8 + g]
                    for k in range(4):
                        change_vectors[3 * k + i, g] += (
                            direction[t, node, i] * columns[group, (8 * (3 + k) + n) * 8 + g]
                        )
        _fill_kinematics(w, columns[group])
        signed_svd_simd(w)
        _fill_frame(w)
        turn = np.empty(3)
        axial = np.empty(3)
        local_rate = np.empty((3, 3))
        for g in range(8):
            if not volume[group, g] > 0.0:
                continue
            e = cells[group, g]
            for i in range(3):
                for j in range(i, 3):
                    component = i if i == j else (5 if j - i == 2 else 3 + i)
                    green = -0.5 if i == j else 0.0
                    rate = 0.0
                    for k in range(3):
                        a = w[(DEFORMATION + 3 * k + i) * 8 + g]
                        b = w[(DEFORMATION + 3 * k + j) * 8 + g]
                        green += 0.5 * a * b
                        rate += 0.5 * (change[3 * k + i, g] * b + a * change[3 * k + j, g])
                    strain[t, e, component] = green
                    strain_change[t, e, component] = rate
            for i in range(3):
                for j in range(3):
                    local_rate[i, j] = 0.0
                    for k in range(3):
                        local_rate[i, j] += w[(_ROTATION + 3 * k + i) * 8 + g] * change[3 * k + j, g]
            for i in range(3):
                axial[i] = local_rate[(i + 2) % 3, (i + 1) % 3] - local_rate[(i + 1) % 3, (i + 2) % 3]
            for i in range(3):
                turn[i] = 0.0
                for j in range(3):
                    turn[i] += w[(_INVERSE + 3 * i + j) * 8 + g] * axial[j]
            for k in range(4):
                for i in range(3):
                    a = (i + 1) % 3
                    b = (i + 2) % 3
                    value = 0.0
                    for j in range(3):
                        value += w[(_ROTATION + 3 * j + i) * 8 + g] * change_vectors[3 * k + j, g]
                    value -= turn[a] * w[(_LOCAL + 3 * k + b) * 8 + g] - turn[b] * w[(_LOCAL + 3 * k + a) * 8 + g]
                    local[t, e, 3 * k + i] = w[(_LOCAL + 3 * k + i) * 8 + g]
                    local_change[t, e, 3 * k + i] = value


@njit(parallel=True, **KERNEL_OPTIONS)
def enhanced_measures_adjoint(q, by_strain, by_local, cells, hexes, columns, volume, out):
    """Fill out (B, N, 3): the derivative by q of sum by_strain * strain + by_local * Y of `enhanced_measures`.

    by_strain (B, E, 6), by_local (B, E, 12); the other arguments as of `enhanced_measures`.
    """
    groups = len(cells)
    force = np.zeros((q.shape[0], groups, 24, 8))
    for task in prange(q.shape[0] * groups):
        t = task // groups
        group = task % groups
        w = np.zeros(_ROWS * 8)
        for g in range(8):
            for n in range(8):
                node = hexes[cells[group, g], n]
                for i in range(3):
                    w[(_POSITIONS + 3 * n + i) * 8 + g] = q[t, node, i]
        _fill_kinematics(w, columns[group])
        signed_svd_simd(w)
        _fill_frame(w)
        for g in range(8):
            for r in range(12):
                w[(_LOCAL_FORCE + r) * 8 + g] = by_local[t, cells[group, g], r]
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(3):
                        low, high = min(j, k), max(j, k)
                        component = low if low == high else (5 if high - low == 2 else 3 + low)
                        share = 1.0 if low == high else 0.5
                        total += share * by_strain[t, cells[group, g], component] * w[(DEFORMATION + 3 * i + k) * 8 + g]
                    w[(STRESS + 3 * i + j) * 8 + g] = total
        _fill_moment(w)
        _add_frame_stress(w)
        for g in range(8):
            for n in range(8):
                for i in range(3):
                    value = 0.0
                    for j in range(3):
                        value += w[(STRESS + 3 * i + j) * 8 + g] * columns[group, (8 * j + n) * 8 + g]
                    for k in range(4):
                        along = 0.0
                        for j in range(3):
                            along += w[(_ROTATION + 3 * i + j) * 8 + g] * w[(_LOCAL_FORCE + 3 * k + j) * 8 + g]
                        value += along * columns[group, (8 * (3 + k) + n) * 8 + g]
                    force[t, group, 3 * n + i, g] = value
    for t in prange(q.shape[0]):
        out[t] = 0.0
        for group in range(groups):
            for g in range(8):
                if volume[group, g] > 0.0:
                    for n in range(8):
                        for i in range(3):
                            out[t, hexes[cells[group, g], n], i] += force[t, group, 3 * n + i, g]
