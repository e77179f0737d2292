"""Detecting markers that appear after the first frame, from behind a hand or from outside the image.

A dot becomes a marker if it moves and keeps its position on the body over several observations, and if nearly all of
the last frames show it there. Background blobs do neither.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rafl.tracking.detection.appearance import MIN_CONTRAST_RATIO, MarkerAppearance, row_spacing
from rafl.tracking.detection.detect import (
    MIN_SEPARATION_RADII,
    Dots,
    find_blobs,
    fit_dots,
    initial_parameters_at,
    remove_duplicates,
)
from rafl.tracking.detection.disc_model import PARAMETER_COUNT
from rafl.tracking.linking.late_marker_candidate import Candidate, Observation
from rafl.tracking.linking.matching import NEIGHBOUR_COUNT, MarkerPattern
from rafl.tracking.linking.shape_prior import ShapePrior

Array = NDArray[Any]

# Frames between searches: without candidates, with candidates, and if all candidates have long been static.
IDLE_INTERVAL, CANDIDATE_INTERVAL, STATIC_INTERVAL = 3, 2, 12
# Frames kept for tracking candidates back, their total size [bytes], and frames kept without candidates.
MAX_KEPT_FRAMES, MAX_KEPT_BYTES, IDLE_KEPT_FRAMES = 60, 2**28, 2
MIN_DISTANCE_SPACINGS = 0.55  # on the body, of a late marker from the known ones
MAX_DISTANCE_ROW_SPACINGS = 2.4  # on the body, of a late marker from the nearest known one
MAX_CANDIDATE_GAP = 0.45  # apparent displacement of a candidate between two observations [spacings]
UNIQUE_RATIO = 2.0  # the gap may be this much larger if every other dot and candidate is this much farther away
BACKTRACK_GATE = 0.3  # most distance of a tracked-back dot from its predicted position [spacings]
# Before the first observation the gate is at most this many times the largest distance so far, plus this many px.
EARLIER_GATE_FACTOR, EARLIER_GATE_PX = 2.0, 0.5
MAX_LOST_FRAMES = 2  # before the first observation: after so many frames in a row without the dot, tracking back ends
MIN_FOUND_SHARE, MIN_FOUND_FRAMES = 0.8, 3  # of the frames since its first observation, those that must show the dot
MIN_BODY_MARKERS = 3  # visible, to determine a dot's position on the body
MAX_JUMP = 0.5  # of one dot relative to the body, from frame to frame [spacings]
# Several dots were taken for one if the median step is below both: shares of the path's spread and of the body's step.
MIN_STEP_TO_SPREAD, MIN_STEP_TO_BODY_STEP = 0.02, 0.1
MAX_RADIUS_RATIO = 1.2  # of a late marker and the median one, either way


@dataclass(frozen=True)
class LateMarker:
    """A late-detected marker.

    Attributes:
        rest: its position in the marker pattern [px], (2).
        sigma: of `rest` along x and along y [px].
        parameters: of its disc, (12).
        seen: its position and sigma [px], (2) each, by frame, up to the present one.
    """

    rest: Array
    sigma: float
    parameters: Array
    seen: dict[int, tuple[Array, Array]]


class _KeptFrame(NamedTuple):
    """A frame, the known markers' positions there [px], (M, 2), and which of these are visible on the body, (M)."""

    number: int
    image: Array
    positions: Array
    body: NDArray[np.bool_]


@dataclass
class LateMarkerFinder:
    """Finds markers that are not known yet.

    Attributes:
        appearance: of the markers.
        rest_sigma: of each known marker's position in the pattern [px], (M).
    """

    appearance: MarkerAppearance
    rest_sigma: Array
    _candidates: list[Candidate] = field(default_factory=list)
    _next_search: int = 0  # frame
    _kept_frames: deque[_KeptFrame] = field(default_factory=deque)

    def find(
        self,
        number: int,
        image: Array,
        positions: Array,
        seen: NDArray[np.bool_],
        static: NDArray[np.bool_],
        pattern: MarkerPattern,
        parameters: Array,
    ) -> list[LateMarker]:
        """The markers that this frame confirms.

        Args:
            number: of the frame.
            image: of the frame.
            positions: of the known markers [px], (M, 2).
            seen: which of them are measured, (M).
            static: which of them are static dots, (M).
            pattern: of the known markers.
            parameters: of their discs, (M, 12).
        """
        frame = _KeptFrame(number, image, positions, seen & ~static)
        self._kept_frames.append(frame)
        most = MAX_KEPT_FRAMES if self._candidates else IDLE_KEPT_FRAMES  # decoding is slower outside the cache
        while len(self._kept_frames) > max(min(most, MAX_KEPT_BYTES // image.nbytes), 1):
            self._kept_frames.popleft()
        if number < self._next_search or 2 * frame.body.sum() < (~static).sum():
            return []
        spacing, rows = float(np.median(pattern.spacing)), row_spacing(pattern.rest[frame.body])
        reach, free = MAX_DISTANCE_ROW_SPACINGS * rows, 0.5 * MIN_DISTANCE_SPACINGS * spacing
        found = self._find_unknown_dots(image, positions, reach, free, parameters)
        if not len(found) and not self._candidates:
            self._next_search = number + IDLE_INTERVAL
            return []
        rest_of_dots = self._predict_rest(pattern, frame, found)[0]
        distance = np.linalg.norm(rest_of_dots[:, None] - pattern.rest[frame.body], axis=2).min(axis=1)
        near = distance < MAX_DISTANCE_ROW_SPACINGS * rows
        self._update_candidates(frame, rest_of_dots[near], found[near], MAX_CANDIDATE_GAP * spacing)
        static_only = all(candidate.is_long_static() for candidate in self._candidates)
        interval = IDLE_INTERVAL if not self._candidates else STATIC_INTERVAL if static_only else CANDIDATE_INTERVAL
        self._next_search = number + interval
        ready = [candidate for candidate in self._candidates if candidate.moves_with_body()]
        self._candidates = [candidate for candidate in self._candidates if candidate not in ready]
        markers: list[LateMarker] = []
        for candidate in ready:
            marker = self._track_back(candidate, pattern, parameters, spacing)
            others = np.concatenate([pattern.rest, *(other.rest[None] for other in markers)])
            least = MIN_DISTANCE_SPACINGS * spacing
            if marker is not None and np.linalg.norm(others - marker.rest, axis=1).min() > least:
                markers.append(marker)
        self.rest_sigma = np.append(self.rest_sigma, [marker.sigma for marker in markers])
        return markers

    def _find_unknown_dots(self, image: Array, positions: Array, reach: float, free: float, parameters: Array) -> Array:
        """Dots within `reach` [px] of the body, farther than `free` [px] from all known markers, [px], (D, 2)."""
        low, high = positions.min(0) - reach, positions.max(0) + reach
        region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        contrast = self.appearance.min_blob_contrast(self.appearance.contrast)
        blobs = find_blobs(image, self.appearance.radius, contrast, region, fast=True)
        distance = np.linalg.norm(blobs[:, None] - positions[None], axis=2).min(axis=1, initial=np.inf)
        unknown = blobs[distance > free]
        if not len(unknown):
            return np.empty((0, 2))
        starts = _median_discs(unknown, parameters)
        dots = fit_dots(image, np.concatenate([starts, _moved_discs(parameters, positions)]), len(starts))
        return remove_duplicates(dots[self._match(dots)], MIN_SEPARATION_RADII * self.appearance.radius).centre

    def _match(self, dots: Dots) -> NDArray[np.bool_]:
        """Which dots look like markers, (D)."""
        good = self.appearance.matches(dots) & (dots.contrast / self.appearance.contrast > MIN_CONTRAST_RATIO)
        ratio: NDArray[np.bool_] = np.abs(np.log(dots.radius / self.appearance.radius)) < np.log(MAX_RADIUS_RATIO)
        return good & ratio

    def _predict_rest(self, pattern: MarkerPattern, frame: _KeptFrame, points: Array) -> tuple[Array, Array]:
        """Positions and their sigma in the pattern of points (P, 2) of a frame [px]."""
        if not len(points):
            return points, np.empty(0)
        body, count = np.flatnonzero(frame.body), len(points)
        rest = np.concatenate([pattern.rest[body], points])
        sigma = np.append(self.rest_sigma[body], np.full(count, np.inf))
        prior = ShapePrior(np.concatenate([frame.positions[body], points]))
        predicted = prior.predict(rest, sigma)
        return predicted.position[-count:], predicted.sigma[-count:]

    def _update_candidates(self, frame: _KeptFrame, rest: Array, found: Array, max_gap: float) -> None:
        """Assign dots to candidates. Candidates without a dot are dropped, and dots without one become candidates.

        Args:
            frame: the present one.
            rest: the dots' positions in the pattern [px], (D, 2).
            found: the dots [px], (D, 2).
            max_gap: most distance of a dot from its candidate if the assignment is not unique [px].
        """
        before = self._candidates
        dots = zip(rest, found, strict=True)
        gaps = np.array([[candidate.distance_to(*dot) for candidate in before] for dot in dots])
        gaps = gaps.reshape(len(found), len(before))
        pairs = zip(*linear_sum_assignment(np.minimum(gaps, UNIQUE_RATIO * max_gap)), strict=True)
        known = {row: before[column] for row, column in pairs if _is_match(gaps, row, column, max_gap)}
        self._candidates = [known.get(row, Candidate()) for row in range(len(found))]
        for candidate, own_rest, position in zip(self._candidates, rest, found, strict=True):
            candidate.observations.append(Observation(frame.number, own_rest, position, frame.positions))

    def _track_back(
        self, candidate: Candidate, pattern: MarkerPattern, parameters: Array, spacing: float
    ) -> LateMarker | None:
        """The candidate tracked back through the kept frames.

        None if too few frames since its first observation show it, or if it is several dots.
        """
        first = candidate.observations[0].frame
        carried = self._predict_since(pattern.rest, np.median(candidate.rest, axis=0), first)
        if not candidate.moves_less_on_body():  # track it relative to the image, not to the body
            carried = dict.fromkeys(carried, np.zeros(2))
        observed = [item for item in candidate.observations if item.frame in carried]
        frames = [item.frame for item in observed]
        offsets = np.array([item.position - carried[item.frame] for item in observed])
        seen: dict[int, tuple[Array, Array]] = {}
        disc = np.full(PARAMETER_COUNT, np.nan)
        frames_since_first = lost = 0
        offset, largest_miss = offsets[-1], 0.0
        for frame in reversed(self._kept_frames):
            since_first = frame.number >= first
            if since_first:
                frames_since_first += 1
                offset = np.array([np.interp(frame.number, frames, component) for component in offsets.T])
            expected = carried[frame.number] + offset
            near = np.argsort(np.linalg.norm(frame.positions - expected, axis=1))[:NEIGHBOUR_COUNT]
            neighbours = _moved_discs(parameters[near], frame.positions[near])
            starts = np.concatenate([_median_discs(expected[None], parameters), neighbours])
            dots = fit_dots(frame.image, starts, 1)
            miss = float(np.linalg.norm(dots.centre[0] - expected))
            gate = BACKTRACK_GATE * spacing
            if not since_first:
                gate = min(gate, EARLIER_GATE_FACTOR * largest_miss + EARLIER_GATE_PX)
            if self._match(dots)[0] and dots.within(frame.image)[0] and miss < gate:
                largest_miss, lost, offset = max(largest_miss, miss), 0, offset + dots.centre[0] - expected
                disc = disc if seen else dots.parameters[0]
                seen[frame.number] = dots.centre[0], dots.sigma[0]
            elif not since_first:
                lost += 1
                if lost == MAX_LOST_FRAMES:
                    break
        path = np.array([(seen[number][0], carried[number]) for number in seen if number >= first]).reshape(-1, 2, 2)
        least = max(MIN_FOUND_SHARE * frames_since_first, MIN_FOUND_FRAMES)
        if len(path) < least or _is_several_dots(path[:, 0], path[:, 1], spacing):
            return None
        rest = self._estimate_rest(pattern, seen)
        return None if rest is None else LateMarker(*rest, disc, seen)

    def _predict_since(self, rest: Array, own_rest: Array, first: int) -> dict[int, Array]:
        """A dot's positions in the kept frames, predicted from the known markers [px], (2), by frame.

        The same markers are used since its first observation, because further markers would shift the prediction. In
        earlier frames with fewer known markers, these continue it without a jump.

        Args:
            rest: the markers' positions in the pattern [px], (M, 2).
            own_rest: the dot's position in the pattern [px], (2).
            first: frame of its first observation.
        """
        count = min(len(frame.positions) for frame in self._kept_frames if frame.number >= first)
        prior, offset = ShapePrior(np.concatenate([rest[:count], own_rest[None]])), np.zeros(2)
        carried: dict[int, Array] = {}
        for frame, later in zip(reversed(self._kept_frames), [None, *reversed(self._kept_frames)], strict=False):
            if later is not None and len(frame.positions) < count:
                count = len(frame.positions)
                prior = ShapePrior(np.concatenate([rest[:count], own_rest[None]]))
                offset = carried[later.number] - _predict_last(prior, later, count)
            carried[frame.number] = _predict_last(prior, frame, count) + offset
        return carried

    def _estimate_rest(
        self, pattern: MarkerPattern, seen: dict[int, tuple[Array, Array]]
    ) -> tuple[Array, float] | None:
        """A dot's position in the pattern [px], (2), and its sigma [px], from its positions and sigma by frame.

        The frame is used in which the body's shape is most similar to the pattern. None if no frame shows enough of it.
        """
        estimates = []
        for frame in self._kept_frames:
            body = np.flatnonzero(frame.body)
            if frame.number in seen and len(body) >= MIN_BODY_MARKERS:
                position, sigma = self._predict_rest(pattern, frame, seen[frame.number][0][None])
                error = np.hypot(_shape_difference(pattern.rest[body], frame.positions[body]), sigma[0])
                estimates.append((float(error), frame.number, position[0], float(sigma[0])))
        return min(estimates)[2:] if estimates else None


def _is_match(gaps: Array, row: int, column: int, max_gap: float) -> bool:
    """Whether dot `row` is candidate `column`, given all distances [px], (D, C)."""
    gap, others = gaps[row, column], np.append(np.delete(gaps[row], column), np.delete(gaps[:, column], row))
    unique = UNIQUE_RATIO * gap < others.min(initial=np.inf)
    return bool(gap < (UNIQUE_RATIO * max_gap if unique else max_gap))


def _predict_last(prior: ShapePrior, frame: _KeptFrame, count: int) -> Array:
    """Position of the prior's last marker [px], (2), predicted from the first `count` markers of a frame."""
    positions = np.append(frame.positions[:count], [[0.0, 0.0]], axis=0)
    last: Array = prior.predict(positions, np.where(np.append(frame.body[:count], False), 0.0, np.inf)).position[-1]
    return last


def _is_several_dots(found: Array, carried: Array, spacing: float) -> bool:
    """Whether a tracked path [px], (T, 2), goes from dot to dot.

    Then it jumps relative to the positions predicted from the body, (T, 2), or it stays still for most of the time.
    """
    if np.linalg.norm(np.diff(found - carried, axis=0), axis=1).max() > MAX_JUMP * spacing:
        return True
    step, body_step = (np.median(np.linalg.norm(np.diff(path, axis=0), axis=1)) for path in (found, carried))
    spread = np.linalg.norm(np.std(found, axis=0))
    return bool(step < MIN_STEP_TO_SPREAD * spread and step < MIN_STEP_TO_BODY_STEP * body_step)


def _shape_difference(rest: Array, positions: Array) -> float:
    """Root mean square difference [px] of positions (M, 2) and rest positions, after a similarity transform."""
    before, after = ((item - item.mean(axis=0)) @ [1.0, 1j] for item in (rest, positions))
    residual = after - before * np.vdot(before, after) / np.vdot(before, before)
    return float(np.sqrt((np.abs(residual) ** 2).mean()))


def _median_discs(positions: Array, parameters: Array) -> Array:
    """Initial parameters (D, 12) of discs at positions (D, 2), with the known markers' median shape and contrast."""
    median = np.nanmedian(parameters, axis=0)
    return initial_parameters_at(positions, median[2:5], median[8], median[9])


def _moved_discs(parameters: Array, positions: Array) -> Array:
    """The discs' parameters (D, 12) with the centres moved to positions (D, 2)."""
    return np.concatenate([positions, parameters[:, 2:]], axis=1)
