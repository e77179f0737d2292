"""Compiled kernels that spread a match of dots to markers from neighbour to neighbour.

Each step predicts a marker from the affine map of the matches around it, regularised towards the identity. Shared
arguments:

- shape (M, 2): the pattern [px].
- spacing (M) [px] and neighbours (M, K), -1 filled: see `MarkerPattern`.
- dots (D, 2): of the frame [px].
- distance_cost: score lost by a dot one spacing from its position in the pattern.
- taken (D): whether a dot is matched; match (M): the dot of each marker, -1 for none.
"""

import numpy as np
from numba import njit

STIFFNESS = 0.04  # weight of the identity, relative to the mean square distance of the matched neighbours
GATE_SPACINGS = 0.36  # most distance of a dot from its predicted position
MISFIT_COST = 0.5  # score lost by a dot at the gate's edge; a matched marker scores 1


@njit(cache=True, nogil=True)
def _predict(marker, shape, spacing, neighbours, dots, match):
    """A marker's position (x, y) from the regularised affine map of its matched neighbours."""
    sw = sx = sy = tx = ty = 0.0  # sums over neighbours, relative to the marker's own position
    mxx = mxy = myy = nxx = nxy = nyx = nyy = 0.0
    for k in range(neighbours.shape[1]):
        other = neighbours[marker, k]
        if other >= 0 and match[other] >= 0:
            ux, uy = shape[other, 0] - shape[marker, 0], shape[other, 1] - shape[marker, 1]
            vx, vy = dots[match[other], 0] - shape[marker, 0], dots[match[other], 1] - shape[marker, 1]
            g = 1.0 / (np.hypot(ux, uy) + 1e-9)
            sw += g
            sx += g * ux
            sy += g * uy
            tx += g * vx
            ty += g * vy
            mxx += g * ux * ux
            mxy += g * ux * uy
            myy += g * uy * uy
            nxx += g * vx * ux
            nxy += g * vx * uy
            nyx += g * vy * ux
            nyy += g * vy * uy
    if sw == 0.0:  # no matched neighbour: use the nearest matched marker
        nearest = np.inf
        for other in range(shape.shape[0]):
            if match[other] >= 0:
                ux, uy = shape[other, 0] - shape[marker, 0], shape[other, 1] - shape[marker, 1]
                gap = np.hypot(ux, uy)
                if gap < nearest:
                    nearest = gap
                    sx, sy = ux, uy
                    tx, ty = dots[match[other], 0] - shape[marker, 0], dots[match[other], 1] - shape[marker, 1]
    else:
        sx, sy, tx, ty = sx / sw, sy / sw, tx / sw, ty / sw
        mxx, mxy, myy = mxx / sw - sx * sx, mxy / sw - sx * sy, myy / sw - sy * sy
        nxx, nxy, nyx, nyy = nxx / sw - tx * sx, nxy / sw - tx * sy, nyx / sw - ty * sx, nyy / sw - ty * sy
    ridge = STIFFNESS * (mxx + myy) + 1e-3 * spacing[marker] ** 2
    nxx += ridge
    nyy += ridge
    mxx += ridge
    myy += ridge
    inverse = 1.0 / (mxx * myy - mxy * mxy)
    px = (mxy * sy - myy * sx) * inverse
    py = (mxy * sx - mxx * sy) * inverse
    return shape[marker, 0] + tx + nxx * px + nxy * py, shape[marker, 1] + ty + nyx * px + nyy * py


@njit(cache=True, nogil=True)
def _nearest_free(x, y, gate, dots, taken):
    """The nearest dot within `gate` [px] of (x, y) that is not taken, -1 for none."""
    found = -1
    nearest = gate
    for dot in range(dots.shape[0]):
        gap = np.hypot(dots[dot, 0] - x, dots[dot, 1] - y)
        if gap < nearest and not taken[dot]:
            nearest = gap
            found = dot
    return found


@njit(cache=True, nogil=True)
def _refine(shape, spacing, neighbours, dots, taken, match):
    """Drop matches that contradict their neighbours, and search again for unmatched markers. Changes match in place."""
    for _ in range(2):
        for marker in range(shape.shape[0]):
            own = match[marker]
            around = 0
            for k in range(neighbours.shape[1]):
                other = neighbours[marker, k]
                if other >= 0 and match[other] >= 0:
                    around += 1
            if around < 3:
                continue
            match[marker] = -1
            x, y = _predict(marker, shape, spacing, neighbours, dots, match)
            if own >= 0:
                if np.hypot(dots[own, 0] - x, dots[own, 1] - y) < 1.3 * GATE_SPACINGS * spacing[marker]:
                    match[marker] = own
                else:
                    taken[own] = False
            else:
                found = _nearest_free(x, y, GATE_SPACINGS * spacing[marker], dots, taken)
                if found >= 0:
                    match[marker] = found
                    taken[found] = True


@njit(cache=True, nogil=True)
def _propagate(shape, spacing, neighbours, dots, distance_cost, seed, match):
    """Fill match (M) by spreading from a seed (marker, dot). Returns its score.

    The unmatched marker with most matched neighbours comes next. Each matched marker scores 1 less its costs.
    """
    count = shape.shape[0]
    visited = np.zeros(count, np.bool_)
    taken = np.zeros(dots.shape[0], np.bool_)
    matched_neighbours = np.zeros(count, np.int64)
    match[:] = -1
    marker, found = seed[0], seed[1]
    while True:
        visited[marker] = True
        if found >= 0:
            match[marker] = found
            taken[found] = True
            for k in range(neighbours.shape[1]):
                if neighbours[marker, k] >= 0:
                    matched_neighbours[neighbours[marker, k]] += 1
        best = int(np.int64(-1))  # no literal, for which `_predict` would be compiled once more
        for other in range(count):
            if not visited[other] and (best < 0 or matched_neighbours[other] > matched_neighbours[best]):
                best = other
        if best < 0:
            break
        marker = best
        x, y = _predict(marker, shape, spacing, neighbours, dots, match)
        found = _nearest_free(x, y, GATE_SPACINGS * spacing[marker], dots, taken)
    _refine(shape, spacing, neighbours, dots, taken, match)
    score = 0.0
    total = (match >= 0).sum()
    for marker in range(count):
        found = match[marker]
        if found < 0:
            continue
        score += 1.0
        if total > 1:
            match[marker] = -1
            x, y = _predict(marker, shape, spacing, neighbours, dots, match)
            match[marker] = found
            misfit = np.hypot(dots[found, 0] - x, dots[found, 1] - y) / (GATE_SPACINGS * spacing[marker])
            score -= MISFIT_COST * min(misfit * misfit, 1.5)
        distance = np.hypot(dots[found, 0] - shape[marker, 0], dots[found, 1] - shape[marker, 1])
        score -= distance_cost * min(distance / spacing[marker], 3.0)
    return score


@njit(cache=True, nogil=True)
def best_match(shape, spacing, neighbours, dots, distance_cost, seeds, sufficient_score, best):
    """Fill best (M) with the best match from seeds (S, 2) of marker and dot, in order. Returns its score.

    Stops at the first score of at least `sufficient_score`.
    """
    match = np.empty(shape.shape[0], np.int64)
    highest = -np.inf
    for s in range(seeds.shape[0]):
        # A seed that the best match already contains would give the same match.
        if highest > -np.inf and best[seeds[s, 0]] == seeds[s, 1]:
            continue
        score = _propagate(shape, spacing, neighbours, dots, distance_cost, seeds[s], match)
        if score > highest:
            highest = score
            for marker in range(shape.shape[0]):  # numba takes seconds to compile an assignment to a slice
                best[marker] = match[marker]
        if highest >= sufficient_score:
            break
    return highest
