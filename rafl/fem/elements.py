"""Energy, nodal gradient and tangent of a batch of deformed meshes, compiled.

`rafl.simulation.reference_engine` says the same in tensors and is what these kernels are tested against.
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
    SLOPES,
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
from rafl.fem.laws import corotated, neo_hookean, projective
from rafl.fem.simd import KERNEL, lane_products, transposed_product, weighted_rows
from rafl.fem.svd import signed_svd_lanes

# Of the 24 x 24 stiffness the blocks (component i, component k <= i), each over 8 x 8 nodes, are kept.
BLOCKS = 6
CHUNK = 16  # cells a thread takes at a time

_projective = projective.derivatives
_corotated = corotated.derivatives
_neo_hookean = neo_hookean.derivatives

_gather = weighted_rows(8, 3, 24)  # sum over nodes of position times gradient
_by_nodes = weighted_rows(3, 8, 8, add=True)
_couple = weighted_rows(3, 8, 8)
_modes_product = lane_products(9, 72, 72)
_to_stiffness = transposed_product(24)


@njit(**KERNEL)
def _project_lanes(w):
    """Make the law's second derivatives positive semi-definite, lane by lane."""
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
            beside = 0.0
            for k in range(3):
                value = max(values[k], 0.0)
                diagonal += vectors[i, k] * value * vectors[i, k]
                beside += vectors[i, k] * value * vectors[j, k]
            w[(SECOND + i) * 8 + g] = diagonal
            w[(SECOND + 3 + i) * 8 + g] = beside


@njit(**KERNEL)
def _stress(w):
    """Weight times P = U diag(first) V^T, and the twist stiffnesses."""
    for i in range(3):
        for j in range(3):
            for g in range(8):
                w[(STRESS + 3 * i + j) * 8 + g] = w[WEIGHT * 8 + g] * (
                    w[FIRST * 8 + g] * w[(U + 3 * i) * 8 + g] * w[(V + 3 * j) * 8 + g]
                    + w[(FIRST + 1) * 8 + g] * w[(U + 3 * i + 1) * 8 + g] * w[(V + 3 * j + 1) * 8 + g]
                    + w[(FIRST + 2) * 8 + g] * w[(U + 3 * i + 2) * 8 + g] * w[(V + 3 * j + 2) * 8 + g]
                )
    for k in range(3):
        after = (k + 1) % 3
        for g in range(8):
            total = w[(STRETCH + k) * 8 + g] + w[(STRETCH + after) * 8 + g]
            total = total if abs(total) > 1e-8 else np.copysign(1e-8, total)
            w[(TWIST + k) * 8 + g] = (w[(FIRST + k) * 8 + g] + w[(FIRST + after) * 8 + g]) / total


@njit(**KERNEL)
def _tangent(w):
    """Weight times d P / d F (9 x 9) from nine modes: three stretches, and two matrices of each pair."""
    for m in range(3):
        after = (m + 1) % 3
        for i in range(3):
            for j in range(3):
                r = 3 * i + j
                for g in range(8):
                    w[(MODES + 9 * m + r) * 8 + g] = w[(U + 3 * i + m) * 8 + g] * w[(V + 3 * j + m) * 8 + g]
                    w[(MODES + 9 * (3 + 2 * m) + r) * 8 + g] = (
                        w[(U + 3 * i + m) * 8 + g] * w[(V + 3 * j + after) * 8 + g]
                    )
                    w[(MODES + 9 * (4 + 2 * m) + r) * 8 + g] = (
                        w[(U + 3 * i + after) * 8 + g] * w[(V + 3 * j + m) * 8 + g]
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
                same = w[TEMPORARY * 8 + g]
                other = w[(TEMPORARY + 1) * 8 + g]
                w[(COUPLED + 9 * (3 + 2 * m) + r) * 8 + g] = same * x + other * y
                w[(COUPLED + 9 * (4 + 2 * m) + r) * 8 + g] = other * x + same * y
    for r in range(9):
        for c in range(r + 1):
            _modes_product(w, (TANGENT + 9 * r + c) * 8, w, (MODES + r) * 8, w, (COUPLED + c) * 8)
            for g in range(8):
                w[(TANGENT + 9 * c + r) * 8 + g] = w[(TANGENT + 9 * r + c) * 8 + g]


@njit(**KERNEL)
def _damp(w, moduli, velocity, strain, rate, strain_rate, project, tangent):
    """Add viscous stress F (2 eta E') and stiffness-proportional stress to STRESS, ENERGY and TANGENT.

    velocity (9, 8): its rest-frame gradient; strain (8, 6): what is subtracted from strain_rate * E.
    """
    eta = moduli[2]
    mu = moduli[3]
    lam = moduli[4]
    F = np.empty((3, 3))
    S = np.empty((3, 3))
    for g in range(8):
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
                place = i if i == j else (5 if j - i == 2 else 3 + i)
                S[i, j] = S[j, i] = strain_rate * green - strain[g, place]
                energy += (1.0 if i == j else 2.0) * eta / strain_rate * S[i, j] * S[i, j]
                S[i, j] = S[j, i] = 2.0 * eta * S[i, j]
        trace = velocity[0, g] + velocity[4, g] + velocity[8, g]
        energy += 0.5 / rate * lam * trace * trace
        for i in range(3):
            for j in range(3):
                shear = 0.5 * (velocity[3 * i + j, g] + velocity[3 * j + i, g])
                energy += mu / rate * shear * shear
                stress = 2.0 * mu * shear + (lam * trace if i == j else 0.0)
                for k in range(3):
                    stress += F[i, k] * S[k, j]
                w[(STRESS + 3 * i + j) * 8 + g] += weight * stress
        w[ENERGY * 8 + g] += energy
        if not tangent:
            continue
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    for m in range(3):
                        value = eta * strain_rate * F[i, m] * F[k, j]
                        if j == m:
                            for n in range(3):
                                value += eta * strain_rate * F[i, n] * F[k, n]
                        if i == k:
                            value += rate * mu * (1.0 if j == m else 0.0)
                            if not project:
                                value += S[j, m]
                        if i == m and j == k:
                            value += rate * mu
                        if i == j and k == m:
                            value += rate * lam
                        w[(TANGENT + 9 * (3 * i + j) + 3 * k + m) * 8 + g] += weight * value


@njit(**KERNEL)
def _cell(w, x, by_point, by_node, law, mu, lam, damped, moduli, velocity, strain, rate, strain_rate, project, tangent):
    """Add one group of eight points to the scratch's FORCE and STIFFNESS; returns the energy [J].

    x: corner positions, then velocities, (48).
    """
    for i in range(192):
        w[SLOPES * 8 + i] = by_node[i]
    for i in range(3):
        for j in range(3):
            _gather(w, (DEFORMATION + 3 * i + j) * 8, x, i, by_point, 8 * j)
    signed_svd_lanes(w)
    if law == 0:
        _projective(w, mu, lam)
    elif law == 1:
        _corotated(w, mu, lam)
    else:
        _neo_hookean(w, mu, lam)
    _stress(w)
    if tangent:
        if project:
            _project_lanes(w)
        _tangent(w)
    if damped:
        for i in range(3):
            for j in range(3):
                _gather(velocity, (3 * i + j) * 8, x, 24 + i, by_point, 8 * j)
        _damp(w, moduli, velocity.reshape(9, 8), strain, rate, strain_rate, project, tangent)
    energy = 0.0
    for g in range(8):
        energy += w[WEIGHT * 8 + g] * w[ENERGY * 8 + g]
        for i in range(3):
            _by_nodes(w, (FORCE + i) * 8, w, (STRESS + 3 * i) * 8 + g, w, (SLOPES + 3 * g) * 8)
    if tangent:
        block = 0
        for i in range(3):
            for k in range(i + 1):
                for g in range(8):
                    for j in range(3):
                        _couple(
                            w,
                            (PRODUCT + 3 * g + j) * 8,
                            w,
                            (TANGENT + 9 * (3 * i + j) + 3 * k) * 8 + g,
                            w,
                            (SLOPES + 3 * g) * 8,
                        )
                _to_stiffness(w, (STIFFNESS + 8 * block) * 8, w, SLOPES * 8, w, PRODUCT * 8)
                block += 1
    return energy


@njit(parallel=True, **KERNEL)
def element_terms(
    q,
    hexes,
    by_point,
    by_node,
    volume,
    shares,
    law,
    moduli,
    damped,
    drift,
    strain,
    rate,
    strain_rate,
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
        by_point, by_node: gradients [1/m], (E, G, 8 nodes * 3 * 8 points), (E, G, 8 points * 3 * 8 nodes).
        volume: of each point [m^3], (E, G, 8).
        shares: how much of mu and of lambda the points of a group carry, (G, 2).
        law: number of the elastic law in `LAWS`.
        moduli: mu, lambda [Pa], viscosity [Pa s], stiffness damping times rest mu and lambda [Pa s], (B, 5).
        damped: whether the last three, and the four that follow, count.
        drift, rate: velocities are rate * q - drift, (B, N, 3) [m/s].
        strain, strain_rate: Green strain rates are strain_rate * E - strain, (B, E, 8 G, 6) [1/s].
        project: make the tangent positive semi-definite, point by point.
    """
    batch, cells, groups = q.shape[0], hexes.shape[0], volume.shape[1]
    chunks = (cells + CHUNK - 1) // CHUNK
    force = np.empty((batch, cells, 24))
    part = np.empty((batch, chunks))
    for task in prange(batch * chunks):
        t = task // chunks
        chunk = task % chunks
        w = np.empty(ROWS * 8)
        x = np.zeros(48)
        velocity = np.zeros(72)
        total = 0.0
        for e in range(chunk * CHUNK, min(cells, (chunk + 1) * CHUNK)):
            for n in range(8):
                node = hexes[e, n]
                for i in range(3):
                    x[3 * n + i] = q[t, node, i]
                    if damped:
                        x[24 + 3 * n + i] = rate * q[t, node, i] - drift[t, node, i]
            for i in range(24):
                w[FORCE * 8 + i] = 0.0
            if tangent:
                for i in range(BLOCKS * 64):
                    w[STIFFNESS * 8 + i] = 0.0
            for group in range(groups):
                for g in range(8):
                    w[WEIGHT * 8 + g] = volume[e, group, g]
                own = moduli[t] * shares[group, 0]
                own[4] = moduli[t, 4] * shares[group, 1]
                past = strain[t, e, 8 * group : 8 * group + 8] if damped else strain[0, 0]
                total += _cell(
                    w,
                    x,
                    by_point[e, group],
                    by_node[e, group],
                    law,
                    own[0],
                    moduli[t, 1] * shares[group, 1],
                    damped,
                    own,
                    velocity,
                    past,
                    rate,
                    strain_rate,
                    project,
                    tangent,
                )
            for i in range(24):
                force[t, e, i] = w[FORCE * 8 + i]
            if tangent:
                out = stiffness[t, e]
                for i in range(BLOCKS * 64):
                    out[i // 64, (i // 8) % 8, i % 8] = w[STIFFNESS * 8 + i]
        part[t, chunk] = total
    for t in prange(batch):
        energy[t] = part[t].sum()
        gradient[t] = 0.0
        for e in range(cells):
            for i in range(3):
                for n in range(8):
                    gradient[t, hexes[e, n], i] += force[t, e, 8 * i + n]


@njit(parallel=True, **KERNEL)
def multiply(stiffness, cells, hexes, x, out):
    """Fill out (B, N, 3) with the stiffnesses (B, E, 6, 8, 8) of some cells times x (B, N, 3)."""
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
