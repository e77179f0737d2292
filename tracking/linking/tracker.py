"""Tracking one camera's markers from frame to frame.

A dot found where the motion so far predicts a marker is that marker's dot. Where the motion cannot be predicted, and
where markers reappear, all dots near the body are assigned to the markers at once (`assignment`). A marker that may
have one of several dots is missing in that frame. A body of which less than half is found is sought in the shapes that
it has shown so far.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rafl.tracking.detection.appearance import MarkerAppearance
from rafl.tracking.detection.detect import (
    MIN_SEPARATION_RADII,
    RELATIVE_CONTRAST_TOLERANCE,
    Dots,
    find_blobs,
    fit_dots,
    initial_parameters_at,
    relative_contrast,
    remove_duplicates,
)
from rafl.tracking.linking.assignment import assign_dots
from rafl.tracking.linking.late_markers import LateMarker, LateMarkerFinder
from rafl.tracking.linking.matching import MarkerPattern
from rafl.tracking.linking.motion_prediction import MotionPredictor
from rafl.tracking.linking.shape_prior import Belief, ShapePrior
from rafl.tracking.linking.static_dots import StaticDots

Array = NDArray[Any]

# "Prediction error" below: root mean square, of the best prediction order (`MotionPredictor`).
MAX_RELIABLE_ERROR = 0.22  # prediction error up to which the dot at a predicted position is that marker's [spacings]
MAX_CONFIRMED_ERROR = 0.1  # the same where some markers are not at their predicted positions [spacings]
PREDICTION_GATE = 0.33  # most distance of a marker's own dot from its predicted position [spacings]
# Standard deviation of the predicted positions, common to all markers [spacings]. The error so far says little
# about the next frame, in which a body may be hit. Before any motion is known, most bodies are near rest. Both were
# chosen on rendered bending beams: as first sigma, 0.12 gave one of 40 fast beams a wrong identity, and 0.3 lost those
# of which a third was hidden from the second frame on.
MOTION_SIGMA, FIRST_MOTION_SIGMA = 0.2, 0.15
SEARCH_SIGMAS = 3.0  # dots are searched within this many sigmas of the markers' expected positions
STATIC_SIGMA = 0.03  # of a static dot's position about its first one [spacings]
MAX_EXTRAPOLATED_FRAMES = 3  # for which a hidden marker's own motion still predicts its position
SIGMA_GROWTH = 1.5  # factor per frame on the sigma of a hidden marker's predicted position
# If most markers are missing, so many of the shapes seen so far are tried, each with errors of this sigma [spacings].
MAX_RECALLED_SHAPES, RECALLED_SIGMA = 16, 0.2
SEARCH_INTERVAL = 4  # frames between searches for hidden markers


class Tracker:
    """Tracks the markers of one camera from frame to frame."""

    def __init__(self, appearance: MarkerAppearance, first: Dots) -> None:
        """Start from the markers' appearance and their dots (M) in the first frame."""
        self.appearance = appearance
        self.pattern = MarkerPattern.of(first.centre)
        self.parameters = first.parameters.copy()
        self.motion = MotionPredictor(first.centre)
        self.prior = ShapePrior(first.centre)
        self.prior.add_shape(first.centre, np.ones(len(first), bool))
        self.static_dots = StaticDots(len(first))
        self.frames_missing = np.zeros(len(first), dtype=np.int64)  # since each marker was last visible
        self.sigma = np.zeros(len(first))  # sigma of each marker's position; 0 if identified [px]
        self.frames_since_search = 0
        self.late_markers = LateMarkerFinder(appearance, np.zeros(len(first)))

    def advance(self, image: Array) -> Dots:
        """The markers' dots (M) in the next frame; sigma is NaN where a marker is not visible."""
        all_visible = (self._visible_on_body() | self.static_dots.mask).all()
        belief = None if all_visible else self._predict_next()  # it takes time, and a search may not be needed
        dots = Dots.missing(len(self.sigma))
        if self.motion.errors.min() < MAX_RELIABLE_ERROR:
            dots = self._fit_at_expected(image, self.motion.predict() if belief is None else belief.position)
        visible, shown = self.frames_missing == 0, np.isfinite(dots.sigma[:, 0])
        self.frames_since_search += 1
        none_lost = bool(visible.any() and shown[visible].all())
        if not none_lost or (shown & ~visible).any() or self.frames_since_search >= self._interval():
            # A body that hardly moved in the first frame may start to move: only predictions by velocity tell.
            reliable = none_lost or self.motion.errors[1:].min() < MAX_CONFIRMED_ERROR
            own, body = _restrict(dots, visible & reliable), ~self.static_dots.mask
            lost = (self.frames_missing[body] > MAX_EXTRAPOLATED_FRAMES).all()
            found = own if lost else self._search(image, [belief or self._predict_next()], own)
            separation = MIN_SEPARATION_RADII * self.appearance.radius
            same = shown & (np.linalg.norm(found.centre - dots.centre, axis=1) < separation)
            rows = np.flatnonzero(same & np.isfinite(found.sigma[:, 0]))
            dots = _replace_rows(found, rows, dots[rows])  # fits that start from the marker's own disc are better
            self.frames_since_search = 0
            if not self._mostly_seen(dots):
                dots = self._recall(image, dots)
        dots = _restrict(dots, dots.within(image))
        self._update(dots)
        return dots

    def skip_frame(self) -> None:
        """Advance by a frame that could not be decoded."""
        belief = self._predict_next()
        positions, self.sigma = belief.position, belief.sigma
        self.motion.add_frame(positions, np.zeros(len(positions), bool))
        self.frames_missing += 1

    def add_late_markers(self, number: int, image: Array) -> list[LateMarker]:
        """The markers detected late in this frame, which are tracked from now on. Call after `advance`."""
        visible, static = self.frames_missing == 0, self.static_dots.mask
        found = self.late_markers.find(number, image, self.motion.last, visible, static, self.pattern, self.parameters)
        for marker in found:
            self.prior = self.prior.with_marker(marker.rest)
            self.motion.add_marker(self._last_positions(marker, number))
            self.static_dots.add_marker()
            self.pattern = MarkerPattern.of(np.concatenate([self.pattern.rest, marker.rest[None]]))
            self.parameters = np.concatenate([self.parameters, marker.parameters[None]])
            self.frames_missing = np.append(self.frames_missing, 0 if number in marker.seen else 1)
            sigma = 0.0 if number in marker.seen else float(np.median(self.pattern.spacing))
            self.sigma = np.append(self.sigma, sigma)
        return found

    def _last_positions(self, marker: LateMarker, number: int) -> Array:
        """A late marker's positions in the last frames [px], (4, 2), predicted from the others where it was hidden."""
        sigma, last = np.append(np.where(self.static_dots.mask, np.inf, 0.0), np.inf), []
        for frame, others in enumerate(self.motion.positions, start=number + 1 - len(self.motion.positions)):
            predicted = self.prior.predict(np.append(others, marker.rest[None], axis=0), sigma).position[-1]
            last.append(marker.seen[frame][0] if frame in marker.seen else predicted)
        return np.array(last)

    def _interval(self) -> float:
        """Most frames between two searches."""
        return SEARCH_INTERVAL if self.frames_missing.any() else np.inf

    def _motion_sigma(self) -> Array:
        """Standard deviation of the positions predicted from the markers' own motion [px], (M)."""
        known = np.isfinite(self.motion.errors).any()
        sigma = (MOTION_SIGMA if known else FIRST_MOTION_SIGMA) * self.pattern.spacing
        recent = self.frames_missing <= MAX_EXTRAPOLATED_FRAMES
        return np.where(recent, np.hypot(SIGMA_GROWTH * self.sigma, sigma), np.inf)

    def _predict_next(self) -> Belief:
        """The belief about the next frame. Markers that were visible are expected where their motion leads."""
        positions = self.motion.predict()
        belief = self._predict_from(positions, self._motion_sigma())
        own = self._visible_on_body()
        return Belief(np.where(own[:, None], positions, belief.position), belief.covariance)

    def _mostly_seen(self, dots: Dots) -> bool:
        """Whether the dots show at least half of the markers on the body."""
        body = ~self.static_dots.mask
        return bool(2 * np.isfinite(dots.sigma[body, 0]).sum() >= body.sum())

    def _recall(self, image: Array, dots: Dots) -> Dots:
        """The dots of a body in one of the shapes seen so far, if they show most of it; else the given dots.

        Most of the body may be hidden, or the identities lost or wrong. The dots do not tell which until half of them
        are there again.
        """
        sigma = RECALLED_SIGMA * self.pattern.spacing
        beliefs = [self._predict_from(shape, sigma) for shape in self.prior.sample_shapes(MAX_RECALLED_SHAPES)]
        found = self._search(image, beliefs, Dots.missing(len(dots)))
        if not self._mostly_seen(found):
            return dots
        self.frames_missing[:] = np.maximum(self.frames_missing, 1)  # their motion so far may be that of others
        return found

    def _visible_on_body(self) -> NDArray[np.bool_]:
        """The markers on the body that were visible in the frame before, (M)."""
        visible: NDArray[np.bool_] = (self.frames_missing == 0) & ~self.static_dots.mask
        return visible

    def _predict_from(self, positions: Array, sigma: Array) -> Belief:
        """The belief about all markers, from positions [px], (M, 2), and their sigma [px], (M).

        See `ShapePrior.predict`. Static dots stay at rest, whatever the body does.
        """
        static = self.static_dots.mask
        belief = self.prior.predict(positions, np.where(static, np.inf, sigma))
        if static.any():
            rows = np.flatnonzero(np.repeat(static, 2))
            belief.position[static] = np.where(
                (sigma == 0.0)[static, None], positions[static], self.pattern.rest[static]
            )
            belief.covariance[rows], belief.covariance[:, rows] = 0.0, 0.0
            belief.covariance[rows, rows] = np.repeat(
                np.where(sigma == 0.0, 0.0, STATIC_SIGMA * self.pattern.spacing)[static] ** 2, 2
            )
        return belief

    def _fit_at_expected(self, image: Array, expected: Array) -> Dots:
        """The dots fitted at the expected positions (M, 2); none if too few of them belong to their markers."""
        start = self.parameters.copy()
        start[:, :2] = expected
        dots = fit_dots(image, start)
        good = self.appearance.matches(dots)
        separation = MIN_SEPARATION_RADII * self.appearance.radius
        reliable = _select_own_dots(
            dots.parameters, self.parameters, expected, self._visible_on_body(), self.pattern.spacing, separation, good
        )
        return _restrict(dots, good & reliable)

    def _median_discs(self, positions: Array) -> Array:
        """Initial parameters (D, 12) of discs with the markers' median shape and contrast at positions (D, 2)."""
        shape, level = np.median(self.parameters[:, 2:5], axis=0), float(np.median(self.parameters[:, 9]))
        return initial_parameters_at(positions, shape, self.appearance.contrast, level)

    def _search(self, image: Array, beliefs: list[Belief], own: Dots) -> Dots:
        """The dots of the markers, by an assignment of all dots near the body. `own` are those known already, (M)."""
        expected = np.array([belief.position for belief in beliefs])
        margin = (
            SEARCH_SIGMAS * np.array([belief.sigma for belief in beliefs])[..., None] + 2.0 * self.appearance.radius
        )
        low, high = (expected - margin).min(axis=(0, 1)), (expected + margin).max(axis=(0, 1))
        bounds = np.concatenate([np.maximum(low, 0.0), np.minimum(high, image.shape[1::-1])]).astype(int)
        min_contrast = self.appearance.min_blob_contrast(float(np.nanmin(np.abs(self.parameters[:, 8]))))
        blobs = find_blobs(image, self.appearance.radius, min_contrast, tuple(bounds.tolist()))
        dots = fit_dots(image, self._median_discs(blobs))
        separation = MIN_SEPARATION_RADII * self.appearance.radius
        dots = remove_duplicates(dots[self.appearance.matches(dots)], separation)
        known = np.flatnonzero(np.isfinite(own.sigma[:, 0]))
        if len(known):
            gap = np.linalg.norm(dots.centre[:, None] - own.centre[known], axis=2)
            dots = dots[gap.min(axis=1) > separation].extended_by(own[known])
        if not len(dots):
            return own
        confirmed = np.full(len(own), -1)
        confirmed[known] = len(dots) - len(known) + np.arange(len(known))
        spacing = float(np.median(self.pattern.spacing))
        match, certain = assign_dots(beliefs, dots.centre, dots.sigma.max(axis=1), confirmed, self.motion.last, spacing)
        return _restrict(dots[np.maximum(match, 0)], certain)

    def _update(self, dots: Dots) -> None:
        """Update the motion, the shape prior and the static dots from the frame's dots."""
        seen, positions = np.isfinite(dots.sigma[:, 0]), dots.centre
        still_visible, reappeared = seen & self._visible_on_body(), seen & (self.frames_missing > 0)
        guess, guess_sigma = self.motion.predict(), self._motion_sigma()
        self.motion.update_errors(positions, still_visible, self.pattern.spacing)
        if seen.all():
            self.sigma = np.zeros(len(seen))
        else:
            belief = self._predict_from(np.where(seen[:, None], positions, guess), np.where(seen, 0.0, guess_sigma))
            positions, self.sigma = belief.position, belief.sigma
        self.static_dots.update(positions, seen, self.pattern)
        body = ~self.static_dots.mask
        if 2 * (seen & body).sum() > body.sum():
            sigma = np.where(seen & body, 0.0, np.inf)
            self.prior.add_shape(self.prior.predict(positions, sigma).position, seen)
        if reappeared.any() and not still_visible.any():
            self.motion.reset()
        self.motion.add_frame(positions, reappeared)
        self.frames_missing = np.where(seen, 0, self.frames_missing + 1)
        self.parameters[seen] = dots.parameters[seen]


def _replace_rows(dots: Dots, rows: NDArray[np.int64], others: Dots) -> Dots:
    """The dots, with those in the given rows (K) replaced by the others (K)."""
    chosen = np.arange(len(dots))
    chosen[rows] = len(dots) + np.arange(len(rows))
    return dots.extended_by(others)[chosen]


@njit(cache=True)
def _select_own_dots(
    parameters: Array,
    before: Array,
    expected: Array,
    visible: NDArray[np.bool_],
    spacing: Array,
    separation: float,
    good: NDArray[np.bool_],
) -> bool:
    """Whether most dots are near their expected positions. Clears `good` for dots that are not their marker's own.

    Args:
        parameters: of the dots' discs, (M, 12).
        before: parameters in the frame before, (M, 12).
        expected: positions [px], (M, 2).
        visible: markers of the body that were visible in the frame before, (M).
        spacing: of the markers [px], (M).
        separation: distance below which two dots are the same one [px].
        good: dots that look like markers; changed, (M).
    """
    count = len(good)
    centre = parameters[:, :2]
    seen = near = 0
    for k in range(count):
        distance = np.hypot(centre[k, 0] - expected[k, 0], centre[k, 1] - expected[k, 1]) / spacing[k]
        change = parameters[k, 8] / before[k, 8]
        if good[k] and not 0.5 < change < 2.0:  # allowed only if the light has changed by as much
            now, earlier = (
                relative_contrast(parameters[k, 8], parameters[k, 9]),
                relative_contrast(before[k, 8], before[k, 9]),
            )
            good[k] = change > 0.0 and abs(np.log(now / earlier)) < RELATIVE_CONTRAST_TOLERANCE
        good[k] = good[k] and distance < PREDICTION_GATE
        if good[k] and visible[k]:
            seen += 1
            near += distance < MAX_RELIABLE_ERROR
    if 2 * near < seen or seen == 0:
        return False
    shared = np.zeros(count, np.bool_)
    for k in range(count):
        for other in range(k):
            if good[k] and good[other]:
                x, y = centre[k, 0] - centre[other, 0], centre[k, 1] - centre[other, 1]
                if x * x + y * y < separation * separation:
                    shared[k] = shared[other] = True
    good &= ~shared
    return True


def _restrict(dots: Dots, kept: NDArray[np.bool_]) -> Dots:
    """The dots, with sigma NaN where they are not kept."""
    if kept.all():
        return dots
    return replace(dots, sigma=np.where(kept[:, None], dots.sigma, np.nan))
