"""Tracking one camera's markers from frame to frame.

A dot found where the motion so far predicts a marker is that marker's dot. Where the motion cannot be predicted, all
dots are matched to the markers at once by their pattern. A marker that reappears is accepted only if its dot can belong
to no other marker. The shape prior predicts its position and the sigma of that.
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
from rafl.tracking.linking.late_markers import LateMarker, LateMarkerFinder
from rafl.tracking.linking.matching import MarkerPattern, match_markers
from rafl.tracking.linking.motion_prediction import MotionPredictor
from rafl.tracking.linking.reidentification import reidentify, unambiguous_dots
from rafl.tracking.linking.shape_prior import PredictedPosition, ShapePrior
from rafl.tracking.linking.static_dots import StaticDots

Array = NDArray[Any]

# "Prediction error" below: root mean square, of the best prediction order (`MotionPredictor`).
MAX_RELIABLE_ERROR = 0.22  # prediction error up to which the dot at a predicted position is that marker's [spacings]
PREDICTION_GATE = 0.33  # most distance of a marker's own dot from its predicted position [spacings]
SEED_REACH = 2.2  # most distance of a marker from its expected position in a search [spacings]
MIN_UNAMBIGUOUS_SHARE = 0.7  # of the body's markers: with fewer unambiguous matches, `reidentify` decides
MAX_ANCHOR_ERROR = 0.5  # prediction error up to which visible markers are not exchanged for others [spacings]
# A reappearing marker with an unambiguous match is identified at once if its predicted position had at most this sigma
# [spacings].
MAX_REAPPEARING_SIGMA = 2.0
INITIAL_MOTION_CONFIDENCE = 0.5  # 0 to 1: that markers stay near their last positions, before any motion is known
MIN_SHAPES = 6  # with fewer shapes, the shape prior is not relied on
MAX_EXTRAPOLATED_FRAMES = 3  # for which a hidden marker's own motion still predicts its position
SIGMA_GROWTH = 1.5  # factor per frame on the sigma of a hidden marker's predicted position
# A hidden marker is searched again at the position predicted from the others if that is this far from its expected
# position [radii], and has at most this sigma [spacings].
MIN_SHIFT_RADII, MAX_SHIFTED_SIGMA = 0.3, 0.3
# A dot with a larger misfit [share of the contrast] is fitted again from the median disc, in a marker's first frames.
MAX_YOUNG_MISFIT, YOUNG_FRAMES = 0.1, 8
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
        self.static_dots = StaticDots(len(first))
        self.frames_missing = np.zeros(len(first), dtype=np.int64)  # since each marker was last visible
        self.sigma = np.zeros(len(first))  # sigma of each marker's position; 0 if identified [px]
        self.frames_since_search = 0
        self.late_markers = LateMarkerFinder(appearance, np.zeros(len(first)))
        self.frame_count = 0  # tracked so far
        self.first_frame = np.zeros(len(first), dtype=np.int64)  # `frame_count` when each marker was added
        self.starts_from_median = np.zeros(len(first), bool)  # markers whose own last disc is a bad start of fits

    def advance(self, image: Array) -> Dots:
        """The markers' dots (M) in the next frame; sigma is NaN where a marker is not visible."""
        self.frame_count += 1
        guess = self._predict_by_motion()
        identified, expected = self._visible_on_body() & (self.sigma == 0.0), guess.position
        if not (identified | self.static_dots.mask).all():
            expected = self._predict_from(expected, identified, guess).position
        dots, unambiguous = None, np.zeros(len(expected), bool)
        if self.motion.errors.min() < MAX_RELIABLE_ERROR:
            dots = self._fit_at_expected(image, expected)
        self.frames_since_search += 1
        if dots is None or not self._none_lost(dots) or self.frames_since_search >= self._search_interval():
            found, unambiguous = self._search(image, expected)
            if dots is None or np.isfinite(found.sigma[:, 0]).sum() > np.isfinite(dots.sigma[:, 0]).sum():
                dots = found
            else:
                distance = np.linalg.norm(found.centre - dots.centre, axis=1)
                unambiguous &= distance < MIN_SEPARATION_RADII * self.appearance.radius
            self.frames_since_search = 0
        if self.frames_missing.any():
            dots = _restrict(dots, self._identify(dots, unambiguous, guess))
            dots = self._fit_at_shifted(image, dots, expected, guess)
            dots = _restrict(dots, self._identify(dots, unambiguous, guess))
        dots = _restrict(dots, dots.within(image))
        self._update(dots, unambiguous, guess)
        return dots

    def skip_frame(self) -> None:
        """Advance by a frame that could not be decoded."""
        guess, none = self._predict_by_motion(), np.zeros(len(self.frames_missing), bool)
        positions, self.sigma = self._predict_from(guess.position, none, guess)
        self.motion.add_frame(positions, none)
        self.frames_missing += 1

    def add_late_markers(self, number: int, image: Array) -> list[LateMarker]:
        """The markers detected late in this frame, which are tracked from now on. Call after `advance`."""
        visible, static = self.frames_missing == 0, self.static_dots.mask
        found = self.late_markers.find(number, image, self.motion.last, visible, static, self.pattern, self.parameters)
        for marker in found:
            self.prior = self.prior.with_marker(marker.rest)
            self.motion.add_marker(self._last_positions(marker, number))
            self.static_dots.add_marker()
            self.starts_from_median = np.append(self.starts_from_median, False)
            self.first_frame = np.append(self.first_frame, self.frame_count)
            self.pattern = MarkerPattern.of(np.concatenate([self.pattern.rest, marker.rest[None]]))
            self.parameters = np.concatenate([self.parameters, marker.parameters[None]])
            self.frames_missing = np.append(self.frames_missing, 0 if number in marker.seen else 1)
            sigma = 0.0 if number in marker.seen else float(np.median(self.pattern.spacing))
            self.sigma = np.append(self.sigma, sigma)
        return found

    def _last_positions(self, marker: LateMarker, number: int) -> Array:
        """A late marker's positions in the last frames [px], (4, 2), predicted from the others where it was hidden."""
        known, last = np.append(~self.static_dots.mask, False), []
        for frame, others in enumerate(self.motion.positions, start=number + 1 - len(self.motion.positions)):
            predicted = self.prior.predict(np.append(others, marker.rest[None], axis=0), known).position[-1]
            last.append(marker.seen[frame][0] if frame in marker.seen else predicted)
        return np.array(last)

    def _none_lost(self, dots: Dots) -> bool:
        """Whether the dots show all markers that were visible in the frame before; False if none were."""
        wanted = self.frames_missing == 0
        return bool(wanted.any()) and not np.isnan(dots.sigma[wanted]).any()

    def _search_interval(self) -> float:
        """Most frames between two searches."""
        return SEARCH_INTERVAL if self.frames_missing.any() else np.inf

    def _predict_by_motion(self) -> PredictedPosition:
        """The markers' positions in the next frame, from their own motion."""
        sigma = min(float(self.motion.errors.min()), 1.0) * self.pattern.spacing
        if self.sigma.any():
            recent = self.frames_missing <= MAX_EXTRAPOLATED_FRAMES
            sigma = np.where(recent, np.hypot(SIGMA_GROWTH * self.sigma, sigma), np.inf)
        return PredictedPosition(self.motion.predict(), sigma)

    def _visible_on_body(self) -> NDArray[np.bool_]:
        """The markers on the body that were visible in the frame before, (M)."""
        visible: NDArray[np.bool_] = (self.frames_missing == 0) & ~self.static_dots.mask
        return visible

    def _anchors(self) -> NDArray[np.bool_]:
        """The markers that were visible and move as predicted, so that they are not exchanged for others, (M)."""
        reliable = self.motion.errors.min() < MAX_ANCHOR_ERROR or len(self.prior) < MIN_SHAPES
        anchors: NDArray[np.bool_] = (self.frames_missing == 0) & (
            self.static_dots.mask | (reliable & (self.sigma == 0.0))
        )
        return anchors

    def _frames_hidden(self) -> int:
        """Frames since any marker of the body was visible."""
        return int(self.frames_missing[~self.static_dots.mask].min())

    def _predict_from(self, positions: Array, known: NDArray[np.bool_], guess: PredictedPosition) -> PredictedPosition:
        """All markers' positions, predicted from the known ones. Static dots stay at rest.

        Args:
            positions: of the known markers [px], (M, 2).
            known: which these are, (M).
            guess: the prediction from the markers' own motion.
        """
        static = self.static_dots.mask
        if not (known & ~static).any() and np.isinf(guess.sigma[~static]).all():
            return PredictedPosition(self.motion.last, np.full(len(known), np.inf))
        predicted, sigma = self.prior.predict(positions, known & ~static, guess)
        predicted[static] = np.where(known[static, None], positions[static], self.pattern.rest[static])
        sigma[static] = 0.0
        return PredictedPosition(predicted, sigma)

    def _fit_at_expected(self, image: Array, expected: Array) -> Dots | None:
        """The dots fitted at the expected positions (M, 2); None if too few of them belong to their markers."""
        start = self.parameters.copy()
        start[:, :2] = expected
        if self.starts_from_median.any():
            start[self.starts_from_median] = self._median_discs(expected[self.starts_from_median])
        dots = fit_dots(image, start)
        if self.frame_count < self.first_frame[-1] + YOUNG_FRAMES:
            dots = self._refit_from_median(image, dots, start)
        good = self.appearance.matches(dots)
        separation = MIN_SEPARATION_RADII * self.appearance.radius
        reliable = _select_own_dots(
            dots.parameters, self.parameters, expected, self._visible_on_body(), self.pattern.spacing, separation, good
        )
        return _restrict(dots, good) if reliable else None

    def _refit_from_median(self, image: Array, dots: Dots, start: Array) -> Dots:
        """The dots, those with a large misfit replaced by fits from the median disc where these have a smaller one.

        A marker's own last disc may mistake the edge of its sticker, or a strip of specular highlight, for its blur. A
        fit from it may then jump. The replaced markers are fitted from the median disc from now on.
        """
        young = self.frame_count < self.first_frame + YOUNG_FRAMES
        good = self.appearance.matches(dots) & (dots.misfit < MAX_YOUNG_MISFIT)
        bad = np.flatnonzero(self._visible_on_body() & young & ~self.starts_from_median & ~good)
        if not len(bad):
            return dots
        starts = np.concatenate([self._median_discs(start[bad, :2]), np.delete(start, bad, axis=0)])
        found = fit_dots(image, starts, len(bad))
        better = self.appearance.matches(found) & ~(found.misfit > dots.misfit[bad])
        self.starts_from_median[bad[better]] = True
        return _replace_rows(dots, bad[better], found[better])

    def _median_discs(self, positions: Array) -> Array:
        """Initial parameters (D, 12) of discs with the markers' median shape and contrast at positions (D, 2)."""
        shape, level = np.median(self.parameters[:, 2:5], axis=0), float(np.median(self.parameters[:, 9]))
        return initial_parameters_at(positions, shape, self.appearance.contrast, level)

    def _search(self, image: Array, expected: Array) -> tuple[Dots, NDArray[np.bool_]]:
        """Match all dots near the body to the markers at once.

        Returns:
            The markers' dots, and which of them can belong to no other marker, (M).
        """
        hidden = self._frames_hidden()
        widening = 1.0 + 0.3 * min(hidden, 10)
        margin = (SEED_REACH + 1.0) * float(np.median(self.pattern.spacing)) + 2.0 * self.appearance.radius
        margin *= widening
        low, high = expected.min(0) - margin, expected.max(0) + margin
        region = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        min_contrast = self.appearance.min_blob_contrast(float(np.nanmin(np.abs(self.parameters[:, 8]))))
        blobs = find_blobs(image, self.appearance.radius, min_contrast, region)
        dots = fit_dots(image, self._median_discs(blobs))
        dots = remove_duplicates(dots[self.appearance.matches(dots)], MIN_SEPARATION_RADII * self.appearance.radius)
        speed = np.linalg.norm(expected - self.motion.last, axis=1) / self.pattern.spacing
        confidence = -speed - 0.2 * np.minimum(self.frames_missing, 10)
        error = float(self.motion.errors.min())
        motion_confidence = (
            0.0 if hidden else 1.0 / (1.0 + (2.0 * error) ** 2) if np.isfinite(error) else INITIAL_MOTION_CONFIDENCE
        )
        steady_bonus = np.zeros(len(expected))
        if (self.frames_missing > 0).any() and error < MAX_RELIABLE_ERROR:  # so that no hidden marker takes their dots
            steady_bonus[self.frames_missing == 0] = 1.0 - error / MAX_RELIABLE_ERROR
        match, unambiguous = match_markers(
            self.pattern,
            self.motion.last,
            expected,
            confidence,
            dots.centre,
            SEED_REACH * widening,
            motion_confidence,
            steady_bonus,
            self._anchors(),
            self.static_dots.mask,
        )
        on_body = (match >= 0) & ~self.static_dots.mask
        if unambiguous.sum() < MIN_UNAMBIGUOUS_SHARE * (~self.static_dots.mask).sum():
            unambiguous = (match >= 0) & self._anchors()
            if (on_body & ~unambiguous).any() and len(dots):
                confirmed = np.where(unambiguous, match, -1)
                match, unambiguous = reidentify(self.prior, dots.centre, confirmed, self.pattern.spacing)
        chosen = dots[np.maximum(match, 0)] if len(dots) else Dots.missing(len(match))
        return _restrict(chosen, match >= 0), unambiguous

    def _fit_at_shifted(self, image: Array, dots: Dots, expected: Array, guess: PredictedPosition) -> Dots:
        """The dots, with those of hidden markers that the visible ones predict elsewhere than expected."""
        shown = np.isfinite(dots.sigma[:, 0])
        if shown.all() or not (shown & ~self.static_dots.mask).any():
            return dots
        predicted, sigma = self._predict_from(dots.centre, shown, guess)
        shifted = np.linalg.norm(predicted - expected, axis=1) > MIN_SHIFT_RADII * self.appearance.radius
        known = sigma < MAX_SHIFTED_SIGMA * self.pattern.spacing
        tried = np.flatnonzero(~shown & ~self.static_dots.mask & shifted & known)
        if not len(tried):
            return dots
        starts = np.concatenate([self.parameters[tried], dots.parameters[shown]])
        starts[: len(tried), :2] = predicted[tried]
        found = fit_dots(image, starts, len(tried))
        gap = np.linalg.norm(found.centre[:, None] - dots.centre[shown], axis=2).min(axis=1)
        good = self.appearance.matches(found) & (gap > MIN_SEPARATION_RADII * self.appearance.radius)
        return _replace_rows(dots, tried[good], found[good])

    def _identify(self, dots: Dots, unambiguous: NDArray[np.bool_], guess: PredictedPosition) -> NDArray[np.bool_]:
        """The visible markers whose dots can belong to no other marker, (M).

        These are the anchors and the markers with an unambiguous match. Others are added one after the other, if their
        dot is unambiguous given the position predicted from those identified so far.
        """
        shown = np.isfinite(dots.sigma[:, 0])
        identified = shown & (self._anchors() | unambiguous)
        while (shown & ~identified).any():
            predicted = self._predict_from(dots.centre, identified, guess)
            tried = np.flatnonzero(shown & ~identified)
            clear = unambiguous_dots(predicted, dots.centre, tried, ~identified, self.pattern.spacing)
            if not clear.any():
                break
            identified[tried[clear]] = True
        return identified

    def _update(self, dots: Dots, unambiguous: NDArray[np.bool_], guess: PredictedPosition) -> None:
        """Update the motion, the shape prior and the static dots from the frame's dots."""
        seen, positions = np.isfinite(dots.sigma[:, 0]), dots.centre
        still_visible = seen & self._visible_on_body()
        self.motion.update_errors(positions, still_visible, self.pattern.spacing)
        reappeared = seen & (self.frames_missing > 0)
        if seen.all() and not reappeared.any():
            self.sigma = np.zeros(len(seen))
        else:
            was_known = self.sigma < MAX_REAPPEARING_SIGMA * self.pattern.spacing
            uncertain = reappeared & ~(unambiguous & was_known)
            sigma_of_seen = np.where(uncertain, np.minimum(self.sigma, self.pattern.spacing), 0.0)
            positions, sigma = self._predict_from(positions, seen, guess)
            self.sigma = np.where(seen, sigma_of_seen, sigma)
        self.static_dots.update(positions, seen, self.pattern)
        body = ~self.static_dots.mask
        if 2 * (seen & body).sum() > body.sum():
            self.prior.add_shape(self.prior.predict(positions, seen & body).position, seen)
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
