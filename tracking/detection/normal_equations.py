"""Normal equations of a disc's linearised pixels, and their solution by Cholesky factorisation."""

import numpy as np
from numba import njit

from rafl.tracking.detection.disc_model import (
    CHUNK,
    FAST,
    MAX_PIXELS,
    PARAMETER_COUNT,
    WEIGHT,
    WEIGHTED,
    J,
    linearise,
    pad_to_lanes,
)


@njit(**FAST)
def normal_equations(p, instants, x0, y0, count, w, H):
    """Fill the lower triangle of H (13, 13): J W J^T, in the last row J W r and the weighted squared residual."""
    H[:] = 0.0
    for first in range(0, count, CHUNK):
        some = pad_to_lanes(min(CHUNK, count - first))
        linearise(p, instants, x0, y0, first, some, w)
        add_products(first, some, w, H)


@njit(**FAST)
def add_products(first, count, w, H):
    """Add a chunk of linearised pixels to H (13, 13)."""
    count = min(count, CHUNK)
    first = min(max(first, 0), MAX_PIXELS - CHUNK)
    for i in range(0, PARAMETER_COUNT, 2):  # two rows by four columns at once: fewer loads
        row = J + i * CHUNK
        for k in range(count):
            weight = w[WEIGHT + first + k]
            w[WEIGHTED + k] = weight * w[row + k]
            w[WEIGHTED + CHUNK + k] = weight * w[row + CHUNK + k]
        for j in range(0, i + 2, 4):  # beyond the diagonal too
            column = J + j * CHUNK
            sum00 = sum01 = sum02 = sum03 = np.float32(0.0)
            sum10 = sum11 = sum12 = sum13 = np.float32(0.0)
            for k in range(count):
                factor0 = w[WEIGHTED + k]
                factor1 = w[WEIGHTED + CHUNK + k]
                value0 = w[column + k]
                value1 = w[column + CHUNK + k]
                value2 = w[column + 2 * CHUNK + k]
                value3 = w[column + 3 * CHUNK + k]
                sum00 += factor0 * value0
                sum01 += factor0 * value1
                sum02 += factor0 * value2
                sum03 += factor0 * value3
                sum10 += factor1 * value0
                sum11 += factor1 * value1
                sum12 += factor1 * value2
                sum13 += factor1 * value3
            H[i, j] += sum00
            H[i, j + 1] += sum01
            H[i, j + 2] += sum02
            H[i, j + 3] += sum03
            H[i + 1, j] += sum10
            H[i + 1, j + 1] += sum11
            H[i + 1, j + 2] += sum12
            H[i + 1, j + 3] += sum13
    squares, _ = add_scores(first, count, w, H[PARAMETER_COUNT])
    H[PARAMETER_COUNT, PARAMETER_COUNT] += squares


@njit(**FAST)
def add_scores(first, count, w, score):
    """Add a chunk of linearised pixels to score (12), J W r; returns its weighted squared residual and its weight."""
    count = min(count, CHUNK)
    first = min(max(first, 0), MAX_PIXELS - CHUNK)
    squares = np.float32(0.0)
    total_weight = np.float32(0.0)
    for k in range(count):
        w[WEIGHTED + k] = w[WEIGHT + first + k] * w[J + 12 * CHUNK + k]
        squares += w[WEIGHTED + k] * w[J + 12 * CHUNK + k]
        total_weight += w[WEIGHT + first + k]
    for i in range(PARAMETER_COUNT):
        row = J + i * CHUNK
        total = np.float32(0.0)
        for k in range(count):
            total += w[WEIGHTED + k] * w[row + k]
        score[i] += total
    return squares, total_weight


@njit(**FAST)
def factorise(H, damping, L):
    """Cholesky factor: L L^T = H + damping diag H, L's diagonal as reciprocals; False if not positive definite."""
    for j in range(PARAMETER_COUNT):
        for i in range(j, PARAMETER_COUNT):
            L[i, j] = H[i, j]
        L[j, j] += (damping + 1e-9) * H[j, j] + 1e-12
    for j in range(PARAMETER_COUNT):
        if not L[j, j] > 0.0:
            return False
        L[j, j] = 1.0 / np.sqrt(L[j, j])
        for i in range(j + 1, PARAMETER_COUNT):
            L[i, j] *= L[j, j]
        for k in range(j + 1, PARAMETER_COUNT):
            for i in range(k, PARAMETER_COUNT):
                L[i, k] -= L[i, j] * L[k, j]
    return True


@njit(**FAST)
def substitute(L, x):
    """Solve in place: x becomes (L L^T)^-1 x."""
    for i in range(PARAMETER_COUNT):  # by columns: the products of a step are independent
        x[i] *= L[i, i]
        for k in range(i + 1, PARAMETER_COUNT):
            x[k] -= L[k, i] * x[i]
    for i in range(PARAMETER_COUNT - 1, -1, -1):
        x[i] *= L[i, i]
        for k in range(i):
            x[k] -= L[i, k] * x[i]
