"""The paper's law: psi(F) = mu |F - R|^2 + (lambda / 2) |F - P|^2.

R is the polar rotation and P the nearest matrix with determinant 1: projective dynamics' corotational
and volume terms. To first order the bulk term is lambda / 3, not lambda.
"""

import numpy as np
import torch
from numba import njit
from torch import Tensor

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH, TEMPORARY
from rafl.fem.simd import KERNEL


def rest_lame(mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Lame parameters of the linear elasticity this law starts with."""
    return mu, lam / 3.0


def _root(s: Tensor, kappa: Tensor, minus: Tensor) -> Tensor:
    """p (..., 3) with p + kappa / p = s; the smallest stretch, last, takes the lower root where `minus`."""
    root = (s * s - 4.0 * kappa[..., None]).clamp_min(0.0).sqrt()
    upper = torch.where(s >= 0.0, 0.5 * (s + root), -2.0 * kappa[..., None] / (root - s))
    lower = 2.0 * kappa[..., None] / (s + root)
    return torch.cat([upper[..., :2], torch.where(minus[..., None], lower[..., 2:], upper[..., 2:])], dim=-1)


def plain_projection(s: Tensor) -> tuple[Tensor, Tensor]:
    """kappa (...) and the positive triple p (..., 3) of product 1 nearest to s (..., 3), descending.

    Bisection in kappa on sum log p, which falls along the upper roots and rises along the lower one,
    then Newton's steps.
    """
    smallest = s[..., 2]
    limit = 0.25 * smallest.clamp_min(0.0) ** 2
    never = torch.zeros_like(smallest, dtype=torch.bool)
    swollen = s.prod(-1) >= 1.0
    minus = swollen & (_root(s, limit, never).log().sum(-1) > 0.0)
    lower = torch.where(swollen, torch.where(minus, 1e-300, 0.0), -1e4 * (1.0 + s.abs().amax(-1)) ** 2)
    upper = torch.where(swollen | (smallest <= 0.0), limit, 0.0)
    for _ in range(80):
        kappa = 0.5 * (lower + upper)
        above = (_root(s, kappa, minus).log().sum(-1) > 0.0) != minus
        lower, upper = torch.where(above, kappa, lower), torch.where(above, upper, kappa)
    for _ in range(4):
        p = _root(s, kappa, minus)
        slope = (1.0 / (p * p - kappa[..., None])).sum(-1)
        polished = kappa + p.log().sum(-1) / slope
        kappa = torch.where(polished.isfinite(), polished, kappa)
    return kappa, _root(s, kappa, minus)


def plain_derivatives(s: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same in plain words: energy (...), first (..., 3), second (..., 3, 3), flip (..., 3) at s (..., 3)."""
    kappa, p = plain_projection(s)
    mu, lam, kappa = mu[..., None], lam[..., None], kappa[..., None]
    gap = s - p
    energy = (mu * (s - 1.0) ** 2 + 0.5 * lam * gap**2).sum(-1)
    first = 2.0 * mu * (s - 1.0) + lam * gap
    # d p_i = d s_i / (1 - kappa / p_i^2) - d kappa / (p_i - kappa / p_i), and the p keep product 1.
    by_kappa = 1.0 / (p - kappa / p)
    weight = (by_kappa / p).sum(-1, keepdim=True)
    by_s = torch.diag_embed(p * by_kappa) - (by_kappa / weight)[..., :, None] * by_kappa[..., None, :]
    identity = torch.eye(3, dtype=s.dtype, device=s.device)
    second = (2.0 * mu + lam)[..., None] * identity - lam[..., None] * by_s
    ratio = kappa / (p * p.roll(-1, -1))
    return energy, first, second, 2.0 * mu - lam * ratio / (1.0 - ratio)


@njit(**KERNEL)
def _roots(s, kappa, plus, p):
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


@njit(**KERNEL)
def volume_projection(s, p):
    """Fill p (3), the positive triple of product 1 nearest to the stretches s (3), the smallest last.

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


@njit(**KERNEL)
def _projected(stretch, kappa):
    """The larger root p of p (p - stretch) = -kappa."""
    return 0.5 * (stretch + np.sqrt(stretch * stretch - 4.0 * kappa))


@njit(**KERNEL)
def derivatives(w, mu, lam):
    """Energy density and its derivatives at the scratch's stretches; see `rafl.fem.kernel_layout`.

    kappa comes from a few Newton steps on all lanes; a lane that they do not bring to
    p_0 p_1 p_2 = 1 is solved on its own inside a bracket.
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
            p0 = _projected(s0, kappa)
            p1 = _projected(s1, kappa)
            p2 = _projected(s2, kappa)
            volume = p0 * p1 * p2
            a = p0 * p0 - kappa
            b = p1 * p1 - kappa
            c = p2 * p2 - kappa
            # 2 (x - 1) / (x + 1) is log x to third order, and log is what is close to linear in kappa.
            step = 2.0 * (volume - 1.0) / (volume + 1.0) * (a * b * c) / (b * c + a * c + a * b)
            w[TEMPORARY * 8 + g] = kappa + step
            w[(TEMPORARY + 1) * 8 + g] = abs(volume - 1.0)
        worst = 0.0
        for g in range(8):
            worst = max(worst, w[(TEMPORARY + 1) * 8 + g])
        if worst < 1e-9:  # the step just made squares it
            break
    for g in range(8):
        s0 = w[STRETCH * 8 + g]
        s1 = w[(STRETCH + 1) * 8 + g]
        s2 = w[(STRETCH + 2) * 8 + g]
        kappa = w[TEMPORARY * 8 + g]
        p0 = _projected(s0, kappa)
        p1 = _projected(s1, kappa)
        p2 = _projected(s2, kappa)
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
        share = lam / (t0 / p0 + t1 / p1 + t2 / p2)
        w[SECOND * 8 + g] = 2.0 * mu + lam - lam / d0 + share * t0 * t0
        w[(SECOND + 1) * 8 + g] = 2.0 * mu + lam - lam / d1 + share * t1 * t1
        w[(SECOND + 2) * 8 + g] = 2.0 * mu + lam - lam / d2 + share * t2 * t2
        w[(SECOND + 3) * 8 + g] = share * t0 * t1
        w[(SECOND + 4) * 8 + g] = share * t1 * t2
        w[(SECOND + 5) * 8 + g] = share * t2 * t0
        ratio = kappa / (p0 * p1)
        w[FLIP * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
        ratio = kappa / (p1 * p2)
        w[(FLIP + 1) * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
        ratio = kappa / (p2 * p0)
        w[(FLIP + 2) * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
    for g in range(8):
        if not w[(TEMPORARY + 1) * 8 + g] < 1e-14:
            _lane(w, mu, lam, g)


@njit(**KERNEL)
def _lane(w, mu, lam, g):
    s = np.empty(3)
    p = np.empty(3)
    d = np.empty(3)
    # `volume_projection` wants the smallest stretch last.
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
        place = (least + 1 + i) % 3
        gap = kappa / p[i]
        d[i] = 1.0 - gap / p[i]
        weight += 1.0 / (p[i] * p[i] * d[i])
        energy += mu * (s[i] - 1.0) ** 2 + 0.5 * lam * gap * gap
        w[(FIRST + place) * 8 + g] = 2.0 * mu * (s[i] - 1.0) + lam * gap
    w[ENERGY * 8 + g] = energy
    for i in range(3):
        j = (i + 1) % 3
        place = (least + 1 + i) % 3
        w[(SECOND + place) * 8 + g] = 2.0 * mu + lam - lam / d[i] + lam / ((p[i] * d[i]) ** 2 * weight)
        w[(SECOND + 3 + place) * 8 + g] = lam / (p[i] * d[i] * p[j] * d[j] * weight)
        ratio = kappa / (p[i] * p[j])
        w[(FLIP + place) * 8 + g] = 2.0 * mu - lam * ratio / (1.0 - ratio)
