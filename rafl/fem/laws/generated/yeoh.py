"""Derivatives of the elastic law yeoh; not to be edited.

`rafl.fem.laws.derivation` has computed them. The energy is in `rafl.fem.laws.yeoh`.
"""

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
        p0 = e0*e1*e2 + e0*e1 + e0*e2 + e0 + e1*e2 + e1 + e2
        p1 = e0 ** 2 + 2.0*e0 + e1 ** 2 + 2.0*e1 + e2 ** 2 + 2.0*e2
        t0 = 0.5*lam + 0.248*mu
        t1 = e0*e1
        t2 = e0*e2
        t3 = e1*e2
        t4 = 0.252*mu*p1
        t5 = 2.0*p0*t0
        t6 = s2*t5
        t7 = s0*s1
        t8 = s0 ** 2
        t9 = 0.504*mu
        t10 = s1 ** 2
        t11 = s2 ** 2
        t12 = lam + 0.496*mu
        t13 = t11*t12
        t14 = mu + t4
        t15 = t12*t8
        t16 = s1*s2
        t17 = s0*t5
        t18 = s0*s2
        t19 = s1*t5
        w[ENERGY * 8 + g] = 0.063*mu*p1 ** 2 + mu*(0.5*e0 ** 2 + 0.5*e1 ** 2 + 0.5*e2 ** 2 - e2*t1 - t1 - t2 - t3) + p0 ** 2*t0
        w[FIRST * 8 + g] = mu*(e0 - e1 - e2 - t3) + s0*t4 + s1*t6
        w[(FIRST + 1) * 8 + g] = mu*(-e0 + e1 - e2 - t2) + s0*t6 + s1*t4
        w[(FIRST + 2) * 8 + g] = mu*(-e0 - e1 + e2 - t1) + s2*t4 + t5*t7
        w[SECOND * 8 + g] = t10*t13 + t14 + t8*t9
        w[(SECOND + 1) * 8 + g] = t10*t9 + t13*t8 + t14
        w[(SECOND + 2) * 8 + g] = t10*t15 + t11*t9 + t14
        w[(SECOND + 3) * 8 + g] = mu*(-e2 - 1.0) + t13*t7 + t6 + t7*t9
        w[(SECOND + 4) * 8 + g] = mu*(-e0 - 1.0) + t15*t16 + t16*t9 + t17
        w[(SECOND + 5) * 8 + g] = mu*(-e1 - 1.0) + t10*t12*t18 + t18*t9 + t19
        w[FLIP * 8 + g] = mu*(e2 + 2.0) + t4 - t6
        w[(FLIP + 1) * 8 + g] = mu*(e0 + 2.0) - t17 + t4
        w[(FLIP + 2) * 8 + g] = mu*(e1 + 2.0) - t19 + t4


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p0 = e0*e1*e2 + e0*e1 + e0*e2 + e0 + e1*e2 + e1 + e2
    p1 = e0 ** 2 + 2.0*e0 + e1 ** 2 + 2.0*e1 + e2 ** 2 + 2.0*e2
    t0 = 0.5*lam + 0.248*mu
    t1 = e0*e1
    t2 = e0*e2
    t3 = e1*e2
    t4 = 0.252*mu*p1
    t5 = 2.0*p0*t0
    t6 = s2*t5
    t7 = s0*s1
    t8 = s0 ** 2
    t9 = 0.504*mu
    t10 = s1 ** 2
    t11 = s2 ** 2
    t12 = lam + 0.496*mu
    t13 = t11*t12
    t14 = mu + t4
    t15 = t12*t8
    t16 = s1*s2
    t17 = s0*t5
    t18 = s0*s2
    t19 = s1*t5
    psi = 0.063*mu*p1 ** 2 + mu*(0.5*e0 ** 2 + 0.5*e1 ** 2 + 0.5*e2 ** 2 - e2*t1 - t1 - t2 - t3) + p0 ** 2*t0
    psi_0 = mu*(e0 - e1 - e2 - t3) + s0*t4 + s1*t6
    psi_1 = mu*(-e0 + e1 - e2 - t2) + s0*t6 + s1*t4
    psi_2 = mu*(-e0 - e1 + e2 - t1) + s2*t4 + t5*t7
    psi_00 = t10*t13 + t14 + t8*t9
    psi_11 = t10*t9 + t13*t8 + t14
    psi_22 = t10*t15 + t11*t9 + t14
    psi_01 = mu*(-e2 - 1.0) + t13*t7 + t6 + t7*t9
    psi_12 = mu*(-e0 - 1.0) + t15*t16 + t16*t9 + t17
    psi_20 = mu*(-e1 - 1.0) + t10*t12*t18 + t18*t9 + t19
    flip_01 = mu*(e2 + 2.0) + t4 - t6
    flip_12 = mu*(e0 + 2.0) - t17 + t4
    flip_20 = mu*(e1 + 2.0) - t19 + t4
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
