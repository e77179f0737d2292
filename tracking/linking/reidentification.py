"""Which markers the visible dots are, when part of a body comes back into sight.

A row of dots may then be any row of markers. The shapes seen so far are tried as hypotheses. For each one, the dots
nearest to its markers are matched to them, the shape is fitted to these dots, and both steps are repeated. A match is
accepted only for the markers on which all likely hypotheses agree.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rafl.tracking.linking.shape_prior import PredictedPosition, ShapePrior

Array = NDArray[Any]

MAX_TRIED_SHAPES = 48
ITERATIONS = 3  # of matching and fitting, for each shape
FIRST_GATE, LAST_GATE = 0.5, 0.25  # most distance of a dot from its marker, in the first and last iteration [spacings]
MAX_LOG_DEFICIT = 12.0  # a hypothesis is likely if its log density is at most this much below the best one's
MAX_MEAN_SQUARE = 4.0  # the best hypothesis is rejected if the mean square of its residuals is larger
DOT_SIGMA = 0.05  # of a dot's position, besides the predicted one [spacings]
GATE_SIGMAS, GATE_SPACINGS = 4.0, 0.5  # most distance of a marker's own dot from its predicted position
MIN_LOG_RATIO = 9.0  # least twice the log density ratio of a dot's marker and any other marker


def reidentify(
    prior: ShapePrior, dots: Array, confirmed: NDArray[np.int64], spacing: Array
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The dot of each marker, (M), -1 for none, and which of these matches are unambiguous, (M).

    Args:
        prior: the shapes so far.
        dots: of the frame [px], (D, 2).
        confirmed: the dot of each marker that is matched already, (M), -1 for the others.
        spacing: of the markers [px], (M).
    """
    log_density: dict[tuple[int, ...], float] = {}
    mean_square: dict[tuple[int, ...], float] = {}
    for shape in prior.sample_shapes(MAX_TRIED_SHAPES):
        match = confirmed
        for gate in np.linspace(FIRST_GATE, LAST_GATE, ITERATIONS):
            match = _match_nearest(shape, dots, confirmed, gate * spacing)
            if (match < 0).all():
                break
            known = match >= 0
            position = np.where(known[:, None], dots[match], 0.0)
            shape = prior.smooth(position, known)
        key = tuple(match)
        if (match >= 0).any() and key not in log_density:
            known = match >= 0
            position = np.where(known[:, None], dots[match], 0.0)
            log_density[key], mean_square[key] = prior.evidence(position, known)
    if not log_density:
        return confirmed, confirmed >= 0
    best = max(log_density, key=log_density.__getitem__)
    match = np.array(best)
    if mean_square[best] > MAX_MEAN_SQUARE:
        return confirmed, confirmed >= 0
    agreed = match >= 0
    for key, density in log_density.items():
        if density > log_density[best] - MAX_LOG_DEFICIT:
            agreed &= np.array(key) == match
    centre = np.where(agreed[:, None], dots[match], 0.0)
    for marker in np.flatnonzero(agreed & (confirmed < 0)):
        others = agreed.copy()
        others[marker] = False
        if not others.any():
            return match, confirmed >= 0
        predicted = prior.predict(centre, others)
        if not unambiguous_dots(predicted, centre, np.array([marker]), ~others, spacing)[0]:
            agreed[marker] = False
    return match, agreed


def unambiguous_dots(
    predicted: PredictedPosition,
    centre: Array,
    queried: NDArray[np.int64],
    candidates: NDArray[np.bool_],
    spacing: Array,
) -> NDArray[np.bool_]:
    """Whether the dot of each queried marker can belong to no other marker, (A).

    The dot must be near the marker's predicted position, and much likelier to be this marker than any other candidate.

    Args:
        predicted: of the markers.
        centre: of the markers' dots [px], (M, 2).
        queried: indices of the markers, (A).
        candidates: the markers that these dots may be, (M); the queried ones are among them.
        spacing: of the markers [px], (M).
    """
    free = np.flatnonzero(candidates)
    sigma = np.hypot(predicted.sigma, DOT_SIGMA * spacing)[free]
    distance = np.linalg.norm(centre[queried][:, None] - predicted.position[free], axis=2)
    cost = (distance / sigma) ** 2 + 4.0 * np.log(sigma)  # -2 log density, up to a constant
    own = queried[:, None] == free
    least_other_cost = np.where(own, np.inf, cost).min(axis=1, initial=np.inf)
    own_cost, own_distance = cost[own], distance[own]
    near = (own_distance < GATE_SIGMAS * sigma[own.argmax(axis=1)]) & (own_distance < GATE_SPACINGS * spacing[queried])
    unambiguous: NDArray[np.bool_] = near & (own_cost + MIN_LOG_RATIO < least_other_cost)
    return unambiguous


def _match_nearest(shape: Array, dots: Array, confirmed: NDArray[np.int64], gate: Array) -> NDArray[np.int64]:
    """The dot of each marker (M), -1 for none: the confirmed one, or the nearest within the gate [px], (M).

    A dot that is nearest to several markers goes to the nearest of them.
    """
    distance, nearest = cKDTree(dots).query(shape)
    order = np.argsort(distance)
    match, taken = confirmed.copy(), set(confirmed[confirmed >= 0].tolist())
    for marker in order:
        if match[marker] < 0 and distance[marker] < gate[marker] and nearest[marker] not in taken:
            match[marker] = nearest[marker]
            taken.add(int(nearest[marker]))
    return match
