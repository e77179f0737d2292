"""Compiled kernels for the energy, nodal gradient and tangent of a batch of deformed meshes.

`w` is the scratch array of one cell; see `rafl.fem.kernel_layout`. The kernels are tested against the tensors of
`rafl.fem.tensors.elements`.
"""

import numpy as np
from numba import njit, prange

from rafl.fem.kernel_layout import (
    DEFORMATION,
    ENERGY,
    FORCE,
    PRODUCT,
    ROWS,
    SHAPE_GRADIENTS,
    STIFFNESS,
    STRESS,
    TANGENT,
    WEIGHT,
)
from rafl.fem.laws.kernel import fill_derivatives
from rafl.fem.learned.energy_kernel import add_learned_energy
from rafl.fem.simd import KERNEL_OPTIONS, transposed_product, weighted_rows
from rafl.fem.stress import add_damping_stress, add_viscous_stress, fill_stress, fill_tangent, project_semidefinite
from rafl.fem.svd import signed_svd_simd

# Stored blocks of a cell's symmetric 24 x 24 stiffness: (component i, component k <= i), each 8 x 8 nodes.
COMPONENT_BLOCKS = 6
CELLS_PER_CHUNK = 16  # number of cells in one task of a thread

component_gradient = weighted_rows(8, 3, 24)  # sum over nodes of nodal value times gradient
_add_nodal_force = weighted_rows(3, 8, 8, add=True)
_tangent_times_gradients = weighted_rows(3, 8, 8)
_add_stiffness_block = transposed_product(24)


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
