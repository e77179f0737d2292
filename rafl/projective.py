"""The paper's elastic energy at one material point, by its signed singular values.

psi(F) = mu |F - R|^2 + (lambda / 2) |F - P|^2, R the polar rotation and P the nearest matrix with
determinant 1: projective dynamics' corotational term and volume term.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def signed_svd(F, U, s, V):  # type: ignore[no-untyped-def]
    """F = U diag(s) V^T by one-sided Jacobi; U, V rotations, s descending, only s[2] may be negative.

    F (3, 3) is read; U (3, 3), s (3), V (3, 3) are filled. Repeated stretches are no special case.
    """
    B = U
    for i in range(3):
        for j in range(3):
            B[i, j] = F[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off = 0.0
        for p in range(2):
            for r in range(p + 1, 3):
                a = B[0, p] * B[0, p] + B[1, p] * B[1, p] + B[2, p] * B[2, p]
                b = B[0, r] * B[0, r] + B[1, r] * B[1, r] + B[2, r] * B[2, r]
                c = B[0, p] * B[0, r] + B[1, p] * B[1, r] + B[2, p] * B[2, r]
                size = np.sqrt(a) * np.sqrt(b)
                if abs(c) <= 1e-17 * size or size < 1e-150:
                    continue
                off = max(off, abs(c) / size)
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
        if off < 1e-15:
            break
    for i in range(3):
        s[i] = np.sqrt(B[0, i] * B[0, i] + B[1, i] * B[1, i] + B[2, i] * B[2, i])
    for p, r in ((0, 1), (1, 2), (0, 1)):
        if s[p] < s[r]:
            s[p], s[r] = s[r], s[p]
            for i in range(3):  # swap with one sign change, so that V stays a rotation
                x = B[i, p]
                B[i, p] = B[i, r]
                B[i, r] = -x
                x = V[i, p]
                V[i, p] = V[i, r]
                V[i, r] = -x
    for i in range(3):
        B[i, 0] /= s[0]
    if s[1] > 0.0:
        for i in range(3):
            B[i, 1] /= s[1]
    else:  # rank one: any direction across the first serves
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


@njit(cache=True)
def _roots(s, kappa, plus, p):  # type: ignore[no-untyped-def]
    """Solve p_i + kappa / p_i = s_i for p (3); the last by its minus branch unless `plus`.

    Returns sum log p_i.
    """
    for i in range(3):
        root = np.sqrt(max(s[i] * s[i] - 4.0 * kappa, 0.0))
        if i == 2 and not plus:
            p[i] = 2.0 * kappa / (s[i] + root)
        elif s[i] >= 0.0:
            p[i] = 0.5 * (s[i] + root)
        else:
            p[i] = -2.0 * kappa / (root - s[i])
    return np.log(p[0]) + np.log(p[1]) + np.log(p[2])


@njit(cache=True)
def volume_projection(s, p):  # type: ignore[no-untyped-def]
    """Fill p (3), the positive triple of product 1 nearest to the stretches s (3).

    The multiplier kappa of the constraint satisfies p_i + kappa / p_i = s_i and is returned.
    Newton's method on sum log p_i(kappa) = 0, kept inside a bracket.
    """
    limit = 0.25 * s[2] * s[2] if s[2] > 0.0 else 0.0
    volume = s[0] * s[1] * s[2]
    plus = True
    if volume >= 1.0:
        lo = 0.0
        hi = limit
        if _roots(s, limit, True, p) > 0.0:  # past the fold: the smallest stretch takes the other root
            plus = False
            lo = 1e-300
    else:
        hi = limit if s[2] <= 0.0 else 0.0
        lo = -1.0
        while _roots(s, lo, True, p) < 0.0:
            lo *= 4.0
    # On the plus branch the sum falls with kappa; on the minus branch it rises.
    kappa = 0.5 * (lo + hi)
    if volume > 0.0 and plus:
        # Near rest one linear step is already close.
        inverse = 1.0 / (s[0] * s[0]) + 1.0 / (s[1] * s[1]) + 1.0 / (s[2] * s[2])
        guess = np.log(volume) / inverse
        if lo < guess < hi:
            kappa = guess
    for _ in range(200):
        h = _roots(s, kappa, plus, p)
        slope = 0.0
        for i in range(3):
            slope -= 1.0 / (p[i] * p[i] - kappa)
        if (h > 0.0) == plus:
            lo = kappa
        else:
            hi = kappa
        step = -h / slope if slope != 0.0 else 0.0
        new = kappa + step
        if not (lo < new < hi):
            new = 0.5 * (lo + hi)
        if abs(h) < 5e-16 or abs(new - kappa) <= 1e-16 * (1e-3 + abs(kappa)):
            break
        kappa = new
    return kappa


@njit(cache=True)
def stretch_derivatives(s, mu, lam, first, second, twist, flip, p):  # type: ignore[no-untyped-def]
    """Energy density and its derivatives at the stretches s (3).

    Fills `first` (3), d psi / d s; `second` (3, 3), d^2 psi / d s^2; and for the pairs (0,1), (1,2),
    (2,0) the stiffnesses `twist` (3), (psi_i + psi_j) / (s_i + s_j), and `flip` (3),
    (psi_i - psi_j) / (s_i - s_j), both without dividing by a difference. Returns psi [J/m^3].
    """
    kappa = volume_projection(s, p)
    energy = 0.0
    weight = 0.0
    for i in range(3):
        gap = kappa / p[i]  # s_i - p_i
        energy += mu * (s[i] - 1.0) ** 2 + 0.5 * lam * gap * gap
        first[i] = 2.0 * mu * (s[i] - 1.0) + lam * gap
        weight += 1.0 / (p[i] * p[i] - kappa)
    for i in range(3):
        di = 1.0 - kappa / (p[i] * p[i])
        for j in range(3):
            dj = 1.0 - kappa / (p[j] * p[j])
            slope = -1.0 / (p[i] * di * p[j] * dj * weight)
            if i == j:
                slope += 1.0 / di
            second[i, j] = (2.0 * mu + lam if i == j else 0.0) - lam * slope
    for k in range(3):
        i = k
        j = (k + 1) % 3
        total = s[i] + s[j]
        if abs(total) < 1e-8:
            total = 1e-8 if total >= 0.0 else -1e-8
        ratio = kappa / (p[i] * p[j])
        twist[k] = (first[i] + first[j]) / total
        flip[k] = 2.0 * mu + lam * (1.0 - 1.0 / (1.0 - ratio))
    return energy
