"""Derivatives of the elastic law gent; not to be edited.

`rafl.fem.laws.derivation` has computed them. The energy was given to `rafl.register_law`.
"""

import numpy as np
import torch

from rafl.fem.kernel_layout import ENERGY, FIRST, FLIP, SECOND, STRETCH


def rest_lame(mu, lam):
    """Lame parameters of the law's linearisation at rest."""
    return mu, lam


def derivatives(w, mu, lam):
    """Fill ENERGY, FIRST, SECOND and FLIP from the stretches; see `rafl.fem.kernel_layout`."""
    for g in range(8):
        s0 = w[STRETCH * 8 + g]
        s1 = w[(STRETCH + 1) * 8 + g]
        s2 = w[(STRETCH + 2) * 8 + g]
        e0 = s0 - 1.0
        e1 = s1 - 1.0
        e2 = s2 - 1.0
        p0 = e0**2 + 2.0 * e0 + e1**2 + 2.0 * e1 + e2**2 + 2.0 * e2
        p1 = e0 * e1 * e2 + e0 * e1 + e0 * e2 + e0 + e1 * e2 + e1 + e2
        t0 = 0.5 * mu
        t1 = 0.03333333333333333 * p0
        t2 = 0.5 * lam + 0.4666666666666667 * mu
        t3 = e0 * e1
        t4 = e0 * e2
        t5 = e1 * e2
        t6 = 2.0 * p1 * t2
        t7 = s2 * t6
        t8 = t1 - 1.0
        t9 = -1.0 / t8
        t10 = mu * t9 - 2.0 * t0
        t11 = s0 * s1
        t12 = mu * t9
        t13 = s1**2
        t14 = s2**2
        t15 = lam + 0.9333333333333333 * mu
        t16 = t14 * t15
        t17 = s0**2
        t18 = 0.06666666666666667 * mu / t8**2
        t19 = t15 * t17
        t20 = s0 * t6
        t21 = s1 * s2
        t22 = s1 * t6
        t23 = s0 * s2
        t24 = -mu + t12
        w[ENERGY * 8 + g] = (
            mu * (0.5 * e0**2 + 0.5 * e1**2 + 0.5 * e2**2 - e2 * t3 - t3 - t4 - t5)
            - 15.0 * mu * np.log1p(-t1)
            - p0 * t0
            + p1**2 * t2
        )
        w[FIRST * 8 + g] = mu * (e0 - e1 - e2 - t5) + s0 * t10 + s1 * t7
        w[(FIRST + 1) * 8 + g] = mu * (-e0 + e1 - e2 - t4) + s0 * t7 + s1 * t10
        w[(FIRST + 2) * 8 + g] = mu * (-e0 - e1 + e2 - t3) + s2 * t10 + t11 * t6
        w[SECOND * 8 + g] = t12 + t13 * t16 + t17 * t18
        w[(SECOND + 1) * 8 + g] = t12 + t13 * t18 + t16 * t17
        w[(SECOND + 2) * 8 + g] = t12 + t13 * t19 + t14 * t18
        w[(SECOND + 3) * 8 + g] = mu * (-e2 - 1.0) + t11 * t16 + t11 * t18 + t7
        w[(SECOND + 4) * 8 + g] = mu * (-e0 - 1.0) + t18 * t21 + t19 * t21 + t20
        w[(SECOND + 5) * 8 + g] = mu * (-e1 - 1.0) + t13 * t15 * t23 + t18 * t23 + t22
        w[FLIP * 8 + g] = mu * (e2 + 2.0) + t24 - t7
        w[(FLIP + 1) * 8 + g] = mu * (e0 + 2.0) - t20 + t24
        w[(FLIP + 2) * 8 + g] = mu * (e1 + 2.0) - t22 + t24


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p0 = e0**2 + 2.0 * e0 + e1**2 + 2.0 * e1 + e2**2 + 2.0 * e2
    p1 = e0 * e1 * e2 + e0 * e1 + e0 * e2 + e0 + e1 * e2 + e1 + e2
    t0 = 0.5 * mu
    t1 = 0.03333333333333333 * p0
    t2 = 0.5 * lam + 0.4666666666666667 * mu
    t3 = e0 * e1
    t4 = e0 * e2
    t5 = e1 * e2
    t6 = 2.0 * p1 * t2
    t7 = s2 * t6
    t8 = t1 - 1.0
    t9 = -1.0 / t8
    t10 = mu * t9 - 2.0 * t0
    t11 = s0 * s1
    t12 = mu * t9
    t13 = s1**2
    t14 = s2**2
    t15 = lam + 0.9333333333333333 * mu
    t16 = t14 * t15
    t17 = s0**2
    t18 = 0.06666666666666667 * mu / t8**2
    t19 = t15 * t17
    t20 = s0 * t6
    t21 = s1 * s2
    t22 = s1 * t6
    t23 = s0 * s2
    t24 = -mu + t12
    psi = (
        mu * (0.5 * e0**2 + 0.5 * e1**2 + 0.5 * e2**2 - e2 * t3 - t3 - t4 - t5)
        - 15.0 * mu * torch.log1p(-t1)
        - p0 * t0
        + p1**2 * t2
    )
    psi_0 = mu * (e0 - e1 - e2 - t5) + s0 * t10 + s1 * t7
    psi_1 = mu * (-e0 + e1 - e2 - t4) + s0 * t7 + s1 * t10
    psi_2 = mu * (-e0 - e1 + e2 - t3) + s2 * t10 + t11 * t6
    psi_00 = t12 + t13 * t16 + t17 * t18
    psi_11 = t12 + t13 * t18 + t16 * t17
    psi_22 = t12 + t13 * t19 + t14 * t18
    psi_01 = mu * (-e2 - 1.0) + t11 * t16 + t11 * t18 + t7
    psi_12 = mu * (-e0 - 1.0) + t18 * t21 + t19 * t21 + t20
    psi_20 = mu * (-e1 - 1.0) + t13 * t15 * t23 + t18 * t23 + t22
    flip_01 = mu * (e2 + 2.0) + t24 - t7
    flip_12 = mu * (e0 + 2.0) - t20 + t24
    flip_20 = mu * (e1 + 2.0) - t22 + t24
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
