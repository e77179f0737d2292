"""Derivatives of the elastic law hencky; not to be edited.

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
        t0 = np.log(s0)
        t1 = 2.0 * mu
        t2 = t0 * t1 / s0
        t3 = lam * s2
        t4 = p0 + 1.0
        t5 = np.log(t4)
        t6 = t5 / t4
        t7 = t3 * t6
        t8 = np.log(s1)
        t9 = t1 * t8 / s1
        t10 = np.log(s2)
        t11 = t1 * t10 / s2
        t12 = lam * t6
        t13 = s0 * t12
        t14 = s0**2
        t15 = 1.0 / t14
        t16 = s1**2
        t17 = (t5 - 1.0) / t4**2
        t18 = t16 * t17
        t19 = s2**2
        t20 = lam * t19
        t21 = 1.0 / t16
        t22 = t17 * t20
        t23 = 1.0 / t19
        t24 = s1 * t12
        t25 = s0 - s1
        t26 = 0.16666666666666666 * 1.7320508075688772
        t27 = t25 * t26
        t28 = 0.5 * s0
        t29 = 0.5 * s1
        t30 = t28 + t29
        t31 = -t27 + t30
        t32 = 1.0 / t31**2
        t33 = t27 + t30
        t34 = 1.0 / t33**2
        t35 = -t2
        t36 = -s2
        t37 = s1 + t36
        t38 = t26 * t37
        t39 = 0.5 * s2
        t40 = t29 + t39
        t41 = -t38 + t40
        t42 = 1.0 / t41**2
        t43 = t38 + t40
        t44 = 1.0 / t43**2
        t45 = s0 + t36
        t46 = -t45
        t47 = t26 * t46
        t48 = t28 + t39
        t49 = -t47 + t48
        t50 = 1.0 / t49**2
        t51 = t47 + t48
        t52 = 1.0 / t51**2
        w[ENERGY * 8 + g] = 0.5 * lam * (np.log1p(p0)) ** 2 + mu * (
            (np.log1p(e0)) ** 2 + (np.log1p(e1)) ** 2 + (np.log1p(e2)) ** 2
        )
        w[FIRST * 8 + g] = s1 * t7 + t2
        w[(FIRST + 1) * 8 + g] = s0 * t7 + t9
        w[(FIRST + 2) * 8 + g] = s1 * t13 + t11
        w[SECOND * 8 + g] = 2.0 * mu * t15 - t0 * t1 * t15 - t18 * t20
        w[(SECOND + 1) * 8 + g] = 2.0 * mu * t21 - t1 * t21 * t8 - t14 * t22
        w[(SECOND + 2) * 8 + g] = -lam * t14 * t18 + 2.0 * mu * t23 - t1 * t10 * t23
        w[(SECOND + 3) * 8 + g] = -s0 * s1 * t22 + t7
        w[(SECOND + 4) * 8 + g] = -s1 * t14 * t17 * t3 + t13
        w[(SECOND + 5) * 8 + g] = -s0 * t18 * t3 + t24
        w[FLIP * 8 + g] = -t7 + (
            -mu * t32 * np.log(t31) + mu * t32 - mu * t34 * np.log(t33) + mu * t34
            if (np.abs(t25) <= 0.001 * np.abs(t30))
            else (-t35 - t9) / t25
        )
        w[(FLIP + 1) * 8 + g] = -t13 + (
            -mu * t42 * np.log(t41) + mu * t42 - mu * t44 * np.log(t43) + mu * t44
            if (np.abs(t37) <= 0.001 * np.abs(t40))
            else (-t11 + t9) / t37
        )
        w[(FLIP + 2) * 8 + g] = -t24 + (
            -mu * t50 * np.log(t49) + mu * t50 - mu * t52 * np.log(t51) + mu * t52
            if (np.abs(t45) <= 0.001 * np.abs(t48))
            else (t11 + t35) / t46
        )


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p0 = e0 * e1 * e2 + e0 * e1 + e0 * e2 + e0 + e1 * e2 + e1 + e2
    t0 = torch.log(s0)
    t1 = 2.0 * mu
    t2 = t0 * t1 / s0
    t3 = lam * s2
    t4 = p0 + 1.0
    t5 = torch.log(t4)
    t6 = t5 / t4
    t7 = t3 * t6
    t8 = torch.log(s1)
    t9 = t1 * t8 / s1
    t10 = torch.log(s2)
    t11 = t1 * t10 / s2
    t12 = lam * t6
    t13 = s0 * t12
    t14 = s0**2
    t15 = 1.0 / t14
    t16 = s1**2
    t17 = (t5 - 1.0) / t4**2
    t18 = t16 * t17
    t19 = s2**2
    t20 = lam * t19
    t21 = 1.0 / t16
    t22 = t17 * t20
    t23 = 1.0 / t19
    t24 = s1 * t12
    t25 = s0 - s1
    t26 = 0.16666666666666666 * 1.7320508075688772
    t27 = t25 * t26
    t28 = 0.5 * s0
    t29 = 0.5 * s1
    t30 = t28 + t29
    t31 = -t27 + t30
    t32 = 1.0 / t31**2
    t33 = t27 + t30
    t34 = 1.0 / t33**2
    t35 = -t2
    t36 = -s2
    t37 = s1 + t36
    t38 = t26 * t37
    t39 = 0.5 * s2
    t40 = t29 + t39
    t41 = -t38 + t40
    t42 = 1.0 / t41**2
    t43 = t38 + t40
    t44 = 1.0 / t43**2
    t45 = s0 + t36
    t46 = -t45
    t47 = t26 * t46
    t48 = t28 + t39
    t49 = -t47 + t48
    t50 = 1.0 / t49**2
    t51 = t47 + t48
    t52 = 1.0 / t51**2
    psi = 0.5 * lam * (torch.log1p(p0)) ** 2 + mu * (
        (torch.log1p(e0)) ** 2 + (torch.log1p(e1)) ** 2 + (torch.log1p(e2)) ** 2
    )
    psi_0 = s1 * t7 + t2
    psi_1 = s0 * t7 + t9
    psi_2 = s1 * t13 + t11
    psi_00 = 2.0 * mu * t15 - t0 * t1 * t15 - t18 * t20
    psi_11 = 2.0 * mu * t21 - t1 * t21 * t8 - t14 * t22
    psi_22 = -lam * t14 * t18 + 2.0 * mu * t23 - t1 * t10 * t23
    psi_01 = -s0 * s1 * t22 + t7
    psi_12 = -s1 * t14 * t17 * t3 + t13
    psi_20 = -s0 * t18 * t3 + t24
    flip_01 = -t7 + torch.where(
        (torch.abs(t25) <= 0.001 * torch.abs(t30)),
        -mu * t32 * torch.log(t31) + mu * t32 - mu * t34 * torch.log(t33) + mu * t34,
        (-t35 - t9) / t25,
    )
    flip_12 = -t13 + torch.where(
        (torch.abs(t37) <= 0.001 * torch.abs(t40)),
        -mu * t42 * torch.log(t41) + mu * t42 - mu * t44 * torch.log(t43) + mu * t44,
        (-t11 + t9) / t37,
    )
    flip_20 = -t24 + torch.where(
        (torch.abs(t45) <= 0.001 * torch.abs(t48)),
        -mu * t50 * torch.log(t49) + mu * t50 - mu * t52 * torch.log(t51) + mu * t52,
        (t11 + t35) / t46,
    )
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
