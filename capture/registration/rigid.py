"""Rigid registration of recorded markers to the specimen frame."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

Array = NDArray[Any]

FEWEST_MARKERS = 3
# A marker is wrong that is away from its place by more than this [m], and so many times its sigma and the others.
WRONG, WRONG_TIMES = 1e-3, 5.0
MOST_WRONG = 4  # one in so many may be wrong, and one in any case
MOST_TRIPLES = 2000


@dataclass(frozen=True)
class Rigid:
    """x -> R x + t.

    Attributes:
        rotation: (..., 3, 3).
        translation: [m], (..., 3).
    """

    rotation: Array
    translation: Array

    def apply(self, points: Array) -> Array:
        """Transform points (..., M, 3)."""
        return points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]

    def moved(self, step: Array) -> "Rigid":
        """Followed by a turn (rotation vector) and a shift [m], `step` (6)."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return Rigid(turn @ self.rotation, turn @ self.translation + step[3:])

    def at(self, chosen: slice) -> "Rigid":
        """Of some frames, where there is one for every frame; else itself."""
        return Rigid(self.rotation[chosen], self.translation[chosen]) if self.rotation.ndim == 3 else self

    def turned_sigma(self, sigma: Array) -> Array:
        """Standard deviations (..., M, 3) along the axes after the turn; correlations between axes are left out."""
        return np.sqrt(sigma**2 @ np.swapaxes(self.rotation, -1, -2) ** 2)


IDENTITY = Rigid(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class RigidFit:
    """A rigid fit of one pose to the layout.

    Attributes:
        rigid: recorded frame to specimen frame.
        covariance: of a turn (rotation vector) and a shift that follow it [rad, m], (6, 6).
        residual: distance of each marker from its place [m], (M); NaN where not seen.
        wrong: markers that the others put elsewhere, (M); they do not count.
    """

    rigid: Rigid
    covariance: Array
    residual: Array
    wrong: NDArray[np.bool_]

    @property
    def size(self) -> float:
        """Root mean square of the residuals that count [m]."""
        return float(np.sqrt(np.nanmean(self.residual[~self.wrong] ** 2)))


def kabsch(source: Array, target: Array, weight: Array | None = None) -> Rigid:
    """The proper rotation and translation that bring points onto others best.

    Args:
        source: (..., M, 3), at least three points of some weight that are not in a line.
        target: (M, 3).
        weight: (..., M); alike unless given. Points of no weight may be NaN.

    Returns:
        A `Rigid` for each leading index.
    """
    weight = np.ones(source.shape[:-1]) if weight is None else weight
    share = (weight / weight.sum(-1, keepdims=True))[..., None]
    source = np.where(share > 0, source, 0.0)
    source_mean, target_mean = (share * source).sum(-2, keepdims=True), (share * target).sum(-2)
    moment = np.swapaxes(share * (source - source_mean), -1, -2) @ (target - target_mean[..., None, :])
    u, _, vt = np.linalg.svd(moment)
    flip = np.ones(moment.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    rotation = np.swapaxes(vt, -1, -2) @ (flip[..., None] * np.swapaxes(u, -1, -2))
    return Rigid(rotation, target_mean - (rotation @ np.swapaxes(source_mean, -1, -2))[..., 0])


def fit_pose(points: Array, layout: Array, sigma: Array) -> RigidFit:
    """Weighted rigid fit of one pose, which few wrong markers do not disturb.

    Of the poses that three markers give, the one with the least median distance tells which markers agree (least
    median of squares); those count.

    Args:
        points: recorded [m], (M, 3), NaN where missing; at least three, not in a line.
        layout: where they belong [m], (M, 3).
        sigma: standard deviations of the recorded points along their own axes [m], (M, 3).
    """
    seen = np.flatnonzero(np.isfinite(points[:, 0]))
    used = seen
    if len(seen) > FEWEST_MARKERS:
        x, y = points[seen], layout[seen]
        allowed = np.maximum(WRONG, WRONG_TIMES * np.linalg.norm(sigma[seen], axis=1))
        away = _away_by_triples(x, y)
        away = away[np.argmin(np.median(away / allowed, axis=1))]
        for _ in range(3):  # what agrees with three, then with all that agree
            near = away <= np.maximum(allowed, WRONG_TIMES * np.median(away))
            if (~near).sum() > max(1, len(seen) // MOST_WRONG):
                used = seen  # no few wrong markers: a wrong layout
                break
            used = seen[near]
            away = _distances(_weighted(points, layout, sigma, used)[0], x, y)
    rigid, covariance = _weighted(points, layout, sigma, used)
    wrong = np.zeros(len(points), dtype=bool)
    wrong[np.setdiff1d(seen, used)] = True
    return RigidFit(rigid, covariance, _distances(rigid, points, layout), wrong)


def _away_by_triples(points: Array, layout: Array) -> Array:
    """Distances (K, M) of all points from their places, by the pose that each of K triples gives."""
    triples = np.array(list(itertools.combinations(range(len(points)), 3)))
    if len(triples) > MOST_TRIPLES:
        triples = triples[np.random.default_rng(0).choice(len(triples), MOST_TRIPLES, replace=False)]
    chosen = np.zeros((len(triples), len(points)))
    np.put_along_axis(chosen, triples, 1.0, axis=1)
    own = kabsch(np.broadcast_to(points, (len(triples), *points.shape)), layout, chosen)
    return np.linalg.norm(own.apply(points) - layout, axis=2)


def _distances(rigid: Rigid, points: Array, layout: Array) -> Array:
    return np.linalg.norm(rigid.apply(points) - layout, axis=1)


def _weighted(points: Array, layout: Array, sigma: Array, used: NDArray[np.int64]) -> tuple[Rigid, Array]:
    """Least squares by the sigma of every coordinate, and its covariance."""
    x, y, s = points[used], layout[used], sigma[used]
    start = kabsch(x, y, 1.0 / (s**2).mean(1))

    def gaps(step: Array) -> Array:
        moved = start.moved(step)
        return ((x - (y - moved.translation) @ moved.rotation) / s).ravel()

    found = least_squares(gaps, np.zeros(6), x_scale="jac")
    chi = max(float((found.fun**2).sum()) / max(len(found.fun) - 6, 1), 1.0)
    return start.moved(found.x), chi * np.linalg.pinv(found.jac.T @ found.jac)


def follow_clamp(points: Array, layout: Array, sigma: Array) -> tuple[Rigid, Array]:
    """The pose of every frame by markers on the clamp, and their distances from their places then.

    Frames that show fewer than three of them are bridged between their neighbours.

    Args:
        points: recorded [m], (T, M, 3), NaN where missing; some frame shows three.
        layout: (M, 3).
        sigma: (T, M, 3).

    Returns:
        A `Rigid` of T frames and the distances (T, M) [m], NaN where missing.
    """
    seen = np.isfinite(points[..., 0])
    weight = np.where(seen, 1.0 / (np.where(seen[..., None], sigma, 1.0) ** 2).mean(-1), 0.0)
    shown = np.flatnonzero(seen.sum(axis=1) >= FEWEST_MARKERS)
    own = kabsch(points[shown], layout, weight[shown])
    if len(shown) < len(points):
        every = np.clip(np.arange(len(points)), shown[0], shown[-1])
        translation = np.stack([np.interp(every, shown, own.translation[:, k]) for k in range(3)], axis=1)
        turns = Rotation.from_matrix(own.rotation)
        rotation = Slerp(shown, turns)(every).as_matrix() if len(shown) > 1 else own.rotation[np.zeros_like(every)]
        own = Rigid(rotation, translation)
    return own, np.linalg.norm(own.apply(points) - layout, axis=2)
