"""Derivatives of the elastic law mooney-rivlin; not to be edited.

`rafl.fem.laws.derivation` has computed them. The energy is in `rafl.fem.laws.mooney_rivlin`.
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
        t0 = 0.5*lam + 0.39*mu
        t1 = e0 ** 2
        t2 = e1 ** 2
        t3 = e2 ** 2
        t4 = 0.78*e1
        t5 = 0.78*e2
        t6 = 0.11*t1
        t7 = 1.22*e0
        t8 = e2*t7
        t9 = 0.22*t2
        t10 = 0.22*t3
        t11 = e0*t10 + e0*t9
        t12 = 0.22*t1
        t13 = e1*t10 + e1*t12
        t14 = e2*t12 + e2*t9
        t15 = 2.0*p0*t0
        t16 = s2*t15
        t17 = 1.22*e1
        t18 = t10 + t9
        t19 = 0.44*e1
        t20 = e0*t19
        t21 = t20 - t5
        t22 = 0.44*e2
        t23 = e0*t22
        t24 = t23 - t4
        t25 = t10 + t12
        t26 = e2*t19
        t27 = -0.78*e0 + t26
        t28 = s0*s1
        t29 = 1.22*e2
        t30 = t12 + t9
        t31 = s1 ** 2
        t32 = lam + 0.78*mu
        t33 = s2 ** 2*t32
        t34 = t19 + t22
        t35 = s0 ** 2
        t36 = 0.44*e0
        t37 = t22 + t36
        t38 = t32*t35
        t39 = t19 + t36
        t40 = s0*t15
        t41 = s1*t15
        t42 = 0.22*e1
        t43 = 0.22*e0
        t44 = t43 - 2.0
        t45 = 0.22*e2
        w[ENERGY * 8 + g] = mu*(-e0*t4 - e0*t5 - e1*t8 - e2*t4 + 0.61*t1 + t11 + t13 + t14 + 0.11*t2*t3 + t2*t6 + 0.61*t2 + t3*t6 + 0.61*t3) + p0 ** 2*t0
        w[FIRST * 8 + g] = mu*(-e2*t17 + t11 + t18 + t21 + t24 + t7) + s1*t16
        w[(FIRST + 1) * 8 + g] = mu*(t13 + t17 + t21 + t25 + t27 - t8) + s0*t16
        w[(FIRST + 2) * 8 + g] = mu*(-e1*t7 + t14 + t24 + t27 + t29 + t30) + t15*t28
        w[SECOND * 8 + g] = mu*(t18 + t34 + 1.22) + t31*t33
        w[(SECOND + 1) * 8 + g] = mu*(t25 + t37 + 1.22) + t33*t35
        w[(SECOND + 2) * 8 + g] = mu*(t30 + t39 + 1.22) + t31*t38
        w[(SECOND + 3) * 8 + g] = mu*(t20 - t29 + t39 - 0.78) + t16 + t28*t33
        w[(SECOND + 4) * 8 + g] = mu*(t26 + t34 - t7 - 0.78) + s1*s2*t38 + t40
        w[(SECOND + 5) * 8 + g] = mu*(-t17 + t23 + t37 - 0.78) + s0*s2*t31*t32 + t41
        w[FLIP * 8 + g] = mu*(-e1*t43 + 1.66*e2 + 0.22*t3 - t42 - t44) - t16
        w[(FLIP + 1) * 8 + g] = mu*(1.66*e0 - e2*t42 + t12 - t42 - t45 + 2.0) - t40
        w[(FLIP + 2) * 8 + g] = mu*(1.66*e1 - e2*t43 + 0.22*t2 - t44 - t45) - t41


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p0 = e0*e1*e2 + e0*e1 + e0*e2 + e0 + e1*e2 + e1 + e2
    t0 = 0.5*lam + 0.39*mu
    t1 = e0 ** 2
    t2 = e1 ** 2
    t3 = e2 ** 2
    t4 = 0.78*e1
    t5 = 0.78*e2
    t6 = 0.11*t1
    t7 = 1.22*e0
    t8 = e2*t7
    t9 = 0.22*t2
    t10 = 0.22*t3
    t11 = e0*t10 + e0*t9
    t12 = 0.22*t1
    t13 = e1*t10 + e1*t12
    t14 = e2*t12 + e2*t9
    t15 = 2.0*p0*t0
    t16 = s2*t15
    t17 = 1.22*e1
    t18 = t10 + t9
    t19 = 0.44*e1
    t20 = e0*t19
    t21 = t20 - t5
    t22 = 0.44*e2
    t23 = e0*t22
    t24 = t23 - t4
    t25 = t10 + t12
    t26 = e2*t19
    t27 = -0.78*e0 + t26
    t28 = s0*s1
    t29 = 1.22*e2
    t30 = t12 + t9
    t31 = s1 ** 2
    t32 = lam + 0.78*mu
    t33 = s2 ** 2*t32
    t34 = t19 + t22
    t35 = s0 ** 2
    t36 = 0.44*e0
    t37 = t22 + t36
    t38 = t32*t35
    t39 = t19 + t36
    t40 = s0*t15
    t41 = s1*t15
    t42 = 0.22*e1
    t43 = 0.22*e0
    t44 = t43 - 2.0
    t45 = 0.22*e2
    psi = mu*(-e0*t4 - e0*t5 - e1*t8 - e2*t4 + 0.61*t1 + t11 + t13 + t14 + 0.11*t2*t3 + t2*t6 + 0.61*t2 + t3*t6 + 0.61*t3) + p0 ** 2*t0
    psi_0 = mu*(-e2*t17 + t11 + t18 + t21 + t24 + t7) + s1*t16
    psi_1 = mu*(t13 + t17 + t21 + t25 + t27 - t8) + s0*t16
    psi_2 = mu*(-e1*t7 + t14 + t24 + t27 + t29 + t30) + t15*t28
    psi_00 = mu*(t18 + t34 + 1.22) + t31*t33
    psi_11 = mu*(t25 + t37 + 1.22) + t33*t35
    psi_22 = mu*(t30 + t39 + 1.22) + t31*t38
    psi_01 = mu*(t20 - t29 + t39 - 0.78) + t16 + t28*t33
    psi_12 = mu*(t26 + t34 - t7 - 0.78) + s1*s2*t38 + t40
    psi_20 = mu*(-t17 + t23 + t37 - 0.78) + s0*s2*t31*t32 + t41
    flip_01 = mu*(-e1*t43 + 1.66*e2 + 0.22*t3 - t42 - t44) - t16
    flip_12 = mu*(1.66*e0 - e2*t42 + t12 - t42 - t45 + 2.0) - t40
    flip_20 = mu*(1.66*e1 - e2*t43 + 0.22*t2 - t44 - t45) - t41
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
