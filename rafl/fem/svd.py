"""Singular value decompositions of 3 x 3 matrices into two rotations and signed singular values."""

import numpy as np
from numba import njit

from rafl.fem.kernel_layout import DEFORMATION, STRETCH, TEMPORARY, U, V
from rafl.fem.simd import KERNEL_OPTIONS

MIN_BATCH_DETERMINANT = 0.05  # det F; at or below it `signed_svd` decomposes the matrix on its own
# Ratio of the second stretch to the largest. The square of a smaller stretch loses digits or underflows to zero.
MIN_RELATIVE_STRETCH = 1e-100


@njit(**KERNEL_OPTIONS)
def signed_svd(F, U, s, V):
    """Compute F = U diag(s) V^T by one-sided Jacobi, with rotations U and V.

    s (3) is descending and only s[2] may be negative. F (3, 3) is read; U (3, 3), s and V (3, 3) are filled.
    Repeated stretches need no special case.
    """
    B = U
    for i in range(3):
        for j in range(3):
            B[i, j] = F[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off_diagonal = 0.0
        for p in range(2):
            for r in range(p + 1, 3):
                a = B[0, p] * B[0, p] + B[1, p] * B[1, p] + B[2, p] * B[2, p]
                b = B[0, r] * B[0, r] + B[1, r] * B[1, r] + B[2, r] * B[2, r]
                c = B[0, p] * B[0, r] + B[1, p] * B[1, r] + B[2, p] * B[2, r]
                size = np.sqrt(a) * np.sqrt(b)
                if abs(c) <= 1e-17 * size or size < 1e-150:
                    continue
                off_diagonal = max(off_diagonal, abs(c) / size)
                zeta = (b - a) / (2.0 * c)
                t = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                cos = 1.0 / np.sqrt(1.0 + t * t)
                sin = cos * t
                for i in range(3):
                    x = B[i, p]
                    y = B[i, r]
                    B[i, p] = cos * x - sin * y
                    B[i, r] = sin * x + cos * y
                    x = V[i, p]
                    y = V[i, r]
                    V[i, p] = cos * x - sin * y
                    V[i, r] = sin * x + cos * y
        if off_diagonal < 1e-15:
            break
    for i in range(3):
        s[i] = np.sqrt(B[0, i] * B[0, i] + B[1, i] * B[1, i] + B[2, i] * B[2, i])
    for p, r in ((0, 1), (1, 2), (0, 1)):
        if s[p] < s[r]:
            s[p], s[r] = s[r], s[p]
            for i in range(3):  # swap columns and negate one, so that V stays a rotation
                x = B[i, p]
                B[i, p] = B[i, r]
                B[i, r] = -x
                x = V[i, p]
                V[i, p] = V[i, r]
                V[i, r] = -x
    for i in range(3):
        B[i, 0] /= s[0]
    along = B[0, 0] * B[0, 1] + B[1, 0] * B[1, 1] + B[2, 0] * B[2, 1]
    if s[1] > MIN_RELATIVE_STRETCH * s[0] and abs(along) < 1e-8 * s[1]:
        for i in range(3):
            B[i, 1] /= s[1]
    else:  # rank one: the second column is zero or rounding error; take any direction normal to the first
        k = 0
        for i in range(3):
            if abs(B[i, 0]) < abs(B[k, 0]):
                k = i
        for i in range(3):
            B[i, 1] = (1.0 if i == k else 0.0) - B[k, 0] * B[i, 0]
        norm = np.sqrt(B[0, 1] ** 2 + B[1, 1] ** 2 + B[2, 1] ** 2)
        for i in range(3):
            B[i, 1] /= norm
    x = B[1, 0] * B[2, 1] - B[2, 0] * B[1, 1]
    y = B[2, 0] * B[0, 1] - B[0, 0] * B[2, 1]
    z = B[0, 0] * B[1, 1] - B[1, 0] * B[0, 1]
    s[2] = x * B[0, 2] + y * B[1, 2] + z * B[2, 2]
    B[0, 2] = x
    B[1, 2] = y
    B[2, 2] = z


@njit(**KERNEL_OPTIONS)
def signed_svd_simd(w):
    """Decompose the eight deformation gradients of the scratch array at once.

    Fills U, STRETCH and V. Stretches are in any order; one of them is negative only if det F is.
    """
    for r in range(9):
        for g in range(8):
            w[(U + r) * 8 + g] = w[(DEFORMATION + r) * 8 + g]
            w[(V + r) * 8 + g] = 1.0 if r % 4 == 0 else 0.0
    for _ in range(30):
        for g in range(8):
            w[(TEMPORARY + 2) * 8 + g] = 0.0
        for pair in range(3):
            p = 0 if pair < 2 else 1
            r = 1 if pair == 0 else 2
            for g in range(8):
                x0 = w[(U + p) * 8 + g]
                x1 = w[(U + 3 + p) * 8 + g]
                x2 = w[(U + 6 + p) * 8 + g]
                y0 = w[(U + r) * 8 + g]
                y1 = w[(U + 3 + r) * 8 + g]
                y2 = w[(U + 6 + r) * 8 + g]
                a = x0 * x0 + x1 * x1 + x2 * x2
                b = y0 * y0 + y1 * y1 + y2 * y2
                c = x0 * y0 + x1 * y1 + x2 * y2
                half = 0.5 * (b - a)
                t = c / (half + np.copysign(np.sqrt(half * half + c * c), half) + 1e-300)
                cos = 1.0 / np.sqrt(1.0 + t * t)
                w[TEMPORARY * 8 + g] = cos
                w[(TEMPORARY + 1) * 8 + g] = cos * t
                # Iterate down to rounding: with repeated stretches, one sweep need not suffice.
                off_diagonal = c * c - 1e-30 * a * b
                largest = w[(TEMPORARY + 2) * 8 + g]
                w[(TEMPORARY + 2) * 8 + g] = off_diagonal if off_diagonal > largest else largest
            for i in range(6):  # three rows of U, then three of V
                for g in range(8):
                    cos = w[TEMPORARY * 8 + g]
                    sin = w[(TEMPORARY + 1) * 8 + g]
                    x = w[(U + 3 * i + p) * 8 + g]
                    y = w[(U + 3 * i + r) * 8 + g]
                    w[(U + 3 * i + p) * 8 + g] = cos * x - sin * y
                    w[(U + 3 * i + r) * 8 + g] = sin * x + cos * y
        worst = 0.0
        for g in range(8):
            worst = max(worst, w[(TEMPORARY + 2) * 8 + g])
        if worst <= 0.0:
            break
    for g in range(8):
        a0 = w[U * 8 + g]
        a1 = w[(U + 3) * 8 + g]
        a2 = w[(U + 6) * 8 + g]
        b0 = w[(U + 1) * 8 + g]
        b1 = w[(U + 4) * 8 + g]
        b2 = w[(U + 7) * 8 + g]
        c0 = w[(U + 2) * 8 + g]
        c1 = w[(U + 5) * 8 + g]
        c2 = w[(U + 8) * 8 + g]
        a = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
        b = np.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
        c = np.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
        w[(TEMPORARY + 2) * 8 + g] = a0 * (b1 * c2 - b2 * c1) + a1 * (b2 * c0 - b0 * c2) + a2 * (b0 * c1 - b1 * c0)
        w[STRETCH * 8 + g] = a
        w[(STRETCH + 1) * 8 + g] = b
        w[(STRETCH + 2) * 8 + g] = c
        w[U * 8 + g] = a0 / a
        w[(U + 3) * 8 + g] = a1 / a
        w[(U + 6) * 8 + g] = a2 / a
        w[(U + 1) * 8 + g] = b0 / b
        w[(U + 4) * 8 + g] = b1 / b
        w[(U + 7) * 8 + g] = b2 / b
        w[(U + 2) * 8 + g] = c0 / c
        w[(U + 5) * 8 + g] = c1 / c
        w[(U + 8) * 8 + g] = c2 / c
    for g in range(8):
        if not w[(TEMPORARY + 2) * 8 + g] > MIN_BATCH_DETERMINANT:
            _decompose_lane(w, g)


@njit(**KERNEL_OPTIONS)
def _decompose_lane(w, g):
    """Decompose the deformation gradient of SIMD lane g with `signed_svd`."""
    F = np.empty((3, 3))
    left = np.empty((3, 3))
    right = np.empty((3, 3))
    s = np.empty(3)
    for i in range(3):
        for j in range(3):
            F[i, j] = w[(DEFORMATION + 3 * i + j) * 8 + g]
    signed_svd(F, left, s, right)
    for i in range(3):
        w[(STRETCH + i) * 8 + g] = s[i]
        for j in range(3):
            w[(U + 3 * i + j) * 8 + g] = left[i, j]
            w[(V + 3 * i + j) * 8 + g] = right[i, j]
