"""Following every dot of a recording through one camera's video."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from groundwork import InputError
from tracking.dots import LEAST_CONTRAST, Dots, find_dots, refine
from tracking.video import Video

Array = NDArray[Any]

FEWEST_MARKERS = 3
NEIGHBOURS = 6
GATE = 0.45  # of the dot spacing: how far from its prediction a dot may be
CALM = 0.2  # of the dot spacing: motion and surprise in a frame below which looking nearby is safe
SHARES = (1.0, 0.5, 0.0, -0.5, -1.0)  # of the last velocity, tried when the motion is not calm
SHARP = 0.08  # px: a localisation error that a printed dot stays under
FAR = 0.15  # of a marker: what a jump of one spacing costs


@dataclass(frozen=True)
class Family:
    """What the markers of a recording have in common.

    Attributes:
        dark: darker than their surroundings.
        radius: median [px].
        contrast: median [grey levels].
        sigma: median localisation error [px].
    """

    dark: bool
    radius: float
    contrast: float
    sigma: float

    def admits(self, dots: Dots) -> NDArray[np.bool_]:
        """Which dots could be markers of this family, (D)."""
        with np.errstate(invalid="ignore"):
            return (
                (np.abs(np.log(dots.radius / self.radius)) < np.log(1.35))
                & (dots.flattening > 0.45)
                & (dots.contrast / self.contrast > 0.3)
                & (dots.contrast / self.contrast < 3.0)
                & (np.abs(dots.contrast) > LEAST_CONTRAST)
                & (dots.residual < 0.2)
                & (dots.sigma < max(6.0 * self.sigma, 0.1))
            )


@dataclass(frozen=True)
class PixelTracks:
    """One camera's view of a recording; markers not named yet.

    Attributes:
        time: [s], (T), NaN where the video does not say.
        pixel: (T, D, 2), NaN where not measured.
        sigma: one standard deviation per axis [px], (T, D).
        start: positions in the first frame [px], (D, 2).
    """

    time: Array
    pixel: Array
    sigma: Array
    start: Array


def find_family(image: NDArray[np.uint8]) -> tuple[Family, Dots] | None:
    """The markers of a picture: the largest set of well-located dots alike in size and contrast."""
    best: tuple[float, Family, Dots] | None = None
    for dark in (True, False):
        dots = find_dots(image, dark)
        dots = dots[(dots.residual < 0.15) & (dots.flattening > 0.6)]
        # A printed dot is located ten times as well as a blot that happens to be round.
        quality = 1.0 / (1.0 + (dots.sigma / SHARP) ** 2) ** 2
        for seed in range(len(dots)):
            alike = np.abs(np.log(dots.radius / dots.radius[seed])) < np.log(1.2)
            alike &= np.abs(np.log(dots.contrast / dots.contrast[seed])) < np.log(2.2)
            score = float(quality[alike].sum())
            if best is None or score > best[0]:
                members = dots[alike]
                sigma = float(np.median(members.sigma))
                members = members[members.sigma < max(5.0 * sigma, 0.05)]
                family = Family(dark, float(np.median(members.radius)), float(np.median(members.contrast)), sigma)
                best = (score, family, members)
    return None if best is None else (best[1], best[2])


def follow(video: Video, tick: Callable[[], None]) -> PixelTracks:
    """Find the markers in the first frame and follow them to the last.

    Args:
        video: one camera's.
        tick: called after every frame.

    Raises:
        InputError: fewer than three markers, or a frame that cannot be decoded.
    """
    times: list[float] = []
    pixels: list[Array] = []
    sigmas: list[Array] = []
    tracker: Tracker | None = None
    for time, image in video.pictures():
        if tracker is None:
            found = find_family(image)
            count = 0 if found is None else len(found[1])
            if found is None or count < FEWEST_MARKERS:
                raise InputError(
                    f"{video.path}: expected at least {FEWEST_MARKERS} dots of one size in the first frame, "
                    f"found {count}; check that dots of 3 to 32 px radius contrast with the skin"
                )
            tracker = Tracker(*found)
            pixel, sigma = found[1].centre, found[1].sigma
        else:
            pixel, sigma = tracker.advance(image)
        times.append(np.nan if time is None else time)
        pixels.append(pixel)
        sigmas.append(sigma)
        tick()
    return PixelTracks(np.array(times), np.array(pixels), np.array(sigmas), pixels[0])


class Tracker:
    """The markers' state between frames: where each was, how it moves, what it looks like."""

    def __init__(self, family: Family, dots: Dots) -> None:
        self.family = family
        self.position = dots.centre.copy()
        self.velocity = np.zeros_like(self.position)
        self.missing = np.zeros(len(dots), dtype=int)
        self.rest = dots.centre.copy()
        tree = cKDTree(self.rest)
        self.spacing = float(np.median(tree.query(self.rest, 2)[0][:, 1]))
        close = tree.sparse_distance_matrix(tree, 1.6 * self.spacing, output_type="coo_matrix")
        self.piece = connected_components(close, directed=False)[1]
        self.calm = True
        self.radius = dots.radius.copy()
        self.contrast = dots.contrast.copy()

    def advance(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Positions (D, 2) and sigma (D) in the next picture, NaN where a marker is not seen."""
        prediction = self._prediction(1.0)
        pixel = np.full_like(prediction, np.nan)
        sigma = np.full(len(prediction), np.nan)
        if self.calm:
            pixel, sigma = self._where_predicted(image, prediction)
        if np.isnan(sigma).any() or self._two_in_one_place(pixel):
            whole = find_dots(image, self.family.dark)
            pixel, sigma = self._assign(whole[self.family.admits(whole)])
        seen = np.isfinite(sigma)
        before = self.position
        surprise = np.linalg.norm(pixel - prediction, axis=1)[seen]
        moved = (pixel - before) / (self.missing + 1)[:, None]
        self.velocity = np.where(seen[:, None], moved, 0.0)
        self.missing = np.where(seen, 0, self.missing + 1)
        self.position = np.where(seen[:, None], pixel, before)
        largest = max(surprise.max(initial=0.0), np.linalg.norm(self.velocity, axis=1).max())
        self.calm = bool(largest < CALM * self.spacing)
        return pixel, sigma

    def _prediction(self, share: float) -> Array:
        """At `share` of the last velocity; a marker out of sight moves as its neighbours do."""
        predicted = self.position + share * self.velocity
        seen = self.missing == 0
        if seen.any() and not seen.all():
            drift = np.where(seen[:, None], predicted - self.rest, np.nan)
            predicted[~seen] = self.rest[~seen] + self._smoothed(drift)[~seen]
        return predicted

    def _smoothed(self, field: Array) -> Array:
        """A displacement field (D, 2) with NaN gaps, at every marker from its neighbours: a plane
        through the six nearest known ones, or the mean of fewer."""
        known = np.flatnonzero(np.isfinite(field[:, 0]))
        if not len(known):
            return np.zeros_like(field)
        count = min(NEIGHBOURS, len(known))
        nearest = cKDTree(self.rest[known]).query(self.rest, count)[1].reshape(len(field), count)
        result = np.empty_like(field)
        for marker, rows in enumerate(nearest):
            others = known[rows[known[rows] != marker]]
            if not len(others):
                result[marker] = field[known].mean(0)
                continue
            offset = (self.rest[others] - self.rest[marker]) / self.spacing
            design = np.column_stack([np.ones(len(others)), offset])
            weight = np.exp(-0.25 * (offset**2).sum(1))[:, None]
            # A little ridge on the slopes: neighbours in one line say nothing across it.
            normal = design.T @ (weight * design) + np.diag([1e-9, 0.02, 0.02])
            result[marker] = np.linalg.solve(normal, design.T @ (weight * field[others]))[0]
        return result

    def _where_predicted(self, image: NDArray[np.uint8], prediction: Array) -> tuple[Array, Array]:
        shape = 1.0 / self.radius
        zero = np.zeros_like(shape)
        rows = np.clip(prediction[:, 1].astype(int), 0, image.shape[0] - 1)
        columns = np.clip(prediction[:, 0].astype(int), 0, image.shape[1] - 1)
        level = image[rows, columns] - self.contrast
        start = np.column_stack(
            [prediction, shape, zero, shape, np.full_like(shape, 0.8), self.contrast, level, zero, zero]
        )
        dots = refine(image, start)
        change = dots.contrast / self.contrast
        good = self.family.admits(dots) & (change > 0.55) & (change < 1.8)
        self.contrast = np.where(good, dots.contrast, self.contrast)
        self.radius = np.where(good, dots.radius, self.radius)
        return np.where(good[:, None], dots.centre, np.nan), np.where(good, dots.sigma, np.nan)

    def _two_in_one_place(self, pixel: Array) -> bool:
        seen = pixel[np.isfinite(pixel[:, 0])]
        return len(seen) > 1 and bool((cKDTree(seen).query(seen, 2)[0][:, 1] < 0.5 * self.family.radius).any())

    def _assign(self, dots: Dots) -> tuple[Array, Array]:
        """All markers to dots at once.

        A pattern of equal dots looks the same one spacing on, so several motions are tried; the one
        that finds most markers with the smallest jumps is taken.
        """
        pixel = np.full_like(self.position, np.nan)
        sigma = np.full(len(pixel), np.nan)
        if not len(dots):
            return pixel, sigma
        best = max(
            (self._matching(dots, self._prediction(share), settle=True) for share in SHARES),
            key=lambda matching: matching.score,
        )
        # A dot left over beside a marker left out: the whole row may stand one spacing on.
        left_over = np.setdiff1d(np.arange(len(dots)), best.dot)
        for dot in left_over if len(best.marker) < len(pixel) else ():
            away = dots.centre[dot] - best.expected
            for marker in np.argsort(np.linalg.norm(away, axis=1))[:3]:
                if np.linalg.norm(away[marker]) < 1.3 * self.spacing:
                    shift = np.where((self.piece == self.piece[marker])[:, None], away[marker], 0.0)
                    other = self._matching(dots, best.expected + shift, settle=False)
                    best = max(best, other, key=lambda matching: matching.score)
        pixel[best.marker], sigma[best.marker] = dots.centre[best.dot], dots.sigma[best.dot]
        return pixel, sigma

    def _matching(self, dots: Dots, expected: Array, *, settle: bool) -> "_Matching":
        """Markers and their dots; with `settle`, expectations first follow what the neighbours found."""
        prediction = expected
        if settle:
            gate = 1.5 * GATE * self.spacing
            for _ in range(4):
                marker, dot = _matched(expected, dots.centre, gate)
                field = np.full_like(prediction, np.nan)
                field[marker] = dots.centre[dot] - prediction[marker]
                expected = prediction + self._smoothed(field)
                gate = GATE * self.spacing
        marker, dot = _matched(expected, dots.centre, GATE * self.spacing)
        jump = np.linalg.norm(dots.centre[dot] - self.position[marker], axis=1) / self.spacing
        return _Matching(marker, dot, expected, len(marker) - FAR * float(np.minimum(jump, 3.0).sum()))


@dataclass(frozen=True)
class _Matching:
    """Pairs of marker and dot, where markers were expected (D, 2), and how good it is."""

    marker: NDArray[np.int64]
    dot: NDArray[np.int64]
    expected: Array
    score: float


def _matched(expected: Array, found: Array, gate: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    distance = np.linalg.norm(expected[:, None] - found[None], axis=2)
    row, column = linear_sum_assignment(np.minimum(distance, gate) ** 2)
    near = distance[row, column] < gate
    return row[near], column[near]
