"""Compiled kernels for the stress and its derivative at the eight points of a cell, or at those of eight cells.

`w` is the scratch array; see `rafl.fem.kernel_layout`. Stress and tangent are multiplied by the weight of their point.
"""

import numpy as np
from numba import njit

from rafl.fem.kernel_layout import (
    COUPLED,
    DEFORMATION,
    ENERGY,
    FIRST,
    FLIP,
    MODES,
    SECOND,
    STRESS,
    STRETCH,
    TANGENT,
    TEMPORARY,
    TWIST,
    WEIGHT,
    U,
    V,
)
from rafl.fem.simd import KERNEL_OPTIONS, lane_products

_mode_products = lane_products(9, 72, 72)


@njit(**KERNEL_OPTIONS)
def project_semidefinite(w):
    """Project the second derivatives, flips and twists of each point to positive semi-definite ones."""
    A = np.empty((3, 3))
    for g in range(8):
        for i in range(3):
            j = (i + 1) % 3
            A[i, i] = w[(SECOND + i) * 8 + g]
            A[i, j] = A[j, i] = w[(SECOND + 3 + i) * 8 + g]
            w[(FLIP + i) * 8 + g] = max(w[(FLIP + i) * 8 + g], 0.0)
            w[(TWIST + i) * 8 + g] = max(w[(TWIST + i) * 8 + g], 0.0)
        values, vectors = np.linalg.eigh(A)
        if values[0] >= 0.0:
            continue
        for i in range(3):
            j = (i + 1) % 3
            diagonal = 0.0
            off_diagonal = 0.0
            for k in range(3):
                value = max(values[k], 0.0)
                diagonal += vectors[i, k] * value * vectors[i, k]
                off_diagonal += vectors[i, k] * value * vectors[j, k]
            w[(SECOND + i) * 8 + g] = diagonal
            w[(SECOND + 3 + i) * 8 + g] = off_diagonal


@njit(**KERNEL_OPTIONS)
def fill_stress(w):
    """Fill STRESS with weight times P = U diag(psi_i) V^T, and TWIST."""
    for i in range(3):
        for j in range(3):
            for g in range(8):
                w[(STRESS + 3 * i + j) * 8 + g] = w[WEIGHT * 8 + g] * (
                    w[FIRST * 8 + g] * w[(U + 3 * i) * 8 + g] * w[(V + 3 * j) * 8 + g]
                    + w[(FIRST + 1) * 8 + g] * w[(U + 3 * i + 1) * 8 + g] * w[(V + 3 * j + 1) * 8 + g]
                    + w[(FIRST + 2) * 8 + g] * w[(U + 3 * i + 2) * 8 + g] * w[(V + 3 * j + 2) * 8 + g]
                )
    for k in range(3):
        following = (k + 1) % 3
        for g in range(8):
            total = w[(STRETCH + k) * 8 + g] + w[(STRETCH + following) * 8 + g]
            total = total if abs(total) > 1e-8 else np.copysign(1e-8, total)
            w[(TWIST + k) * 8 + g] = (w[(FIRST + k) * 8 + g] + w[(FIRST + following) * 8 + g]) / total


@njit(**KERNEL_OPTIONS)
def fill_tangent(w):
    """Fill TANGENT with weight times d P / d F (9 x 9), from nine modes: three stretches, two matrices per pair."""
    for m in range(3):
        following = (m + 1) % 3
        for i in range(3):
            for j in range(3):
                r = 3 * i + j
                for g in range(8):
                    w[(MODES + 9 * m + r) * 8 + g] = w[(U + 3 * i + m) * 8 + g] * w[(V + 3 * j + m) * 8 + g]
                    w[(MODES + 9 * (3 + 2 * m) + r) * 8 + g] = (
                        w[(U + 3 * i + m) * 8 + g] * w[(V + 3 * j + following) * 8 + g]
                    )
                    w[(MODES + 9 * (4 + 2 * m) + r) * 8 + g] = (
                        w[(U + 3 * i + following) * 8 + g] * w[(V + 3 * j + m) * 8 + g]
                    )
    for r in range(9):
        for g in range(8):
            x0 = w[(MODES + r) * 8 + g] * w[WEIGHT * 8 + g]
            x1 = w[(MODES + 9 + r) * 8 + g] * w[WEIGHT * 8 + g]
            x2 = w[(MODES + 18 + r) * 8 + g] * w[WEIGHT * 8 + g]
            d01 = w[(SECOND + 3) * 8 + g]
            d12 = w[(SECOND + 4) * 8 + g]
            d20 = w[(SECOND + 5) * 8 + g]
            w[(COUPLED + r) * 8 + g] = w[SECOND * 8 + g] * x0 + d01 * x1 + d20 * x2
            w[(COUPLED + 9 + r) * 8 + g] = d01 * x0 + w[(SECOND + 1) * 8 + g] * x1 + d12 * x2
            w[(COUPLED + 18 + r) * 8 + g] = d20 * x0 + d12 * x1 + w[(SECOND + 2) * 8 + g] * x2
    for m in range(3):
        for g in range(8):
            w[TEMPORARY * 8 + g] = 0.5 * w[WEIGHT * 8 + g] * (w[(FLIP + m) * 8 + g] + w[(TWIST + m) * 8 + g])
            w[(TEMPORARY + 1) * 8 + g] = 0.5 * w[WEIGHT * 8 + g] * (w[(FLIP + m) * 8 + g] - w[(TWIST + m) * 8 + g])
        for r in range(9):
            for g in range(8):
                x = w[(MODES + 9 * (3 + 2 * m) + r) * 8 + g]
                y = w[(MODES + 9 * (4 + 2 * m) + r) * 8 + g]
                diagonal = w[TEMPORARY * 8 + g]
                coupling = w[(TEMPORARY + 1) * 8 + g]
                w[(COUPLED + 9 * (3 + 2 * m) + r) * 8 + g] = diagonal * x + coupling * y
                w[(COUPLED + 9 * (4 + 2 * m) + r) * 8 + g] = coupling * x + diagonal * y
    for r in range(9):
        for c in range(r + 1):
            _mode_products(w, (TANGENT + 9 * r + c) * 8, w, (MODES + r) * 8, w, (COUPLED + c) * 8)
            for g in range(8):
                w[(TANGENT + 9 * c + r) * 8 + g] = w[(TANGENT + 9 * r + c) * 8 + g]


@njit(**KERNEL_OPTIONS)
def add_viscous_stress(w, viscous_modulus, memory, project, tangent):
    """Add the viscous stress F S, S = 2 (g E - memory), with g the viscous modulus, to STRESS, ENERGY and TANGENT.

    viscous_modulus (8) and memory (8, 6) [Pa]; points without viscosity have a modulus of zero.
    """
    F = np.empty((3, 3))
    S = np.empty((3, 3))
    for g in range(8):
        g_modulus = viscous_modulus[g]
        if not g_modulus > 0.0:
            continue
        weight = w[WEIGHT * 8 + g]
        for i in range(3):
            for j in range(3):
                F[i, j] = w[(DEFORMATION + 3 * i + j) * 8 + g]
        energy = 0.0
        for i in range(3):
            for j in range(i, 3):
                green = -0.5 if i == j else 0.0
                for k in range(3):
                    green += 0.5 * F[k, i] * F[k, j]
                component = i if i == j else (5 if j - i == 2 else 3 + i)
                half = g_modulus * green - memory[g, component]
                energy += (1.0 if i == j else 2.0) / g_modulus * half * half
                S[i, j] = S[j, i] = 2.0 * half
        w[ENERGY * 8 + g] += energy
        for i in range(3):
            for j in range(3):
                stress = F[i, 0] * S[0, j] + F[i, 1] * S[1, j] + F[i, 2] * S[2, j]
                w[(STRESS + 3 * i + j) * 8 + g] += weight * stress
        if not tangent:
            continue
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    for m in range(3):
                        value = g_modulus * F[i, m] * F[k, j]
                        if j == m:
                            for n in range(3):
                                value += g_modulus * F[i, n] * F[k, n]
                        if i == k and not project:
                            value += S[j, m]
                        w[(TANGENT + 9 * (3 * i + j) + 3 * k + m) * 8 + g] += weight * value


@njit(**KERNEL_OPTIONS)
def add_damping_stress(w, mu, lam, velocity_gradient, velocity_factor, tangent):
    """Add the stress of stiffness damping, 2 mu D + lam tr(D) I, to STRESS, ENERGY and TANGENT.

    mu and lam [Pa s] are those at rest times the damping coefficient. velocity_gradient (9, 8): in the rest frame
    [1/s]; D is its symmetric part.
    """
    for g in range(8):
        weight = w[WEIGHT * 8 + g]
        trace = velocity_gradient[0, g] + velocity_gradient[4, g] + velocity_gradient[8, g]
        energy = 0.5 / velocity_factor * lam * trace * trace
        for i in range(3):
            for j in range(3):
                strain_rate = 0.5 * (velocity_gradient[3 * i + j, g] + velocity_gradient[3 * j + i, g])
                energy += mu / velocity_factor * strain_rate * strain_rate
                stress = 2.0 * mu * strain_rate + (lam * trace if i == j else 0.0)
                w[(STRESS + 3 * i + j) * 8 + g] += weight * stress
        w[ENERGY * 8 + g] += energy
        if not tangent:
            continue
        for i in range(3):
            for j in range(3):
                w[(TANGENT + 9 * (3 * i + j) + 3 * i + j) * 8 + g] += weight * velocity_factor * mu
                w[(TANGENT + 9 * (3 * i + j) + 3 * j + i) * 8 + g] += weight * velocity_factor * mu
                w[(TANGENT + 9 * (4 * i) + 4 * j) * 8 + g] += weight * velocity_factor * lam
