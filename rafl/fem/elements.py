"""Compiled kernels for the energy, nodal gradient and tangent of a batch of deformed meshes.

`w` is the scratch array of one cell; see `rafl.fem.kernel_layout`. The kernels are tested against the tensor
implementation in `rafl.simulation.reference_engine`.
"""

import numpy as np
from numba import njit, prange

from rafl.fem.kernel_layout import (
    COUPLED,
    DEFORMATION,
    ENERGY,
    FIRST,
    FLIP,
    FORCE,
    MODES,
    PRODUCT,
    ROWS,
    SECOND,
    SHAPE_GRADIENTS,
    STIFFNESS,
    STRESS,
    STRETCH,
    TANGENT,
    TEMPORARY,
    TWIST,
    WEIGHT,
    U,
    V,
)
from rafl.fem.laws.kernel import fill_derivatives
from rafl.fem.learned_energy_kernel import add_learned_energy
from rafl.fem.simd import KERNEL_OPTIONS, lane_products, transposed_product, weighted_rows
from rafl.fem.svd import signed_svd_simd

# Stored blocks of a cell's symmetric 24 x 24 stiffness: (component i, component k <= i), each 8 x 8 nodes.
COMPONENT_BLOCKS = 6
CELLS_PER_CHUNK = 16  # number of cells in one task of a thread

component_gradient = weighted_rows(8, 3, 24)  # sum over nodes of nodal value times gradient
_add_nodal_force = weighted_rows(3, 8, 8, add=True)
_tangent_times_gradients = weighted_rows(3, 8, 8)
_mode_products = lane_products(9, 72, 72)
_add_stiffness_block = transposed_product(24)


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


@njit(**KERNEL_OPTIONS)
def _add_cell(
    w,
    x,
    gradients_by_point,
    gradients_by_node,
    law,
    mu,
    lam,
    moduli,
    learned,
    energy_weights,
    learned_share,
    viscous,
    viscous_modulus,
    memory,
    damped,
    velocity_gradient,
    velocity_factor,
    project,
    tangent,
):
    """Add one group of eight points to FORCE and STIFFNESS; return its energy [J].

    x (48): the positions of the cell's nodes, then their velocities. velocity_gradient (72) is working memory.
    """
    for i in range(192):
        w[SHAPE_GRADIENTS * 8 + i] = gradients_by_node[i]
    for i in range(3):
        for j in range(3):
            component_gradient(w, (DEFORMATION + 3 * i + j) * 8, x, i, gradients_by_point, 8 * j)
    signed_svd_simd(w)
    fill_derivatives(law, w, mu, lam)
    if learned and learned_share > 0.0:
        add_learned_energy(w, energy_weights, learned_share)
    fill_stress(w)
    if tangent:
        if project:
            project_semidefinite(w)
        fill_tangent(w)
    if viscous:
        add_viscous_stress(w, viscous_modulus, memory, project, tangent)
    if damped:
        for i in range(3):
            for j in range(3):
                component_gradient(velocity_gradient, (3 * i + j) * 8, x, 24 + i, gradients_by_point, 8 * j)
        add_damping_stress(w, moduli[2], moduli[3], velocity_gradient.reshape(9, 8), velocity_factor, tangent)
    energy = 0.0
    for g in range(8):
        energy += w[WEIGHT * 8 + g] * w[ENERGY * 8 + g]
        for i in range(3):
            _add_nodal_force(w, (FORCE + i) * 8, w, (STRESS + 3 * i) * 8 + g, w, (SHAPE_GRADIENTS + 3 * g) * 8)
    if tangent:
        block = 0
        for i in range(3):
            for k in range(i + 1):
                for g in range(8):
                    for j in range(3):
                        _tangent_times_gradients(
                            w,
                            (PRODUCT + 3 * g + j) * 8,
                            w,
                            (TANGENT + 9 * (3 * i + j) + 3 * k) * 8 + g,
                            w,
                            (SHAPE_GRADIENTS + 3 * g) * 8,
                        )
                _add_stiffness_block(w, (STIFFNESS + 8 * block) * 8, w, SHAPE_GRADIENTS * 8, w, PRODUCT * 8)
                block += 1
    return energy


@njit(parallel=True, **KERNEL_OPTIONS)
def element_terms(
    q,
    hexes,
    gradients_by_point,
    gradients_by_node,
    volume,
    group_shares,
    law,
    moduli,
    learned,
    energy_weights,
    viscous,
    viscous_modulus,
    memory,
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
        hexes: (E, 8).
        gradients_by_point: shape function gradients [1/m], (E, G, 8 nodes * 3 * 8 points).
        gradients_by_node: the same in the order (E, G, 8 points * 3 * 8 nodes).
        volume: of each point [m^3], (E, G, 8).
        group_shares: fraction of mu and of lambda that each group of points integrates, (G, 2).
        law: address of the elastic law's compiled derivatives, `rafl.fem.laws.law.Law.kernel.address`.
        moduli: see `rafl.fem.constitutive_state.MODULI`, (B, 4).
        learned: whether there is a learned energy.
        energy_weights: its weights [Pa], (B, K).
        viscous: whether viscous stress acts, with the next two arguments.
        viscous_modulus: of each point [Pa], (B, E, 8 G).
        memory: of the viscous stress [Pa], (B, E, 8 G, 6).
        damped: whether stiffness damping acts, with the next two arguments.
        velocity_offset: velocities are velocity_factor * q - velocity_offset, (B, N, 3) [m/s].
        velocity_factor: [1/s].
        project: make the tangent positive semi-definite at each point.
        tangent: whether to compute the stiffness.
        energy, gradient, stiffness: [J], [N], [N/m]; outputs.
    """
    batch, cells, groups = q.shape[0], hexes.shape[0], volume.shape[1]
    chunks = (cells + CELLS_PER_CHUNK - 1) // CELLS_PER_CHUNK
    force = np.empty((batch, cells, 24))
    chunk_energy = np.empty((batch, chunks))
    for task in prange(batch * chunks):
        t = task // chunks
        chunk = task % chunks
        w = np.empty(ROWS * 8)
        x = np.zeros(48)
        velocity_gradient = np.zeros(72)
        point_modulus = np.zeros(8)
        total = 0.0
        for e in range(chunk * CELLS_PER_CHUNK, min(cells, (chunk + 1) * CELLS_PER_CHUNK)):
            for n in range(8):
                node = hexes[e, n]
                for i in range(3):
                    x[3 * n + i] = q[t, node, i]
                    if damped:
                        x[24 + 3 * n + i] = velocity_factor * q[t, node, i] - velocity_offset[t, node, i]
            for i in range(24):
                w[FORCE * 8 + i] = 0.0
            if tangent:
                for i in range(COMPONENT_BLOCKS * 64):
                    w[STIFFNESS * 8 + i] = 0.0
            for group in range(groups):
                for g in range(8):
                    w[WEIGHT * 8 + g] = volume[e, group, g]
                group_moduli = moduli[t] * group_shares[group, 0]
                group_moduli[3] = moduli[t, 3] * group_shares[group, 1]
                if viscous:
                    for g in range(8):
                        point_modulus[g] = group_shares[group, 0] * viscous_modulus[t, e, 8 * group + g]
                cell_memory = memory[t, e, 8 * group : 8 * group + 8] if viscous else memory[0, 0]
                total += _add_cell(
                    w,
                    x,
                    gradients_by_point[e, group],
                    gradients_by_node[e, group],
                    law,
                    group_moduli[0],
                    moduli[t, 1] * group_shares[group, 1],
                    group_moduli,
                    learned,
                    energy_weights[t if learned else 0],
                    group_shares[group, 0],
                    viscous,
                    point_modulus,
                    cell_memory,
                    damped,
                    velocity_gradient,
                    velocity_factor,
                    project,
                    tangent,
                )
            for i in range(24):
                force[t, e, i] = w[FORCE * 8 + i]
            if tangent:
                out = stiffness[t, e]
                for i in range(COMPONENT_BLOCKS * 64):
                    out[i // 64, (i // 8) % 8, i % 8] = w[STIFFNESS * 8 + i]
        chunk_energy[t, chunk] = total
    for t in prange(batch):
        energy[t] = chunk_energy[t].sum()
        gradient[t] = 0.0
        for e in range(cells):
            for i in range(3):
                for n in range(8):
                    gradient[t, hexes[e, n], i] += force[t, e, 8 * i + n]


@njit(parallel=True, **KERNEL_OPTIONS)
def multiply(stiffness, cells, hexes, x, out):
    """Fill out (B, N, 3) with the product of stiffness (B, E, 6, 8, 8), summed over `cells`, and x (B, N, 3)."""
    for t in prange(x.shape[0]):
        out[t] = 0.0
        for e in cells:
            for i in range(3):
                for k in range(i + 1):
                    block = i * (i + 1) // 2 + k
                    for a in range(8):
                        for b in range(8):
                            value = stiffness[t, e, block, a, b]
                            out[t, hexes[e, a], i] += value * x[t, hexes[e, b], k]
                            if i != k:
                                out[t, hexes[e, b], k] += value * x[t, hexes[e, a], i]
