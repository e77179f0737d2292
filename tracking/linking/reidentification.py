"""Which markers the dots in sight are, by the shapes in which the body was seen before.

Where a body was out of sight and only part of it is back, a row of dots may be any of its rows. Each shape seen so far
is tried: the dots nearest to its markers are taken for these, which places the others anew, and so on. Of what comes of
it only that is believed in which all likely answers agree.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.tracking.linking.shape_prior import Belief, Memory
from scipy.spatial import cKDTree

Array = NDArray[Any]

TRIED = 48  # shapes
ROUNDS = 3
FIRST, LAST = 0.5, 0.25  # spacings: how far from a marker's place its dot may be at first and in the end
LIKELY = 12.0  # of the evidence's logarithm: an answer so much less likely than the best is not right
LOOSE = 0.05  # spacings: how far from its place a dot may be besides
FARTHEST = 4.0  # standard deviations: a dot farther off is another's
HALFWAY = 0.5  # spacings: likewise
RATIO = 9.0  # of the densities' logarithms, twice: a marker so much less likely is not the one
SURPRISING = 4.0  # mean square: a best answer that is more so is not believed


def recalled(
    memory: Memory, dots: Array, sure: NDArray[np.int64], spacing: Array
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The dot of each marker, (M), -1 for none, and which of them are beyond doubt, (M).

    Args:
        memory: the shapes.
        dots: of the picture [px], (D, 2).
        sure: the dots of the markers of which they are known, (M), -1 for the others.
        spacing: of the markers [px], (M).
    """
    answers: dict[tuple[int, ...], float] = {}
    surprise: dict[tuple[int, ...], float] = {}
    for shape in memory.shapes(TRIED):
        match = sure
        for gate in np.linspace(FIRST, LAST, ROUNDS):
            match = _nearest(shape, dots, sure, gate * spacing)
            if (match < 0).all():
                break
            known = match >= 0
            place = np.where(known[:, None], dots[match], 0.0)
            # All are placed anew by the others' dots together.
            shape = memory.smoothed(place, known)
        key = tuple(match)
        if (match >= 0).any() and key not in answers:
            known = match >= 0
            answers[key], surprise[key] = memory.evidence(np.where(known[:, None], dots[match], 0.0), known)
    if not answers:
        return sure, sure >= 0
    best = max(answers, key=answers.__getitem__)
    match = np.array(best)
    if surprise[best] > SURPRISING:
        return sure, sure >= 0
    agreed = match >= 0
    for key, evidence in answers.items():
        if evidence > answers[best] - LIKELY:
            agreed &= np.array(key) == match
    centre = np.where(agreed[:, None], dots[match], 0.0)
    for marker in np.flatnonzero(agreed & (sure < 0)):
        others = agreed.copy()
        others[marker] = False
        if not others.any():
            return match, sure >= 0
        belief = memory.carried(centre, others)
        if not unmistakable(belief, centre, np.array([marker]), ~others, spacing)[0]:
            agreed[marker] = False
    return match, agreed


def unmistakable(
    belief: Belief, centre: Array, asked: NDArray[np.int64], out: NDArray[np.bool_], spacing: Array
) -> NDArray[np.bool_]:
    """Which dots are no other marker's than the one asked for, (A).

    They lie near its place, and as uncertainty goes so far from that of any other which is out of sight, that they can
    be none of these.

    Args:
        belief: of the markers.
        centre: of the markers' dots [px], (M, 2).
        asked: markers, (A).
        out: markers that may be the ones that these dots are, (M).
        spacing: of the markers [px], (M).
    """
    free = np.flatnonzero(out)
    width = np.hypot(belief.sigma, LOOSE * spacing)[free]
    gaps = np.linalg.norm(centre[asked][:, None] - belief.place[free], axis=2)
    unlikely = (gaps / width) ** 2 + 4.0 * np.log(width)  # twice the logarithm of a density, but for its sign
    mine = asked[:, None] == free
    other = np.where(mine, np.inf, unlikely).min(axis=1, initial=np.inf)
    own, gap = unlikely[mine], gaps[mine]
    near = (gap < FARTHEST * width[mine.argmax(axis=1)]) & (gap < HALFWAY * spacing[asked])
    return near & (own + RATIO < other)


def _nearest(shape: Array, dots: Array, sure: NDArray[np.int64], gate: Array) -> NDArray[np.int64]:
    """The dot of each marker (M): a sure one, or one within the gate [px], (M), to which no other marker is nearer."""
    gap, near = cKDTree(dots).query(shape)
    order = np.argsort(gap)
    match, taken = sure.copy(), set(sure[sure >= 0].tolist())
    for marker in order:
        if match[marker] < 0 and gap[marker] < gate[marker] and near[marker] not in taken:
            match[marker] = near[marker]
            taken.add(int(near[marker]))
    return match
