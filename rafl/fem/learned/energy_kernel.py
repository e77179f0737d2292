"""Compiled derivatives of the learned strain energy; see `rafl.fem.learned.energy`."""

import numpy as np
from numba import njit

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH
from rafl.fem.learned.energy import KINDS, SCALES
from rafl.fem.simd import KERNEL_OPTIONS


@njit(**KERNEL_OPTIONS)
def _unit_sums(z, weights, first, out):
    """Fill out with value, slope and second derivative by z of the units `first` and following."""
    out[0] = 0.0
    out[1] = 0.0
    out[2] = 0.0
    for k in range(len(SCALES)):
        c = SCALES[k]
        soft = weights[first + 2 * k]
        stiff = weights[first + 2 * k + 1]
        root = np.sqrt(1.0 + z / c)
        radius = np.sqrt(z * z + c * c)
        out[0] += soft * 2.0 * z / (root + 1.0) + stiff * z * z / (radius + c)
        out[1] += soft / root + stiff * z / radius
        out[2] += stiff * c * c / (radius * radius * radius) - soft * 0.5 / (c * root * root * root)


@njit(**KERNEL_OPTIONS)
def add_learned_energy(w, weights, share):
    """Add the energy of weights (UNITS) [Pa] times `share` to ENERGY, FIRST, SECOND and FLIP of the scratch."""
    e = np.empty(3)
    u = np.empty(3)
    area = np.empty(3)
    x_first = np.empty(3)
    y_first = np.empty(3)
    by_x = np.empty(3)
    by_y = np.empty(3)
    for g in range(8):
        for i in range(3):
            e[i] = w[(STRETCH + i) * 8 + g] - 1.0
            u[i] = e[i] * (2.0 + e[i])
        pairs = e[0] * e[1] + e[1] * e[2] + e[2] * e[0]
        triple = e[0] * e[1] * e[2]
        d = triple + pairs + e[0] + e[1] + e[2]
        squares = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        # Terms of first order in e cancel; they are left out.
        x = 0.25 * (u[0] * u[0] + u[1] * u[1] + u[2] * u[2]) + 0.5 * squares - pairs - triple + 0.5 * d * d
        y = 2.0 * squares + u[0] * u[1] + u[1] * u[2] + u[2] * u[0] - 4.0 * (pairs + triple)
        _unit_sums(max(x, 0.0), weights, 0, by_x)
        _unit_sums(max(y, 0.0), weights, len(SCALES) * KINDS, by_y)
        for i in range(3):
            a = (i + 1) % 3
            b = (i + 2) % 3
            change = e[a] + e[b] + e[a] * e[b]  # of s_a s_b
            area[i] = 1.0 + change
            x_first[i] = e[i] * (3.0 + e[i] * (3.0 + e[i])) - change + d * area[i]
            y_first[i] = 4.0 * e[i] + 2.0 * (1.0 + e[i]) * (u[a] + u[b]) - 4.0 * change
        w[ENERGY * 8 + g] += share * (by_x[0] + by_y[0])
        for i in range(3):
            j = (i + 1) % 3
            k = (i + 2) % 3
            s_i = 1.0 + e[i]
            s_j = 1.0 + e[j]
            s_k = 1.0 + e[k]
            w[(FIRST + i) * 8 + g] += share * (by_x[1] * x_first[i] + by_y[1] * y_first[i])
            w[(SECOND + i) * 8 + g] += share * (
                by_x[1] * (3.0 * s_i * s_i + area[i] * area[i])
                + by_y[1] * 2.0 * (s_j * s_j + s_k * s_k)
                + by_x[2] * x_first[i] * x_first[i]
                + by_y[2] * y_first[i] * y_first[i]
            )
            w[(SECOND + 3 + i) * 8 + g] += share * (
                by_x[1] * ((d - 1.0) * s_k + area[i] * area[j])
                + by_y[1] * 4.0 * (s_i * s_j - s_k)
                + by_x[2] * x_first[i] * x_first[j]
                + by_y[2] * y_first[i] * y_first[j]
            )
            w[(FLIP + i) * 8 + g] += share * (
                by_x[1] * (s_i * s_i + s_i * s_j + s_j * s_j - (d - 1.0) * s_k)
                + by_y[1] * (2.0 * (s_k * s_k - s_i * s_j) + 4.0 * s_k)
            )
