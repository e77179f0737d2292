"""Where markers go by the affine maps of those around them."""

import numpy as np
from numba import njit

AROUND = 6  # markers that carry another
STIFFNESS = 0.04  # of neighbours' own spread: how firmly local maps hold on to the expected one


@njit(cache=True, nogil=True)
def carry(source, target, points):  # type: ignore[no-untyped-def]
    """Where points (P, 2) go by the affine map of the nearest of `source`, which go to `target` (N, 2)."""
    count = len(source)
    result = np.empty_like(points)
    # Known markers in one line say nothing across it but that the body turns with them.
    turn = _similarity(source, target)
    _, _, matrix = _affine(source, target, np.arange(count), np.ones(count), turn)
    for p in range(len(points)):
        away = np.hypot(source[:, 0] - points[p, 0], source[:, 1] - points[p, 1])
        near = np.argsort(away)[:AROUND]
        middle, goes, local = _affine(source, target, near, 1.0 / (away[near] + 1e-9), matrix)
        x, y = points[p] - middle
        result[p, 0] = goes[0] + local[0, 0] * x + local[0, 1] * y
        result[p, 1] = goes[1] + local[1, 0] * x + local[1, 1] * y
    return result


@njit(cache=True, nogil=True)
def _similarity(source, target):  # type: ignore[no-untyped-def]
    """The turn and scale that best take source to target (N, 2), as a matrix; none from a single point."""
    count = len(source)
    sx, sy, tx, ty = source[:, 0].mean(), source[:, 1].mean(), target[:, 0].mean(), target[:, 1].mean()
    size = along = across = 0.0
    for k in range(count):
        ux, uy, vx, vy = source[k, 0] - sx, source[k, 1] - sy, target[k, 0] - tx, target[k, 1] - ty
        size += ux * ux + uy * uy
        along += ux * vx + uy * vy
        across += ux * vy - uy * vx
    if size <= 1e-12 * count:
        return np.eye(2)
    return np.array([[along, -across], [across, along]]) / size


@njit(cache=True, nogil=True)
def _affine(source, target, chosen, weight, expected):  # type: ignore[no-untyped-def]
    """The map of the chosen points' source to their target (N, 2), its linear part drawn a little towards `expected`.

    Returns the weighted mean of the source, where that goes, and the linear part.
    """
    share = weight / weight.sum()
    middle, goes = np.zeros(2), np.zeros(2)
    for k in range(len(chosen)):
        middle += share[k] * source[chosen[k]]
        goes += share[k] * target[chosen[k]]
    mxx = mxy = myy = nxx = nxy = nyx = nyy = 0.0
    for k in range(len(chosen)):
        ux, uy = source[chosen[k]] - middle
        vx, vy = target[chosen[k]] - goes
        mxx += share[k] * ux * ux
        mxy += share[k] * ux * uy
        myy += share[k] * uy * uy
        nxx += share[k] * vx * ux
        nxy += share[k] * vx * uy
        nyx += share[k] * vy * ux
        nyy += share[k] * vy * uy
    ridge = STIFFNESS * (mxx + myy) + 1e-12
    moment = np.array([[mxx + ridge, mxy], [mxy, myy + ridge]])
    cross = np.array([[nxx, nxy], [nyx, nyy]]) + ridge * expected
    return middle, goes, cross @ np.linalg.inv(moment)
