"""The paper's law: psi(F) = mu |F - R|^2 + (lambda / 2) |F - P|^2.

R is the polar rotation of F and P the nearest matrix with determinant 1. These are the corotational and volume
terms of projective dynamics. The law's linearisation has Lame parameter lambda / 3 instead of lambda.

P has the singular vectors of F. Its stretches p_i satisfy p_i + kappa / p_i = s_i, where kappa is the multiplier of
the constraint p_0 p_1 p_2 = 1. Each equation has an upper and a lower root.
"""

import numpy as np
import torch
from numba import njit
from torch import Tensor

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH, TEMPORARY
from rafl.fem.simd import KERNEL_OPTIONS

NEWTON_STEPS = 5  # stretches within 10 % of 1 need four
CONVERGED = 1e-14  # of the product of the stretches p


def rest_lame(mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Lame parameters of the law's linearisation at rest."""
    return mu, lam / 3.0


def _constrained_stretches(s: Tensor, kappa: Tensor, on_lower_branch: Tensor) -> Tensor:
    """Roots p (..., 3) of p + kappa / p = s. Where `on_lower_branch`, the last and smallest takes the lower root."""
    root = (s * s - 4.0 * kappa[..., None]).clamp_min(0.0).sqrt()
    upper = torch.where(s >= 0.0, 0.5 * (s + root), -2.0 * kappa[..., None] / (root - s))
    lower = 2.0 * kappa[..., None] / (s + root)
    return torch.cat([upper[..., :2], torch.where(on_lower_branch[..., None], lower[..., 2:], upper[..., 2:])], dim=-1)


def reference_projection(s: Tensor) -> tuple[Tensor, Tensor]:
    """Tensor version of `volume_projection`: kappa (...) and p (..., 3) for s (..., 3), descending.

    A few Newton steps find kappa at all points together, and bisection where p_0 p_1 p_2 does not reach 1.
    """
    volume, upper = s.prod(-1), torch.zeros(s.shape[:-1], dtype=torch.bool, device=s.device)
    kappa = 2.0 * (volume - 1.0) / ((volume + 1.0) * s.square().reciprocal().sum(-1))
    for _ in range(NEWTON_STEPS):
        p = 0.5 * (s + (s * s - 4.0 * kappa[..., None]).sqrt())
        volume = p.prod(-1)
        # 2 (x - 1) / (x + 1) approximates log x to third order, and log x is nearly linear in kappa.
        kappa = kappa + 2.0 * (volume - 1.0) / (volume + 1.0) / (p * p - kappa[..., None]).reciprocal().sum(-1)
    p = _constrained_stretches(s, kappa, upper)
    left = ~((p.prod(-1) - 1.0).abs() < CONVERGED)
    if left.any():
        kappa[left], p[left] = _bisected_projection(s[left])
    return kappa, p


def _bisected_projection(s: Tensor) -> tuple[Tensor, Tensor]:
    """`reference_projection` of any stretches s (..., 3), by bisection and some Newton steps.

    The sum of log p decreases with kappa on the upper branch and increases on the lower one.
    """
    smallest = s[..., 2]
    limit = 0.25 * smallest.clamp_min(0.0) ** 2
    upper_everywhere = torch.zeros_like(smallest, dtype=torch.bool)
    expanded = s.prod(-1) >= 1.0
    on_lower_branch = expanded & (_constrained_stretches(s, limit, upper_everywhere).log().sum(-1) > 0.0)
    lower = torch.where(expanded, torch.where(on_lower_branch, 1e-300, 0.0), -1e4 * (1.0 + s.abs().amax(-1)) ** 2)
    upper = torch.where(expanded | (smallest <= 0.0), limit, 0.0)
    for _ in range(80):
        kappa = 0.5 * (lower + upper)
        above = (_constrained_stretches(s, kappa, on_lower_branch).log().sum(-1) > 0.0) != on_lower_branch
        lower, upper = torch.where(above, kappa, lower), torch.where(above, upper, kappa)
    for _ in range(4):
        p = _constrained_stretches(s, kappa, on_lower_branch)
        slope = (1.0 / (p * p - kappa[..., None])).sum(-1)
        polished = kappa + p.log().sum(-1) / slope
        kappa = torch.where(polished.isfinite(), polished, kappa)
    return kappa, _constrained_stretches(s, kappa, on_lower_branch)


def reference_derivatives(s: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    kappa, p = reference_projection(s)
    mu, lam, kappa = mu[..., None], lam[..., None], kappa[..., None]
    gap = s - p
    energy = (mu * (s - 1.0) ** 2 + 0.5 * lam * gap**2).sum(-1)
    first = 2.0 * mu * (s - 1.0) + lam * gap
    # d p_i = d s_i / (1 - kappa / p_i^2) - d kappa / (p_i - kappa / p_i), with d kappa from sum d p_i / p_i = 0.
    t = 1.0 / (p - kappa / p)  # -d p_i / d kappa
    weight = (t / p).sum(-1, keepdim=True)
    dp_ds = torch.diag_embed(p * t) - (t / weight)[..., :, None] * t[..., None, :]
    identity = torch.eye(3, dtype=s.dtype, device=s.device)
    second = (2.0 * mu + lam)[..., None] * identity - lam[..., None] * dp_ds
    ratio = kappa / (p * p.roll(-1, -1))
    return energy, first, second, 2.0 * mu - lam * ratio / (1.0 - ratio)


@njit(**KERNEL_OPTIONS)
def _solve_stretches(s, kappa, on_upper_branch, p):
    """Fill p (3) with roots of p_i + kappa / p_i = s_i; return sum log p_i.

    The last root is the lower one unless `on_upper_branch`; the others are upper roots.
    """
    for i in range(3):
        root = np.sqrt(max(s[i] * s[i] - 4.0 * kappa, 0.0))
        if i == 2 and not on_upper_branch:
            p[i] = 2.0 * kappa / (s[i] + root)
        elif s[i] >= 0.0:
            p[i] = 0.5 * (s[i] + root)
        else:
            p[i] = -2.0 * kappa / (root - s[i])
    return np.log(p[0]) + np.log(p[1]) + np.log(p[2])


@njit(**KERNEL_OPTIONS)
def volume_projection(s, p):
    """Fill p (3) with the positive stretches of product 1 nearest to s (3), whose smallest is last; return kappa.

    Solves sum log p_i(kappa) = 0 by Newton's method, safeguarded by a bracket.
    """
    limit = 0.25 * s[2] * s[2] if s[2] > 0.0 else 0.0
    volume = s[0] * s[1] * s[2]
    on_upper_branch = True
    if volume >= 1.0:
        lo = 0.0
        hi = limit
        if _solve_stretches(s, limit, True, p) > 0.0:  # the smallest stretch takes the lower root
            on_upper_branch = False
            lo = 1e-300
    else:
        hi = limit if s[2] <= 0.0 else 0.0
        lo = -1.0
        while _solve_stretches(s, lo, True, p) < 0.0:
            lo *= 4.0
    # The sum decreases with kappa on the upper branch and increases on the lower branch.
    kappa = 0.5 * (lo + hi)
    if volume > 0.0 and on_upper_branch:
        # Near rest one linear step is a close first guess.
        inverse = 1.0 / (s[0] * s[0]) + 1.0 / (s[1] * s[1]) + 1.0 / (s[2] * s[2])
        guess = np.log(volume) / inverse
        if lo < guess < hi:
            kappa = guess
    for _ in range(200):
        h = _solve_stretches(s, kappa, on_upper_branch, p)
        slope = 0.0
        for i in range(3):
            slope -= 1.0 / (p[i] * p[i] - kappa)
        if (h > 0.0) == on_upper_branch:
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


@njit(**KERNEL_OPTIONS)
def _upper_root(stretch, kappa):
    """Upper root p of p + kappa / p = stretch."""
    return 0.5 * (stretch + np.sqrt(stretch * stretch - 4.0 * kappa))


def derivatives(w, mu, lam):
    """Fill ENERGY, FIRST, SECOND and FLIP from the stretches; see `rafl.fem.kernel_layout`.

    A few Newton steps find kappa at all points together. Points where p_0 p_1 p_2 does not reach 1 are solved
    one by one with `volume_projection`.
    """
    for g in range(8):
        s0 = w[STRETCH * 8 + g]
        s1 = w[(STRETCH + 1) * 8 + g]
        s2 = w[(STRETCH + 2) * 8 + g]
        volume = s0 * s1 * s2
        inverse = 1.0 / (s0 * s0) + 1.0 / (s1 * s1) + 1.0 / (s2 * s2)
        w[TEMPORARY * 8 + g] = 2.0 * (volume - 1.0) / ((volume + 1.0) * inverse)
    for _ in range(6):
        for g in range(8):
            s0 = w[STRETCH * 8 + g]
            s1 = w[(STRETCH + 1) * 8 + g]
            s2 = w[(STRETCH + 2) * 8 + g]
            kappa = w[TEMPORARY * 8 + g]
            p0 = _upper_root(s0, kappa)
            p1 = _upper_root(s1, kappa)
            p2 = _upper_root(s2, kappa)
            volume = p0 * p1 * p2
            a = p0 * p0 - kappa
            b = p1 * p1 - kappa
            c = p2 * p2 - kappa
            # 2 (x - 1) / (x + 1) approximates log x to third order, and log x is nearly linear in kappa.
            step = 2.0 * (volume - 1.0) / (volume + 1.0) * (a * b * c) / (b * c + a * c + a * b)
            w[TEMPORARY * 8 + g] = kappa + step
            w[(TEMPORARY + 1) * 8 + g] = abs(volume - 1.0)
        worst = 0.0
        for g in range(8):
            worst = max(worst, w[(TEMPORARY + 1) * 8 + g])
        if worst < 1e-9:  # Newton converges quadratically: the last step has squared this error
            break
    for g in range(8):
        s0 = w[STRETCH * 8 + g]
        s1 = w[(STRETCH + 1) * 8 + g]
        s2 = w[(STRETCH + 2) * 8 + g]
        kappa = w[TEMPORARY * 8 + g]
        p0 = _upper_root(s0, kappa)
        p1 = _upper_root(s1, kappa)
        p2 = _upper_root(s2, kappa)
        w[(TEMPORARY + 1) * 8 + g] = abs(p0 * p1 * p2 - 1.0)
        gap0 = kappa / p0
        gap1 = kappa / p1
        gap2 = kappa / p2
        e0 = s0 - 1.0
        e1 = s1 - 1.0
        e2 = s2 - 1.0
        w[ENERGY * 8 + g] = mu * (e0 * e0 + e1 * e1 + e2 * e2) + 0.5 * lam * (gap0 * gap0 + gap1 * gap1 + gap2 * gap2)
        w[FIRST * 8 + g] = 2.0 * mu * e0 + lam * gap0
        w[(FIRST + 1) * 8 + g] = 2.0 * mu * e1 + lam * gap1
        w[(FIRST + 2) * 8 + g] = 2.0 * mu * e2 + lam * gap2
        d0 = 1.0 - gap0 / p0
        d1 = 1.0 - gap1 / p1
        d2 = 1.0 - gap2 / p2
        t0 = 1.0 / (p0 * d0)
        t1 = 1.0 / (p1 * d1)
        t2 = 1.0 / (p2 * d2)
        coupling = lam / (t0 / p0 + t1 / p1 + t2 / p2)
        w[SECOND * 8 + g] = 2.0 * mu + lam - lam / d0 + coupling * t0 * t0
        w[(SECOND + 1) * 8 + g] = 2.0 * mu + lam - lam / d1 + coupling * t1 * t1
        w[(SECOND + 2) * 8 + g] = 2.0 * mu + lam - lam / d2 + coupling * t2 * t2
        w[(SECOND + 3) * 8 + g] = coupling * t0 * t1
        w[(SECOND + 4) * 8 + g] = coupling * t1 * t2
        w[(SECOND + 5) * 8 + g] = coupling * t2 * t0
        ratio = kappa / (p0 * p1)
        w[FLIP * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
        ratio = kappa / (p1 * p2)
        w[(FLIP + 1) * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
        ratio = kappa / (p2 * p0)
        w[(FLIP + 2) * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
    for g in range(8):
        if not w[(TEMPORARY + 1) * 8 + g] < 1e-14:
            _fill_lane(w, mu, lam, g)


@njit(**KERNEL_OPTIONS)
def _fill_lane(w, mu, lam, g):
    """Fill the derivatives of SIMD lane g by `volume_projection`."""
    s = np.empty(3)
    p = np.empty(3)
    d = np.empty(3)
    # `volume_projection` expects the smallest stretch last.
    least = 0
    for i in range(3):
        if w[(STRETCH + i) * 8 + g] < w[(STRETCH + least) * 8 + g]:
            least = i
    for i in range(3):
        s[i] = w[(STRETCH + (least + 1 + i) % 3) * 8 + g]
    kappa = volume_projection(s, p)
    energy = 0.0
    weight = 0.0
    for i in range(3):
        index = (least + 1 + i) % 3
        gap = kappa / p[i]
        d[i] = 1.0 - gap / p[i]
        weight += 1.0 / (p[i] * p[i] * d[i])
        energy += mu * (s[i] - 1.0) ** 2 + 0.5 * lam * gap * gap
        w[(FIRST + index) * 8 + g] = 2.0 * mu * (s[i] - 1.0) + lam * gap
    w[ENERGY * 8 + g] = energy
    for i in range(3):
        j = (i + 1) % 3
        index = (least + 1 + i) % 3
        w[(SECOND + index) * 8 + g] = 2.0 * mu + lam - lam / d[i] + lam / ((p[i] * d[i]) ** 2 * weight)
        w[(SECOND + 3 + index) * 8 + g] = lam / (p[i] * d[i] * p[j] * d[j] * weight)
        ratio = kappa / (p[i] * p[j])
        w[(FLIP + index) * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
