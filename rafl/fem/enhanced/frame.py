"""The frame of a cell's mean deformation gradient, and the forces of its hourglass modes."""

import numpy as np
from numba import njit

from rafl.fem.enhanced.layout import (
    INVERSE,
    LOCAL,
    LOCAL_FORCE,
    MOMENT,
    POSITIONS,
    ROTATION,
    SCRATCH,
    STRETCH_TENSOR,
    VECTORS,
)
from rafl.fem.kernel_layout import DEFORMATION, ENERGY, STRESS, STRETCH, WEIGHT, U, V
from rafl.fem.simd import KERNEL_OPTIONS, lane_products

MIN_ROTATION_STIFFNESS = 1e-8  # of G, relative to no stretch: bounds the rotation of a flattened cell

over_nodes = lane_products(8, 24, 8)
_over_modes = lane_products(12, 8, 8)


@njit(**KERNEL_OPTIONS)
def fill_kinematics(w, columns):
    """Fill DEFORMATION and the hourglass vectors from the nodal positions; columns (7 * 8 * 8) of the lanes' cells."""
    for i in range(3):
        for j in range(3):
            over_nodes(w, (DEFORMATION + 3 * i + j) * 8, w, (POSITIONS + i) * 8, columns, 64 * j)
        for k in range(4):
            over_nodes(w, (VECTORS + 3 * k + i) * 8, w, (POSITIONS + i) * 8, columns, 64 * (3 + k))


@njit(**KERNEL_OPTIONS)
def fill_frame(w):
    """Fill R, S, G^-1 and Y from the singular vectors and the hourglass vectors."""
    for i in range(3):
        for j in range(3):
            for g in range(8):
                w[(ROTATION + 3 * i + j) * 8 + g] = (
                    w[(U + 3 * i) * 8 + g] * w[(V + 3 * j) * 8 + g]
                    + w[(U + 3 * i + 1) * 8 + g] * w[(V + 3 * j + 1) * 8 + g]
                    + w[(U + 3 * i + 2) * 8 + g] * w[(V + 3 * j + 2) * 8 + g]
                )
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        for g in range(8):
            total = w[(STRETCH + b) * 8 + g] + w[(STRETCH + c) * 8 + g]
            total = total if abs(total) > MIN_ROTATION_STIFFNESS else np.copysign(MIN_ROTATION_STIFFNESS, total)
            w[(SCRATCH + a) * 8 + g] = 1.0 / total
    for i in range(3):
        for j in range(3):
            for g in range(8):
                inverse = 0.0
                stretch = 0.0
                for a in range(3):
                    product = w[(V + 3 * i + a) * 8 + g] * w[(V + 3 * j + a) * 8 + g]
                    inverse += product * w[(SCRATCH + a) * 8 + g]
                    stretch += product * w[(STRETCH + a) * 8 + g]
                w[(INVERSE + 3 * i + j) * 8 + g] = inverse
                w[(STRETCH_TENSOR + 3 * i + j) * 8 + g] = stretch
    for k in range(4):
        for i in range(3):
            for g in range(8):
                w[(LOCAL + 3 * k + i) * 8 + g] = (
                    w[ROTATION * 8 + (3 * 0 + i) * 8 + g] * w[(VECTORS + 3 * k) * 8 + g]
                    + w[ROTATION * 8 + (3 * 1 + i) * 8 + g] * w[(VECTORS + 3 * k + 1) * 8 + g]
                    + w[ROTATION * 8 + (3 * 2 + i) * 8 + g] * w[(VECTORS + 3 * k + 2) * 8 + g]
                )


@njit(**KERNEL_OPTIONS)
def fill_moment(w):
    """Fill n = G^-1 sum_k Y_k x T_k."""
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        for g in range(8):
            moment = 0.0
            for k in range(4):
                moment += (
                    w[(LOCAL + 3 * k + a) * 8 + g] * w[(LOCAL_FORCE + 3 * k + b) * 8 + g]
                    - w[(LOCAL + 3 * k + b) * 8 + g] * w[(LOCAL_FORCE + 3 * k + a) * 8 + g]
                )
            w[(SCRATCH + i) * 8 + g] = moment
    for i in range(3):
        for g in range(8):
            w[(MOMENT + i) * 8 + g] = (
                w[(INVERSE + 3 * i) * 8 + g] * w[SCRATCH * 8 + g]
                + w[(INVERSE + 3 * i + 1) * 8 + g] * w[(SCRATCH + 1) * 8 + g]
                + w[(INVERSE + 3 * i + 2) * 8 + g] * w[(SCRATCH + 2) * 8 + g]
            )


@njit(**KERNEL_OPTIONS)
def add_hourglass_force(w, elastic, viscous, viscous_modulus, memory):
    """Fill the local force and n; add the energy of the hourglass modes to ENERGY, per unit of WEIGHT.

    elastic, viscous (144 * 8): rows of stiffness; viscous_modulus (8), zero without viscosity; memory (12, 8).
    """
    for r in range(12):
        _over_modes(w, (LOCAL_FORCE + r) * 8, w, LOCAL * 8, elastic, 12 * r * 8)
    for g in range(8):
        w[SCRATCH * 8 + g] = 0.0
    for r in range(12):
        for g in range(8):
            w[SCRATCH * 8 + g] += 0.5 * w[(LOCAL + r) * 8 + g] * w[(LOCAL_FORCE + r) * 8 + g]
    for g in range(8):
        modulus = viscous_modulus[g]
        if not modulus > 0.0:
            continue
        for r in range(12):
            total = 0.0
            for c in range(12):
                strain = modulus * w[(LOCAL + c) * 8 + g] - memory[c, g]
                total += viscous[(12 * r + c) * 8 + g] * strain
            own = modulus * w[(LOCAL + r) * 8 + g] - memory[r, g]
            w[(LOCAL_FORCE + r) * 8 + g] += total
            w[SCRATCH * 8 + g] += 0.5 / modulus * own * total
    for g in range(8):
        if w[WEIGHT * 8 + g] > 0.0:
            w[ENERGY * 8 + g] += w[SCRATCH * 8 + g] / w[WEIGHT * 8 + g]
    fill_moment(w)


@njit(**KERNEL_OPTIONS)
def add_frame_stress(w):
    """Add R (e_j x n), the force that turns the hourglass frame, to column j of STRESS."""
    for j in range(3):
        a = (j + 1) % 3
        b = (j + 2) % 3
        for i in range(3):
            for g in range(8):
                # e_j x n has components n_a along e_b and -n_b along e_a.
                w[(STRESS + 3 * i + j) * 8 + g] += (
                    w[(ROTATION + 3 * i + b) * 8 + g] * w[(MOMENT + a) * 8 + g]
                    - w[(ROTATION + 3 * i + a) * 8 + g] * w[(MOMENT + b) * 8 + g]
                )
