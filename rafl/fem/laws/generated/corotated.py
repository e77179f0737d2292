"""Derivatives of the elastic law corotated; not to be edited.

`rafl.fem.laws.derivation` has computed them. The energy is in `rafl.fem.laws.corotated`.
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
        p1 = e0 + e1 + e2
        t0 = lam*p1
        t1 = 2.0*mu
        t2 = lam + t1
        w[ENERGY * 8 + g] = 0.5*lam*p1 ** 2 + mu*(e0 ** 2 + e1 ** 2 + e2 ** 2)
        w[FIRST * 8 + g] = e0*t1 + t0
        w[(FIRST + 1) * 8 + g] = e1*t1 + t0
        w[(FIRST + 2) * 8 + g] = e2*t1 + t0
        w[SECOND * 8 + g] = t2
        w[(SECOND + 1) * 8 + g] = t2
        w[(SECOND + 2) * 8 + g] = t2
        w[(SECOND + 3) * 8 + g] = lam
        w[(SECOND + 4) * 8 + g] = lam
        w[(SECOND + 5) * 8 + g] = lam
        w[FLIP * 8 + g] = t1
        w[(FLIP + 1) * 8 + g] = t1
        w[(FLIP + 2) * 8 + g] = t1


def reference_derivatives(s, mu, lam):
    """`derivatives` on tensors s (..., 3): energy (...), first (..., 3), second (..., 3, 3), flip (..., 3)."""
    s0, s1, s2 = s.unbind(-1)
    e0 = s0 - 1.0
    e1 = s1 - 1.0
    e2 = s2 - 1.0
    p1 = e0 + e1 + e2
    t0 = lam*p1
    t1 = 2.0*mu
    t2 = lam + t1
    psi = 0.5*lam*p1 ** 2 + mu*(e0 ** 2 + e1 ** 2 + e2 ** 2)
    psi_0 = e0*t1 + t0
    psi_1 = e1*t1 + t0
    psi_2 = e2*t1 + t0
    psi_00 = t2
    psi_11 = t2
    psi_22 = t2
    psi_01 = lam
    psi_12 = lam
    psi_20 = lam
    flip_01 = t1
    flip_12 = t1
    flip_20 = t1
    values = (psi, psi_0, psi_1, psi_2, psi_00, psi_11, psi_22, psi_01, psi_12, psi_20, flip_01, flip_12, flip_20)
    energy, *rows = torch.broadcast_tensors(*(torch.as_tensor(x).to(s) for x in values))
    second = torch.stack([rows[k] for k in (3, 6, 8, 6, 4, 7, 8, 7, 5)], -1).unflatten(-1, (3, 3))
    return energy, torch.stack(rows[:3], -1), second, torch.stack(rows[9:], -1)
