"""How a match of dots to a body's markers spreads from neighbour to neighbour.

Each step trusts the affine map of the matches around it, drawn a little towards the expected one. The arguments that
all of these functions share are those of `rafl.tracking.linking.matching`: markers' shape and expected places (M, 2) [px], the expected
motion's linear part (M, 2, 2), their spacing (M) and neighbours (M, K), and the picture's dots (D, 2).
"""

import numpy as np
from numba import njit

STIFFNESS = 0.04  # of neighbours' own spread: how firmly local maps hold on to the expected one
GATE = 0.36  # of a marker's spacing: how far from where its neighbours put it a dot may be
ROUGH = 0.5  # of a marker: what a dot at the gate's edge costs
AMBIGUOUS = 0.75  # of a marker: a match that explains less than so much less may be right as well


@njit(cache=True, nogil=True)
def _predicted(marker, shape, linear, spacing, neighbours, dots, match):
    """Where a marker's matched neighbours put it: their affine map, drawn towards the expected one."""
    sw = sx = sy = tx = ty = 0.0  # sums over neighbours, places taken from the marker's own
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
    if sw == 0.0:  # apart from all that is matched: from the nearest matched marker
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
    nxx += ridge * linear[marker, 0, 0]
    nxy += ridge * linear[marker, 0, 1]
    nyx += ridge * linear[marker, 1, 0]
    nyy += ridge * linear[marker, 1, 1]
    mxx += ridge
    myy += ridge
    inverse = 1.0 / (mxx * myy - mxy * mxy)
    px = (mxy * sy - myy * sx) * inverse
    py = (mxy * sx - mxx * sy) * inverse
    return shape[marker, 0] + tx + nxx * px + nxy * py, shape[marker, 1] + ty + nyx * px + nyy * py


@njit(cache=True, nogil=True)
def _nearest_free(x, y, gate, dots, taken, buckets, cell, origin):
    """The nearest dot not taken within the gate of (x, y), -1 for none."""
    found = -1
    nearest = gate
    column, row = int((x - origin[0]) / cell), int((y - origin[1]) / cell)
    for r in range(max(row - 1, 0), min(row + 2, buckets.shape[0])):
        for c in range(max(column - 1, 0), min(column + 2, buckets.shape[1])):
            for k in range(buckets.shape[2]):
                dot = buckets[r, c, k]
                if dot < 0:
                    break
                gap = np.hypot(dots[dot, 0] - x, dots[dot, 1] - y)
                if gap < nearest and not taken[dot]:
                    nearest = gap
                    found = dot
    return found


@njit(cache=True, nogil=True)
def _settle(shape, linear, spacing, neighbours, dots, buckets, cell, origin, taken, match):
    """Gives up matches that their neighbours contradict, and looks again for markers that found none."""
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
            x, y = _predicted(marker, shape, linear, spacing, neighbours, dots, match)
            if own >= 0:
                if np.hypot(dots[own, 0] - x, dots[own, 1] - y) < 1.3 * GATE * spacing[marker]:
                    match[marker] = own
                else:
                    taken[own] = False
            else:
                found = _nearest_free(x, y, GATE * spacing[marker], dots, taken, buckets, cell, origin)
                if found >= 0:
                    match[marker] = found
                    taken[found] = True


@njit(cache=True, nogil=True)
def _grow(shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, sure, seed, match):
    """Spread the match of a seed, one marker and one dot, and of sure ones (M), -1 for none; fills match (M) likewise.

    Returns the match's score; a marker counts up to 1 + steady (M) where it is expected. buckets (R, C, B): dots by
    square of side `cell` from `origin`, -1 filled.
    """
    count = shape.shape[0]
    visited = sure >= 0
    taken = np.zeros(dots.shape[0], np.bool_)
    ready = np.zeros(count, np.int64)  # matched neighbours
    match[:] = sure
    for marker in range(count):
        if sure[marker] >= 0:
            taken[sure[marker]] = True
            for k in range(neighbours.shape[1]):
                if neighbours[marker, k] >= 0:
                    ready[neighbours[marker, k]] += 1
    marker, found = seed[0], seed[1]
    while True:
        visited[marker] = True
        if found >= 0:
            match[marker] = found
            taken[found] = True
            for k in range(neighbours.shape[1]):
                if neighbours[marker, k] >= 0:
                    ready[neighbours[marker, k]] += 1
        best = -1
        for other in range(count):
            if not visited[other] and (best < 0 or ready[other] > ready[best]):
                best = other
        if best < 0:
            break
        marker = best
        x, y = _predicted(marker, shape, linear, spacing, neighbours, dots, match)
        found = _nearest_free(x, y, GATE * spacing[marker], dots, taken, buckets, cell, origin)
    _settle(shape, linear, spacing, neighbours, dots, buckets, cell, origin, taken, match)
    score = 0.0
    total = (match >= 0).sum()
    for marker in range(count):
        found = match[marker]
        if found < 0:
            continue
        score += 1.0
        if total > 1:
            match[marker] = -1
            x, y = _predicted(marker, shape, linear, spacing, neighbours, dots, match)
            match[marker] = found
            misfit = np.hypot(dots[found, 0] - x, dots[found, 1] - y) / (GATE * spacing[marker])
            score -= ROUGH * min(misfit * misfit, 1.5)
        away = np.hypot(dots[found, 0] - expected[marker, 0], dots[found, 1] - expected[marker, 1])
        score -= far * min(away / spacing[marker], 3.0)
        score += steady[marker] * max(1.0 - away / spacing[marker], 0.0)
    return score


@njit(cache=True, nogil=True)
def best_growth(
    shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, seeds, enough, best
):
    """Tries seeds (S, 2) of marker and dot until a score reaches `enough`; fills best (M)."""
    match, nobody = np.empty(shape.shape[0], np.int64), np.full(shape.shape[0], -1)
    highest = -np.inf
    for s in range(seeds.shape[0]):
        # A pair that the best match already holds would grow into the same.
        if highest > -np.inf and best[seeds[s, 0]] == seeds[s, 1]:
            continue
        score = _grow(
            shape,
            expected,
            linear,
            spacing,
            neighbours,
            dots,
            buckets,
            cell,
            origin,
            far,
            steady,
            nobody,
            seeds[s],
            match,
        )
        if score > highest:
            highest = score
            best[:] = match
        if highest >= enough:
            break
    return highest


@njit(cache=True, nogil=True)
def agreed_growth(
    shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, sure, seeds, best
):
    """Which markers have the same dot in best (M) and in all matches that grow from seeds and sure ones as well."""
    agreed = best >= 0
    match = np.empty(shape.shape[0], np.int64)
    first = np.flatnonzero(best >= 0)[0]
    pair = np.array([first, best[first]])
    score = _grow(
        shape, expected, linear, spacing, neighbours, dots, buckets, cell, origin, far, steady, best, pair, match
    )
    for s in range(seeds.shape[0]):
        marker, dot = seeds[s, 0], seeds[s, 1]
        if best[marker] == dot or sure[marker] >= 0:
            continue
        other = _grow(
            shape,
            expected,
            linear,
            spacing,
            neighbours,
            dots,
            buckets,
            cell,
            origin,
            far,
            steady,
            sure,
            seeds[s],
            match,
        )
        if other > score - AMBIGUOUS:
            agreed &= match == best
    return agreed
