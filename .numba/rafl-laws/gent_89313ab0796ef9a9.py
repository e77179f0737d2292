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
        p0 = e0 * e1 * e2 + e0 * e1 + e0 * e2 + e0 + e1 * e2 + e1 + e2
        p1 = e0**2 + 2.0 * e0 + e1**2 + 2.0 * e1 + e2**2 + 2.0 * e2
        t0 = 0.5 * mu
        t1 = 0.03333333333333333 * p1
        t2 = p0**2
        t3 = 30.0 * p0 + 30.0
        t4 = 2.0 * p0 + 2.0
        t5 = e0 * e1
        t6 = e0 * e2
        t7 = e1 * e2
        t8 = t1 - 1.0
        t9 = -1.0 / t8
        t10 = mu * t9 - 2.0 * t0
        t11 = p0 + 1.0
        t12 = 1.0 / t11
        t13 = mu * t12
        t14 = 0.5 * lam - 2.0 * lam / t4**2 + 0.9666666666666667 * mu + 30.0 * mu / t3**2 - t13
        t15 = s2 * t14
        t16 = s0 * t14
        t17 = mu * t9
        t18 = s0**2
        t19 = 0.06666666666666667 * mu / t8**2
        t20 = s1**2
        t21 = s2**2
        t22 = (lam * t12 + mu - 0.06666666666666667 * t13) / t11**2
        t23 = t21 * t22
        t24 = t18 * t22
        t25 = s0 * s1
        t26 = s1 * s2
        t27 = s0 * s2
        t28 = s1 * t14
        t29 = -mu + t17
        w[ENERGY * 8 + g] = (
            lam * t2 / t4
            + mu * p0
            - mu * t2 / t3
            + mu * (0.5 * e0**2 + 0.5 * e1**2 + 0.5 * e2**2 - e2 * t5 - t5 - t6 - t7)
            - mu * np.log1p(p0)
            - 15.0 * mu * np.log1p(-t1)
            - p1 * t0
        )
        w[FIRST * 8 + g] = mu * (e0 - e1 - e2 - t7) + s0 * t10 + s1 * t15
        w[(FIRST + 1) * 8 + g] = mu * (-e0 + e1 - e2 - t6) + s0 * t15 + s1 * t10
        w[(FIRST + 2) * 8 + g] = mu * (-e0 - e1 + e2 - t5) + s1 * t16 + s2 * t10
        w[SECOND * 8 + g] = t17 + t18 * t19 + t20 * t23
        w[(SECOND + 1) * 8 + g] = t17 + t18 * t23 + t19 * t20
        w[(SECOND + 2) * 8 + g] = t17 + t19 * t21 + t20 * t24
        w[(SECOND + 3) * 8 + g] = mu * (-e2 - 1.0) + t15 + t19 * t25 + t23 * t25
        w[(SECOND + 4) * 8 + g] = mu * (-e0 - 1.0) + t16 + t19 * t26 + t24 * t26
        w[(SECOND + 5) * 8 + g] = mu * (-e1 - 1.0) + t19 * t27 + t20 * t22 * t27 + t28
        w[FLIP * 8 + g] = mu * (e2 + 2.0) - t15 + t29
        w[(FLIP + 1) * 8 + g] = mu * (e0 + 2.0) - t16 + t29
        w[(FLIP + 2) * 8 + g] = mu * (e1 + 2.0) - t28 + t29


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p0 = e0 * e1 * e2 + e0 * e1 + e0 * e2 + e0 + e1 * e2 + e1 + e2
    p1 = e0**2 + 2.0 * e0 + e1**2 + 2.0 * e1 + e2**2 + 2.0 * e2
    t0 = 0.5 * mu
    t1 = 0.03333333333333333 * p1
    t2 = p0**2
    t3 = 30.0 * p0 + 30.0
    t4 = 2.0 * p0 + 2.0
    t5 = e0 * e1
    t6 = e0 * e2
    t7 = e1 * e2
    t8 = t1 - 1.0
    t9 = -1.0 / t8
    t10 = mu * t9 - 2.0 * t0
    t11 = p0 + 1.0
    t12 = 1.0 / t11
    t13 = mu * t12
    t14 = 0.5 * lam - 2.0 * lam / t4**2 + 0.9666666666666667 * mu + 30.0 * mu / t3**2 - t13
    t15 = s2 * t14
    t16 = s0 * t14
    t17 = mu * t9
    t18 = s0**2
    t19 = 0.06666666666666667 * mu / t8**2
    t20 = s1**2
    t21 = s2**2
    t22 = (lam * t12 + mu - 0.06666666666666667 * t13) / t11**2
    t23 = t21 * t22
    t24 = t18 * t22
    t25 = s0 * s1
    t26 = s1 * s2
    t27 = s0 * s2
    t28 = s1 * t14
    t29 = -mu + t17
    psi = (
        lam * t2 / t4
        + mu * p0
        - mu * t2 / t3
        + mu * (0.5 * e0**2 + 0.5 * e1**2 + 0.5 * e2**2 - e2 * t5 - t5 - t6 - t7)
        - mu * torch.log1p(p0)
        - 15.0 * mu * torch.log1p(-t1)
        - p1 * t0
    )
    psi_0 = mu * (e0 - e1 - e2 - t7) + s0 * t10 + s1 * t15
    psi_1 = mu * (-e0 + e1 - e2 - t6) + s0 * t15 + s1 * t10
    psi_2 = mu * (-e0 - e1 + e2 - t5) + s1 * t16 + s2 * t10
    psi_00 = t17 + t18 * t19 + t20 * t23
    psi_11 = t17 + t18 * t23 + t19 * t20
    psi_22 = t17 + t19 * t21 + t20 * t24
    psi_01 = mu * (-e2 - 1.0) + t15 + t19 * t25 + t23 * t25
    psi_12 = mu * (-e0 - 1.0) + t16 + t19 * t26 + t24 * t26
    psi_20 = mu * (-e1 - 1.0) + t19 * t27 + t20 * t22 * t27 + t28
    flip_01 = mu * (e2 + 2.0) - t15 + t29
    flip_12 = mu * (e0 + 2.0) - t16 + t29
    flip_20 = mu * (e1 + 2.0) - t28 + t29
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
