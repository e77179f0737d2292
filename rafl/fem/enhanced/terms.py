"""Compiled energy, nodal gradient and tangent of cells with one integration point and stabilised hourglass modes."""

import numpy as np
from numba import njit, prange

from rafl.fem.enhanced.frame import add_frame_stress, add_hourglass_force, fill_frame, fill_kinematics, over_nodes
from rafl.fem.enhanced.layout import (
    BLOCK,
    ENHANCED_ROWS,
    LOCAL_FORCE,
    POSITIONS,
    RATE,
    RATE_VECTORS,
    ROTATION,
    SCRATCH,
    VECTORS,
    VELOCITY,
)
from rafl.fem.enhanced.tangent import fill_block, fill_tensor
from rafl.fem.kernel_layout import ENERGY, STRESS, WEIGHT
from rafl.fem.laws.kernel import fill_derivatives
from rafl.fem.learned.energy_kernel import add_learned_energy
from rafl.fem.simd import KERNEL_OPTIONS
from rafl.fem.stress import add_damping_stress, add_viscous_stress, fill_stress, fill_tangent, project_semidefinite
from rafl.fem.svd import signed_svd_simd

GROUPS_PER_CHUNK = 4  # groups of eight cells in one task of a thread


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
    learned,
    energy_weights,
    viscous,
    viscous_modulus,
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
        moduli: see `rafl.fem.constitutive_state.MODULI`, (B, 4).
        hourglass: elastic, viscous and damping stiffness by lane, (B, G or 1, 3, 144 * 8 lanes).
        per_shape: whether `hourglass` has one set for all groups.
        learned: whether there is a learned energy.
        energy_weights: its weights [Pa], (B, K).
        viscous: whether viscous stress acts, with the next three arguments.
        viscous_modulus: of each cell [Pa], (B, E, 1).
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
    chunks = (groups + GROUPS_PER_CHUNK - 1) // GROUPS_PER_CHUNK
    force = np.empty((batch, groups, 24, 8))
    chunk_energy = np.empty((batch, chunks))
    for task in prange(batch * chunks):
        t = task // chunks
        chunk = task % chunks
        w = np.zeros(ENHANCED_ROWS * 8)
        lane_modulus = np.zeros(8)
        lane_memory = np.zeros((8, 6))
        lane_hourglass_memory = np.zeros((12, 8))
        rate = np.zeros((9, 8))
        total = 0.0
        for group in range(chunk * GROUPS_PER_CHUNK, min(groups, (chunk + 1) * GROUPS_PER_CHUNK)):
            own = hourglass[t, 0 if per_shape else group]
            for g in range(8):
                e = cells[group, g]
                w[WEIGHT * 8 + g] = volume[group, g]
                for n in range(8):
                    node = hexes[e, n]
                    for i in range(3):
                        w[(POSITIONS + 3 * n + i) * 8 + g] = q[t, node, i]
                        if damped:
                            w[(VELOCITY + 3 * n + i) * 8 + g] = (
                                velocity_factor * q[t, node, i] - velocity_offset[t, node, i]
                            )
                if viscous:
                    lane_modulus[g] = viscous_modulus[t, e, 0]
                    for c in range(6):
                        lane_memory[g, c] = memory[t, e, 0, c]
                    for c in range(12):
                        lane_hourglass_memory[c, g] = hourglass_memory[t, e, c]
            fill_kinematics(w, columns[group])
            signed_svd_simd(w)
            fill_derivatives(law, w, moduli[t, 0], moduli[t, 1])
            if learned:
                add_learned_energy(w, energy_weights[t], 1.0)
            fill_stress(w)
            if tangent:
                if project:
                    project_semidefinite(w)
                fill_tangent(w)
            if viscous:
                add_viscous_stress(w, lane_modulus, lane_memory, project, tangent)
            if damped:
                for i in range(3):
                    for j in range(3):
                        over_nodes(w, (RATE + 3 * i + j) * 8, w, (VELOCITY + i) * 8, columns[group], 64 * j)
                        for g in range(8):
                            rate[3 * i + j, g] = w[(RATE + 3 * i + j) * 8 + g]
                    for k in range(4):
                        over_nodes(
                            w, (RATE_VECTORS + 3 * k + i) * 8, w, (VELOCITY + i) * 8, columns[group], 64 * (3 + k)
                        )
                add_damping_stress(w, moduli[t, 2], moduli[t, 3], rate, velocity_factor, tangent)
            fill_frame(w)
            add_hourglass_force(w, own[0], own[1], lane_modulus, lane_hourglass_memory)
            add_frame_stress(w)
            # Forces of the seven columns: stress, then the hourglass forces in the frame of space.
            for k in range(4):
                for i in range(3):
                    for g in range(8):
                        w[(VECTORS + 3 * k + i) * 8 + g] = (
                            w[(ROTATION + 3 * i) * 8 + g] * w[(LOCAL_FORCE + 3 * k) * 8 + g]
                            + w[(ROTATION + 3 * i + 1) * 8 + g] * w[(LOCAL_FORCE + 3 * k + 1) * 8 + g]
                            + w[(ROTATION + 3 * i + 2) * 8 + g] * w[(LOCAL_FORCE + 3 * k + 2) * 8 + g]
                        )
            if damped:
                for r in range(12):
                    for g in range(8):
                        w[SCRATCH * 8 + g] = 0.0
                    for c in range(12):
                        for g in range(8):
                            w[SCRATCH * 8 + g] += own[2, (12 * r + c) * 8 + g] * w[(RATE_VECTORS + c) * 8 + g]
                    for g in range(8):
                        w[(VECTORS + r) * 8 + g] += w[SCRATCH * 8 + g]
                        if w[WEIGHT * 8 + g] > 0.0:
                            w[ENERGY * 8 + g] += (
                                0.5
                                / velocity_factor
                                * w[(RATE_VECTORS + r) * 8 + g]
                                * w[SCRATCH * 8 + g]
                                / w[WEIGHT * 8 + g]
                            )
            for n in range(8):
                for i in range(3):
                    for g in range(8):
                        value = 0.0
                        for j in range(3):
                            value += w[(STRESS + 3 * i + j) * 8 + g] * columns[group, (8 * j + n) * 8 + g]
                        for k in range(4):
                            value += w[(VECTORS + 3 * k + i) * 8 + g] * columns[group, (8 * (3 + k) + n) * 8 + g]
                        force[t, group, 3 * n + i, g] = value
            for g in range(8):
                total += w[WEIGHT * 8 + g] * w[ENERGY * 8 + g]
            if tangent:
                fill_tensor(w, own, lane_modulus, velocity_factor if damped else 0.0, project)
                for block in range(6):
                    fill_block(w, columns[group], (0, 1, 1, 2, 2, 2)[block], (0, 0, 1, 0, 1, 2)[block])
                    for g in range(8):
                        if volume[group, g] > 0.0:
                            out = stiffness[t, cells[group, g], block]
                            for n in range(8):
                                for m in range(8):
                                    out[n, m] = w[(BLOCK + 8 * n + m) * 8 + g]
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
