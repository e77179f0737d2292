"""Derivatives of the elastic law ogden; not to be edited.

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
        t0 = 1.1 * mu
        t1 = np.log1p(p0)
        t2 = 1.1 * e1
        t3 = e0 * t2
        t4 = 1.1 * e2
        t5 = e0 * t4
        t6 = e2 * t2
        t7 = e0**2 / (e0 + 1.0)
        t8 = e1**2 / (e1 + 1.0)
        t9 = e2**2 / (e2 + 1.0)
        t10 = -1.0999999999999999 * mu
        t11 = np.sqrt(s0)
        t12 = mu * (1.2 * t11 - 0.1 / s0**3)
        t13 = p0 + 1.0
        t14 = 1.0 / t13
        t15 = lam * np.log(t13)
        t16 = -t0 * t14 + t0 + t14 * t15
        t17 = s2 * t16
        t18 = np.sqrt(s1)
        t19 = mu * (1.2 * t18 - 0.1 / s1**3)
        t20 = 1.1 * e0
        t21 = np.sqrt(s2)
        t22 = mu * (1.2 * t21 - 0.1 / s2**3)
        t23 = s0 * t16
        t24 = s1**2
        t25 = (lam + t0 - t15) / t13**2
        t26 = s2**2 * t25
        t27 = s0**2
        t28 = t25 * t27
        t29 = t4 + 1.1
        t30 = t20 + 1.1
        t31 = t2 + 1.1
        t32 = s1 * t16
        t33 = s0 - s1
        t34 = 0.16666666666666666 * 1.7320508075688772
        t35 = t33 * t34
        t36 = 0.5 * s0
        t37 = 0.5 * s1
        t38 = t36 + t37
        t39 = -t35 + t38
        t40 = 0.5 * mu
        t41 = t35 + t38
        t42 = -s2
        t43 = s1 + t42
        t44 = t34 * t43
        t45 = 0.5 * s2
        t46 = t37 + t45
        t47 = -t44 + t46
        t48 = t44 + t46
        t49 = -t22
        t50 = s0 + t42
        t51 = -t50
        t52 = t34 * t51
        t53 = t36 + t45
        t54 = -t52 + t53
        t55 = t52 + t53
        w[ENERGY * 8 + g] = (
            0.5 * lam * t1**2
            + mu * (-e2 * t3 - t3 - t5 - t6)
            + mu
            * (
                -1.2 * e0
                - 1.2 * e1
                - 1.2 * e2
                + 0.1 * t7
                + 0.1 * t8
                + 0.1 * t9
                + 0.05 * (-e0 + t7) ** 2
                + 0.05 * (-e1 + t8) ** 2
                + 0.05 * (-e2 + t9) ** 2
                + 0.7999999999999999 * np.expm1(1.5 * np.log1p(e0))
                + 0.7999999999999999 * np.expm1(1.5 * np.log1p(e1))
                + 0.7999999999999999 * np.expm1(1.5 * np.log1p(e2))
            )
            + p0 * t0
            - t0 * t1
        )
        w[FIRST * 8 + g] = mu * (-t2 - t4 - t6) + s1 * t17 + t10 + t12
        w[(FIRST + 1) * 8 + g] = mu * (-t20 - t4 - t5) + s0 * t17 + t10 + t19
        w[(FIRST + 2) * 8 + g] = mu * (-t2 - t20 - t3) + s1 * t23 + t10 + t22
        w[SECOND * 8 + g] = mu * (0.6 / t11 + 0.3 / s0**4) + t24 * t26
        w[(SECOND + 1) * 8 + g] = mu * (0.6 / t18 + 0.3 / s1**4) + t26 * t27
        w[(SECOND + 2) * 8 + g] = mu * (0.6 / t21 + 0.3 / s2**4) + t24 * t28
        w[(SECOND + 3) * 8 + g] = -mu * t29 + s0 * s1 * t26 + t17
        w[(SECOND + 4) * 8 + g] = -mu * t30 + s1 * s2 * t28 + t23
        w[(SECOND + 5) * 8 + g] = -mu * t31 + s0 * s2 * t24 * t25 + t32
        w[FLIP * 8 + g] = (
            mu * t29
            - t17
            + (
                t40 * (0.3 / t39**4 + 0.6 / np.sqrt(t39)) + t40 * (0.3 / t41**4 + 0.6 / np.sqrt(t41))
                if (np.abs(t33) <= 0.001 * np.abs(t38))
                else (t12 - t19) / t33
            )
        )
        w[(FLIP + 1) * 8 + g] = (
            mu * t30
            - t23
            + (
                t40 * (0.3 / t47**4 + 0.6 / np.sqrt(t47)) + t40 * (0.3 / t48**4 + 0.6 / np.sqrt(t48))
                if (np.abs(t43) <= 0.001 * np.abs(t46))
                else (t19 + t49) / t43
            )
        )
        w[(FLIP + 2) * 8 + g] = (
            mu * t31
            - t32
            + (
                t40 * (0.3 / t54**4 + 0.6 / np.sqrt(t54)) + t40 * (0.3 / t55**4 + 0.6 / np.sqrt(t55))
                if (np.abs(t50) <= 0.001 * np.abs(t53))
                else (-t12 - t49) / t51
            )
        )


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p0 = e0 * e1 * e2 + e0 * e1 + e0 * e2 + e0 + e1 * e2 + e1 + e2
    t0 = 1.1 * mu
    t1 = torch.log1p(p0)
    t2 = 1.1 * e1
    t3 = e0 * t2
    t4 = 1.1 * e2
    t5 = e0 * t4
    t6 = e2 * t2
    t7 = e0**2 / (e0 + 1.0)
    t8 = e1**2 / (e1 + 1.0)
    t9 = e2**2 / (e2 + 1.0)
    t10 = -1.0999999999999999 * mu
    t11 = torch.sqrt(s0)
    t12 = mu * (1.2 * t11 - 0.1 / s0**3)
    t13 = p0 + 1.0
    t14 = 1.0 / t13
    t15 = lam * torch.log(t13)
    t16 = -t0 * t14 + t0 + t14 * t15
    t17 = s2 * t16
    t18 = torch.sqrt(s1)
    t19 = mu * (1.2 * t18 - 0.1 / s1**3)
    t20 = 1.1 * e0
    t21 = torch.sqrt(s2)
    t22 = mu * (1.2 * t21 - 0.1 / s2**3)
    t23 = s0 * t16
    t24 = s1**2
    t25 = (lam + t0 - t15) / t13**2
    t26 = s2**2 * t25
    t27 = s0**2
    t28 = t25 * t27
    t29 = t4 + 1.1
    t30 = t20 + 1.1
    t31 = t2 + 1.1
    t32 = s1 * t16
    t33 = s0 - s1
    t34 = 0.16666666666666666 * 1.7320508075688772
    t35 = t33 * t34
    t36 = 0.5 * s0
    t37 = 0.5 * s1
    t38 = t36 + t37
    t39 = -t35 + t38
    t40 = 0.5 * mu
    t41 = t35 + t38
    t42 = -s2
    t43 = s1 + t42
    t44 = t34 * t43
    t45 = 0.5 * s2
    t46 = t37 + t45
    t47 = -t44 + t46
    t48 = t44 + t46
    t49 = -t22
    t50 = s0 + t42
    t51 = -t50
    t52 = t34 * t51
    t53 = t36 + t45
    t54 = -t52 + t53
    t55 = t52 + t53
    psi = (
        0.5 * lam * t1**2
        + mu * (-e2 * t3 - t3 - t5 - t6)
        + mu
        * (
            -1.2 * e0
            - 1.2 * e1
            - 1.2 * e2
            + 0.1 * t7
            + 0.1 * t8
            + 0.1 * t9
            + 0.05 * (-e0 + t7) ** 2
            + 0.05 * (-e1 + t8) ** 2
            + 0.05 * (-e2 + t9) ** 2
            + 0.7999999999999999 * torch.expm1(1.5 * torch.log1p(e0))
            + 0.7999999999999999 * torch.expm1(1.5 * torch.log1p(e1))
            + 0.7999999999999999 * torch.expm1(1.5 * torch.log1p(e2))
        )
        + p0 * t0
        - t0 * t1
    )
    psi_0 = mu * (-t2 - t4 - t6) + s1 * t17 + t10 + t12
    psi_1 = mu * (-t20 - t4 - t5) + s0 * t17 + t10 + t19
    psi_2 = mu * (-t2 - t20 - t3) + s1 * t23 + t10 + t22
    psi_00 = mu * (0.6 / t11 + 0.3 / s0**4) + t24 * t26
    psi_11 = mu * (0.6 / t18 + 0.3 / s1**4) + t26 * t27
    psi_22 = mu * (0.6 / t21 + 0.3 / s2**4) + t24 * t28
    psi_01 = -mu * t29 + s0 * s1 * t26 + t17
    psi_12 = -mu * t30 + s1 * s2 * t28 + t23
    psi_20 = -mu * t31 + s0 * s2 * t24 * t25 + t32
    flip_01 = (
        mu * t29
        - t17
        + torch.where(
            (torch.abs(t33) <= 0.001 * torch.abs(t38)),
            t40 * (0.3 / t39**4 + 0.6 / torch.sqrt(t39)) + t40 * (0.3 / t41**4 + 0.6 / torch.sqrt(t41)),
            (t12 - t19) / t33,
        )
    )
    flip_12 = (
        mu * t30
        - t23
        + torch.where(
            (torch.abs(t43) <= 0.001 * torch.abs(t46)),
            t40 * (0.3 / t47**4 + 0.6 / torch.sqrt(t47)) + t40 * (0.3 / t48**4 + 0.6 / torch.sqrt(t48)),
            (t19 + t49) / t43,
        )
    )
    flip_20 = (
        mu * t31
        - t32
        + torch.where(
            (torch.abs(t50) <= 0.001 * torch.abs(t53)),
            t40 * (0.3 / t54**4 + 0.6 / torch.sqrt(t54)) + t40 * (0.3 / t55**4 + 0.6 / torch.sqrt(t55)),
            (-t12 - t49) / t51,
        )
    )
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
