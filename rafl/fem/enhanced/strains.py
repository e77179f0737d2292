"""Strains of cells with stabilised hourglass modes, their change along a direction, and the adjoint."""

import numpy as np
from numba import njit, prange

from rafl.fem.enhanced.frame import add_frame_stress, fill_frame, fill_kinematics, fill_moment
from rafl.fem.enhanced.layout import ENHANCED_ROWS, INVERSE, LOCAL, LOCAL_FORCE, POSITIONS, ROTATION
from rafl.fem.kernel_layout import DEFORMATION, STRESS
from rafl.fem.simd import KERNEL_OPTIONS
from rafl.fem.svd import signed_svd_simd


@njit(parallel=True, **KERNEL_OPTIONS)
def enhanced_strains(q, direction, cells, hexes, columns, volume, strain, local, strain_change, local_change):
    """Fill Green strain (B, E, 6) and hourglass vectors Y (B, E, 12) [m], and their changes along `direction`.

    q [m] and direction (B, N, 3); components of strain 00 11 22 01 12 02; cells, columns and volume as of
    `enhanced_terms`.
    """
    groups = len(cells)
    for task in prange(q.shape[0] * groups):
        t = task // groups
        group = task % groups
        w = np.zeros(ENHANCED_ROWS * 8)
        change = np.zeros((9, 8))
        change_vectors = np.zeros((12, 8))
        for g in range(8):
            for n in range(8):
                node = hexes[cells[group, g], n]
                for i in range(3):
                    w[(POSITIONS + 3 * n + i) * 8 + g] = q[t, node, i]
                    for j in range(3):
                        change[3 * i + j, g] += direction[t, node, i] * columns[group, (8 * j + n) * 8 + g]
                    for k in range(4):
                        change_vectors[3 * k + i, g] += (
                            direction[t, node, i] * columns[group, (8 * (3 + k) + n) * 8 + g]
                        )
        fill_kinematics(w, columns[group])
        signed_svd_simd(w)
        fill_frame(w)
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
                        local_rate[i, j] += w[(ROTATION + 3 * k + i) * 8 + g] * change[3 * k + j, g]
            for i in range(3):
                axial[i] = local_rate[(i + 2) % 3, (i + 1) % 3] - local_rate[(i + 1) % 3, (i + 2) % 3]
            for i in range(3):
                turn[i] = 0.0
                for j in range(3):
                    turn[i] += w[(INVERSE + 3 * i + j) * 8 + g] * axial[j]
            for k in range(4):
                for i in range(3):
                    a = (i + 1) % 3
                    b = (i + 2) % 3
                    value = 0.0
                    for j in range(3):
                        value += w[(ROTATION + 3 * j + i) * 8 + g] * change_vectors[3 * k + j, g]
                    value -= turn[a] * w[(LOCAL + 3 * k + b) * 8 + g] - turn[b] * w[(LOCAL + 3 * k + a) * 8 + g]
                    local[t, e, 3 * k + i] = w[(LOCAL + 3 * k + i) * 8 + g]
                    local_change[t, e, 3 * k + i] = value


@njit(parallel=True, **KERNEL_OPTIONS)
def enhanced_strains_adjoint(q, by_strain, by_local, cells, hexes, columns, volume, out):
    """Fill out (B, N, 3): the derivative by q of sum by_strain * strain + by_local * Y of `enhanced_strains`.

    by_strain (B, E, 6), by_local (B, E, 12); the other arguments as of `enhanced_strains`.
    """
    groups = len(cells)
    force = np.zeros((q.shape[0], groups, 24, 8))
    for task in prange(q.shape[0] * groups):
        t = task // groups
        group = task % groups
        w = np.zeros(ENHANCED_ROWS * 8)
        for g in range(8):
            for n in range(8):
                node = hexes[cells[group, g], n]
                for i in range(3):
                    w[(POSITIONS + 3 * n + i) * 8 + g] = q[t, node, i]
        fill_kinematics(w, columns[group])
        signed_svd_simd(w)
        fill_frame(w)
        for g in range(8):
            for r in range(12):
                w[(LOCAL_FORCE + r) * 8 + g] = by_local[t, cells[group, g], r]
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(3):
                        low, high = min(j, k), max(j, k)
                        component = low if low == high else (5 if high - low == 2 else 3 + low)
                        share = 1.0 if low == high else 0.5
                        total += share * by_strain[t, cells[group, g], component] * w[(DEFORMATION + 3 * i + k) * 8 + g]
                    w[(STRESS + 3 * i + j) * 8 + g] = total
        fill_moment(w)
        add_frame_stress(w)
        for g in range(8):
            for n in range(8):
                for i in range(3):
                    value = 0.0
                    for j in range(3):
                        value += w[(STRESS + 3 * i + j) * 8 + g] * columns[group, (8 * j + n) * 8 + g]
                    for k in range(4):
                        along = 0.0
                        for j in range(3):
                            along += w[(ROTATION + 3 * i + j) * 8 + g] * w[(LOCAL_FORCE + 3 * k + j) * 8 + g]
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
