"""Elastic energy, nodal gradient and tangent of a batch of deformed meshes."""

import numpy as np
from numba import njit, prange

from rafl.projective import signed_svd, stretch_derivatives


@njit(cache=True)
def _project_symmetric(A):  # type: ignore[no-untyped-def]
    """Replace the negative eigenvalues of A (3, 3) by zero, in place; nothing to do when definite."""
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    determinant = (
        A[2, 2] * minor - A[0, 0] * A[1, 2] * A[1, 2] - A[1, 1] * A[0, 2] * A[0, 2] + 2.0 * A[0, 1] * A[0, 2] * A[1, 2]
    )
    if A[0, 0] > 0.0 and minor > 0.0 and determinant > 0.0:
        return
    values, vectors = np.linalg.eigh(A)
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += vectors[i, k] * max(values[k], 0.0) * vectors[j, k]
            A[i, j] = total


@njit(cache=True, parallel=True)
def element_terms(q, hexes, gradient, volume, mu, lam, project, tangent, energy, force, stiffness):  # type: ignore[no-untyped-def]
    """Fill each cell's energy (B, E), gradient (B, E, 8, 3) and, if `tangent`, stiffness (B, E, 24, 24).

    q (B, N, 3) [m]; mu, lam (B) [Pa]; with `project` the tangent is made positive semi-definite
    point by point. Only blocks (a, b) with a >= b of the stiffness are filled.
    """
    batch, cells = q.shape[0], hexes.shape[0]
    for index in prange(batch * cells):
        t = index // cells
        e = index % cells
        F = np.empty((3, 3))
        U = np.empty((3, 3))
        V = np.empty((3, 3))
        A = np.empty((3, 3))
        g = np.empty((8, 3))
        h = np.empty((3, 3))
        Uh = np.empty((3, 3))
        s = np.empty(3)
        p = np.empty(3)
        first = np.empty(3)
        twist = np.empty(3)
        flip = np.empty(3)
        alpha = np.empty((3, 3))
        beta = np.empty((3, 3))
        f = force[t, e]
        K = stiffness[t, e]
        f[:] = 0.0
        if tangent:
            K[:] = 0.0
        total = 0.0
        for point in range(8):
            w = volume[e, point]
            for i in range(3):
                for j in range(3):
                    value = 0.0
                    for n in range(8):
                        value += q[t, hexes[e, n], i] * gradient[e, point, n, j]
                    F[i, j] = value
            signed_svd(F, U, s, V)
            total += w * stretch_derivatives(s, mu[t], lam[t], first, A, twist, flip, p)
            for n in range(8):
                for j in range(3):
                    g[n, j] = (
                        V[0, j] * gradient[e, point, n, 0]
                        + V[1, j] * gradient[e, point, n, 1]
                        + V[2, j] * gradient[e, point, n, 2]
                    )
                for i in range(3):
                    f[n, i] += w * (
                        U[i, 0] * first[0] * g[n, 0] + U[i, 1] * first[1] * g[n, 1] + U[i, 2] * first[2] * g[n, 2]
                    )
            if not tangent:
                continue
            if project:
                _project_symmetric(A)
            for k in range(3):
                i = k
                j = (k + 1) % 3
                anti = max(twist[k], 0.0) if project else twist[k]
                sym = max(flip[k], 0.0) if project else flip[k]
                alpha[i, j] = alpha[j, i] = 0.5 * w * (sym + anti)
                beta[i, j] = beta[j, i] = 0.5 * w * (sym - anti)
            for i in range(3):
                alpha[i, i] = w * A[i, i]
                beta[i, i] = 0.0
            for a in range(8):
                for b in range(a + 1):
                    for i in range(3):
                        for k in range(3):
                            if i == k:
                                h[i, i] = (
                                    alpha[i, 0] * g[a, 0] * g[b, 0]
                                    + alpha[i, 1] * g[a, 1] * g[b, 1]
                                    + alpha[i, 2] * g[a, 2] * g[b, 2]
                                )
                            else:
                                h[i, k] = w * A[i, k] * g[a, i] * g[b, k] + beta[i, k] * g[a, k] * g[b, i]
                    for i in range(3):
                        for k in range(3):
                            Uh[i, k] = U[i, 0] * h[0, k] + U[i, 1] * h[1, k] + U[i, 2] * h[2, k]
                    for i in range(3):
                        for k in range(3):
                            K[3 * a + i, 3 * b + k] += Uh[i, 0] * U[k, 0] + Uh[i, 1] * U[k, 1] + Uh[i, 2] * U[k, 2]
        energy[t, e] = total


@njit(cache=True)
def scatter_gradient(force, hexes, out):  # type: ignore[no-untyped-def]
    """Add the cells' gradients (E, 8, 3) to the nodes, out (N, 3)."""
    for e in range(hexes.shape[0]):
        for n in range(8):
            for i in range(3):
                out[hexes[e, n], i] += force[e, n, i]


@njit(cache=True)
def scatter_band(stiffness, hexes, unknown, band):  # type: ignore[no-untyped-def]
    """Add the cells' stiffnesses (E, 24, 24) to the lower band (width, n) of the free unknowns.

    unknown (N): position of a node's first unknown in the band ordering, -1 where it is held.
    """
    for e in range(hexes.shape[0]):
        for a in range(8):
            row = unknown[hexes[e, a]]
            if row < 0:
                continue
            for b in range(a + 1):
                column = unknown[hexes[e, b]]
                if column < 0:
                    continue
                for i in range(3):
                    for k in range(3):
                        if a == b and k > i:
                            continue
                        r = row + i
                        c = column + k
                        if r >= c:
                            band[r - c, c] += stiffness[e, 3 * a + i, 3 * b + k]
                        else:
                            band[c - r, r] += stiffness[e, 3 * a + i, 3 * b + k]


@njit(cache=True)
def multiply(stiffness, hexes, x, out):  # type: ignore[no-untyped-def]
    """Add the cells' stiffnesses (E, 24, 24), given by their lower blocks, times x (N, 3) to out (N, 3)."""
    for e in range(hexes.shape[0]):
        for a in range(8):
            for b in range(a + 1):
                for i in range(3):
                    for k in range(3):
                        value = stiffness[e, 3 * a + i, 3 * b + k]
                        out[hexes[e, a], i] += value * x[hexes[e, b], k]
                        if a != b:
                            out[hexes[e, b], k] += value * x[hexes[e, a], i]
