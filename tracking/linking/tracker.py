"""Following one camera's markers from picture to picture.

A dot that is found where the motion so far puts a marker is that marker's. Where the motion does not tell, all dots are
matched to the markers at once by the pattern that these form. Who was out of sight and comes back is taken for itself
only where its dot can be no other's: the shapes seen so far say where it must be, and how well that is known.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rafl.tracking.detection.appearance import Family
from rafl.tracking.detection.detect import SAME_PLACE, SHADES, Dots, apart, find_spots, fit_dots, shade_of, starts_at
from rafl.tracking.detection.partial_occlusion import Outlines
from rafl.tracking.detection.truncated import WholeLooks
from rafl.tracking.linking.late_markers import Newcomer, Newcomers
from rafl.tracking.linking.matching import Pattern, recognise
from rafl.tracking.linking.motion_prediction import Motion
from rafl.tracking.linking.reidentification import recalled, unmistakable
from rafl.tracking.linking.shape_prior import Belief, Memory
from rafl.tracking.linking.static_dots import Marks

Array = NDArray[Any]

CALM = 0.22  # spacings: surprise up to which the dot at a marker's predicted place is its own
STRAY = 0.33  # spacings: how far from its prediction a dot found there may be
SEED_REACH = 2.2  # spacings: how far from where it is expected a marker may be
ENOUGH = 0.7  # of the markers, of which the pattern alone tells which they are
ANCHORED = 0.5  # spacings: surprise up to which a marker in sight is not taken for another
LOST = 2.0  # spacings: where its place was known worse than this, nobody knows how a marker that is back moves
UNTOLD = 0.5  # of 1: how sure it is that markers are near where they were, where nobody knows yet how they move
FEW_SHAPES = 6  # remembered, by which nothing is told
FRESH = 3  # frames out of sight, over which a marker's own motion still tells where it is
STRAYING = 1.5  # so many times as uncertain as where a marker is believed is where it will be next
ELSEWHERE, TOLD = 0.3, 0.3  # radii from where it was expected, and spacings to which that is known, to look again
# Misfit, of the contrast, from which a dot's own last look is doubted, and in how many pictures after it is known.
ODD, YOUNG = 0.1, 8
RECHECK = 4  # frames between searches for markers out of sight


class Tracker:
    """Follows the markers of one camera from picture to picture."""

    def __init__(self, family: Family, first: Dots) -> None:
        self.family = family
        self.pattern = Pattern.of(first.centre)
        self.parameters = first.parameters.copy()
        self.motion = Motion(first.centre)
        self.memory = Memory(first.centre)
        self.marks = Marks(len(first))
        self.missing = np.zeros(len(first), dtype=np.int64)  # frames since each was seen
        self.doubt = np.zeros(len(first))  # standard deviation of where each is believed [px]
        self.searched = 0  # frames since the last search
        self.newcomers = Newcomers(family, np.zeros(len(first)))
        self.looks = WholeLooks.none(len(first))
        self.pictures = 0  # followed so far
        self.since = np.zeros(len(first), dtype=np.int64)  # how many had been when each was known
        self.misled = np.zeros(len(first), bool)  # by their own last looks: fits start from the usual one
        self.outlines = Outlines(first)

    def advance(self, image: NDArray) -> Dots:
        """The markers' dots (D) in the next picture, sigma NaN where a marker is not seen."""
        self.pictures += 1
        guess = self._guess()
        followed, expected = self._seen() & (self.doubt == 0.0), guess.place
        if not (followed | self.marks.known).all():
            expected = self._carried(expected, followed, guess).place
        dots, agreed = None, np.zeros(len(expected), bool)
        if self.motion.surprise.min() < CALM:
            dots = self._where_expected(image, expected)
        self.searched += 1
        if dots is None or not self._holds(dots) or self.searched >= self._patience():
            found, agreed = self._search(image, expected)
            if dots is None or np.isfinite(found.sigma[:, 0]).sum() > np.isfinite(dots.sigma[:, 0]).sum():
                dots = found
            else:
                agreed &= np.linalg.norm(found.centre - dots.centre, axis=1) < SAME_PLACE * self.family.radius
            self.searched = 0
        if self.missing.any():
            dots = _only(dots, self._undisputed(dots, agreed, guess))
            dots = self._where_the_others_put_them(image, dots, expected, guess)
            dots = _only(dots, self._undisputed(dots, agreed, guess))
        dots = self.looks.judge(image, dots)
        self._learn(dots, agreed, guess)
        return self.outlines.judge(dots, self.pattern.rest)

    def pass_over(self) -> None:
        """A frame that shows nothing."""
        guess, nobody = self._guess(), np.zeros(len(self.missing), bool)
        place, self.doubt = self._carried(guess.place, nobody, guess)
        self.motion.remember(place, nobody)
        self.missing += 1

    def look_out(self, number: int, image: NDArray) -> list[Newcomer]:
        """After `advance`: markers that have become known, followed from now on."""
        found = self.newcomers.look(
            number, image, self.motion.last, self.missing == 0, self.marks.known, self.pattern, self.parameters
        )
        for newcomer in found:
            self.memory = self.memory.join(newcomer.rest)
            self.motion.join(self._lately(newcomer, number))
            self.marks.join()
            self.looks.join()
            self.misled = np.append(self.misled, False)
            self.since = np.append(self.since, self.pictures)
            self.outlines.join()
            self.pattern = Pattern.of(np.concatenate([self.pattern.rest, newcomer.rest[None]]))
            self.parameters = np.concatenate([self.parameters, newcomer.parameters[None]])
            self.missing = np.append(self.missing, 0 if number in newcomer.seen else 1)
            self.doubt = np.append(
                self.doubt, 0.0 if number in newcomer.seen else float(np.median(self.pattern.spacing))
            )
        return found

    def _lately(self, newcomer: Newcomer, number: int) -> Array:
        """Its places in the last pictures [px], (4, 2), where it was not seen as the others put it."""
        known, last = np.append(~self.marks.known, False), []
        for frame, place in enumerate(self.motion.places, start=number + 1 - len(self.motion.places)):
            carried = self.memory.carried(np.append(place, newcomer.rest[None], axis=0), known).place[-1]
            last.append(newcomer.seen[frame][0] if frame in newcomer.seen else carried)
        return np.array(last)

    def _holds(self, dots: Dots) -> bool:
        """Whether all markers that were in sight are among the dots, and some were."""
        wanted = self.missing == 0
        return bool(wanted.any()) and not np.isnan(dots.sigma[wanted]).any()

    def _patience(self) -> float:
        return RECHECK if self.missing.any() else np.inf

    def _guess(self) -> Belief:
        """Where the markers' own motion so far puts them."""
        surprise = min(float(self.motion.surprise.min()), 1.0) * self.pattern.spacing
        if self.doubt.any():
            surprise = np.where(self.missing <= FRESH, np.hypot(STRAYING * self.doubt, surprise), np.inf)
        return Belief(self.motion.expected(), surprise)

    def _seen(self) -> NDArray[np.bool_]:
        """Which markers of the body were in sight."""
        return (self.missing == 0) & ~self.marks.known

    def _anchors(self) -> NDArray[np.bool_]:
        """Which markers were in sight and move as they should, so that they are not taken for others."""
        sure = self.motion.surprise.min() < ANCHORED or len(self.memory) < FEW_SHAPES
        return (self.missing == 0) & (self.marks.known | (sure & (self.doubt == 0.0)))

    def _hidden(self) -> int:
        """Frames since any marker of the body was in sight."""
        return int(self.missing[~self.marks.known].min())

    def _carried(self, place: Array, known: NDArray[np.bool_], guess: Belief) -> Belief:
        """Where the markers are, those known at this place [px], (M, 2), and others where these put them.

        Marks are where they always are.
        """
        marks = self.marks.known
        if not (known & ~marks).any() and np.isinf(guess.sigma[~marks]).all():
            return Belief(self.motion.last, np.full(len(known), np.inf))
        carried, sigma = self.memory.carried(place, known & ~marks, guess)
        carried[marks] = np.where(known[marks, None], place[marks], self.pattern.rest[marks])
        sigma[marks] = 0.0
        return Belief(carried, sigma)

    def _where_expected(self, image: NDArray, expected: Array) -> Dots | None:
        """The dots at the markers' expected places; None where they are not all their own."""
        start = self.parameters.copy()
        start[:, :2] = expected
        if self.misled.any():
            start[self.misled] = self._as_usual(expected[self.misled])
        dots = fit_dots(image, start)
        if self.pictures < self.since[-1] + YOUNG:
            dots = self._without_their_last_looks(image, dots, start)
        good = self.family.admits(dots)
        same = SAME_PLACE * self.family.radius
        calm = _own(dots.parameters, self.parameters, expected, self._seen(), self.pattern.spacing, same, good)
        return _only(dots, good) if calm else None

    def _without_their_last_looks(self, image: NDArray, dots: Dots, start: Array) -> Dots:
        """The dots, odd ones as fits from the usual look find them, where these leave less; which is how they stay.

        A dot's own last look may take the edge of its sticker, or a strip of gloss, for its blur; now and then to start
        from it would make it jump.
        """
        young = self.pictures < self.since + YOUNG
        good = self.family.admits(dots) & (dots.misfit < ODD)
        odd = np.flatnonzero(self._seen() & young & ~self.misled & ~good)
        if not len(odd):
            return dots
        anew = np.concatenate([self._as_usual(start[odd, :2]), np.delete(start, odd, axis=0)])
        found = fit_dots(image, anew, len(odd))
        better = self.family.admits(found) & ~(found.misfit > dots.misfit[odd])
        self.misled[odd[better]] = True
        return _replaced(dots, odd[better], found[better])

    def _as_usual(self, places: Array) -> Array:
        """Starts of fits (D, 12) at places (D, 2): discs of the markers' usual shape, contrast and level."""
        shape, level = np.median(self.parameters[:, 2:5], axis=0), float(np.median(self.parameters[:, 9]))
        return starts_at(places, shape, self.family.contrast, level)

    def _search(self, image: NDArray, expected: Array) -> tuple[Dots, NDArray[np.bool_]]:
        """Every dot near the body, matched to the markers all at once, and which can be no other marker's."""
        hidden = self._hidden()
        uncertain = 1.0 + 0.3 * min(hidden, 10)
        margin = (SEED_REACH + 1.0) * float(np.median(self.pattern.spacing)) + 2.0 * self.family.radius
        margin *= uncertain
        low, high = expected.min(0) - margin, expected.max(0) + margin
        region = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        least = self.family.least(float(np.nanmin(np.abs(self.parameters[:, 8]))))
        spots = find_spots(image, self.family.radius, least, region)
        dots = fit_dots(image, self._as_usual(spots))
        dots = apart(dots[self.family.admits(dots)], SAME_PLACE * self.family.radius)
        speed = np.linalg.norm(expected - self.motion.last, axis=1) / self.pattern.spacing
        trusted = -speed - 0.2 * np.minimum(self.missing, 10)
        surprise = float(self.motion.surprise.min())
        sureness = 0.0 if hidden else 1.0 / (1.0 + (2.0 * surprise) ** 2) if np.isfinite(surprise) else UNTOLD
        steady = np.zeros(len(expected))
        if (self.missing > 0).any() and surprise < CALM:  # who is out of sight could take the place of who is in sight
            steady[self.missing == 0] = 1.0 - surprise / CALM
        reach = SEED_REACH * uncertain
        match, agreed = recognise(
            self.pattern,
            self.motion.last,
            expected,
            trusted,
            dots.centre,
            reach,
            sureness,
            steady,
            self._anchors(),
            self.marks.known,
        )
        body = (match >= 0) & ~self.marks.known
        if agreed.sum() < ENOUGH * (~self.marks.known).sum():
            agreed = (match >= 0) & self._anchors()
            if (body & ~agreed).any() and len(dots):
                sure = np.where(agreed, match, -1)
                match, agreed = recalled(self.memory, dots.centre, sure, self.pattern.spacing)
        chosen = dots[np.maximum(match, 0)] if len(dots) else Dots.none(len(match))
        return _only(chosen, match >= 0), agreed

    def _where_the_others_put_them(self, image: NDArray, dots: Dots, expected: Array, guess: Belief) -> Dots:
        """The dots, and those of markers out of sight that stand where these put them, not where they were expected."""
        shown = np.isfinite(dots.sigma[:, 0])
        if shown.all() or not (shown & ~self.marks.known).any():
            return dots
        place, sigma = self._carried(dots.centre, shown, guess)
        elsewhere = np.linalg.norm(place - expected, axis=1) > ELSEWHERE * self.family.radius
        asked = np.flatnonzero(~shown & ~self.marks.known & elsewhere & (sigma < TOLD * self.pattern.spacing))
        if not len(asked):
            return dots
        starts = np.concatenate([self.parameters[asked], dots.parameters[shown]])
        starts[: len(asked), :2] = place[asked]
        found = fit_dots(image, starts, len(asked))
        gap = np.linalg.norm(found.centre[:, None] - dots.centre[shown], axis=2).min(axis=1)
        good = self.family.admits(found) & (gap > SAME_PLACE * self.family.radius)
        return _replaced(dots, asked[good], found[good])

    def _undisputed(self, dots: Dots, agreed: NDArray[np.bool_], guess: Belief) -> NDArray[np.bool_]:
        """Which markers are seen, and not by dots that could as well be another's.

        Those that were in sight before, or to whose dots the pattern agrees; and of the others, one after the other and
        each a help for the next, those whose dots can be no other's by where these put them.
        """
        shown = np.isfinite(dots.sigma[:, 0])
        sure = shown & (self._anchors() | agreed)
        while (shown & ~sure).any():
            belief = self._carried(dots.centre, sure, guess)
            asked = np.flatnonzero(shown & ~sure)
            clear = unmistakable(belief, dots.centre, asked, ~sure, self.pattern.spacing)
            if not clear.any():
                break
            sure[asked[clear]] = True
        return sure

    def _learn(self, dots: Dots, agreed: NDArray[np.bool_], guess: Belief) -> None:
        seen, place = np.isfinite(dots.sigma[:, 0]), dots.centre
        followed = seen & self._seen()
        self.motion.judge(place, followed, self.pattern.spacing)
        back = seen & (self.missing > 0)
        if seen.all() and not back.any():
            self.doubt = np.zeros(len(seen))
        else:
            unsure = back & ~(agreed & (self.doubt < LOST * self.pattern.spacing))
            doubt = np.where(unsure, np.minimum(self.doubt, self.pattern.spacing), 0.0)
            place, sigma = self._carried(place, seen, guess)
            self.doubt = np.where(seen, doubt, sigma)
        self.marks.look(place, seen, self.pattern)
        body = ~self.marks.known
        if 2 * (seen & body).sum() > body.sum():
            self.memory.add(self.memory.carried(place, seen & body).place, seen)
        if back.any() and not followed.any():
            self.motion.forget()
        self.motion.remember(place, back)
        self.missing = np.where(seen, 0, self.missing + 1)
        self.parameters[seen] = dots.parameters[seen]


def _replaced(dots: Dots, rows: NDArray[np.int64], others: Dots) -> Dots:
    """The dots, others in these rows (K)."""
    chosen = np.arange(len(dots))
    chosen[rows] = len(dots) + np.arange(len(rows))
    return dots.beside(others)[chosen]


@njit(cache=True)
def _own(parameters, before, expected, sought, spacing, same, good):
    """Leaves in good (M) the markers whose own dots these are; False where too few lie near their expected places.

    before: parameters in the picture before. sought: who of the body is likely there. same: distance below which two
    dots are one.
    """
    count = len(good)
    centre = parameters[:, :2]
    seen = near = 0
    for k in range(count):
        away = np.hypot(centre[k, 0] - expected[k, 0], centre[k, 1] - expected[k, 1]) / spacing[k]
        change = parameters[k, 8] / before[k, 8]
        if good[k] and not 0.5 < change < 2.0:  # in changing light only by as much as its surroundings' level
            shade, earlier = shade_of(parameters[k, 8], parameters[k, 9]), shade_of(before[k, 8], before[k, 9])
            good[k] = change > 0.0 and abs(np.log(shade / earlier)) < SHADES
        good[k] = good[k] and away < STRAY
        if good[k] and sought[k]:
            seen += 1
            near += away < CALM
    if 2 * near < seen or seen == 0:
        return False
    shared = np.zeros(count, np.bool_)
    for k in range(count):
        for other in range(k):
            if good[k] and good[other]:
                x, y = centre[k, 0] - centre[other, 0], centre[k, 1] - centre[other, 1]
                if x * x + y * y < same * same:
                    shared[k] = shared[other] = True
    good &= ~shared
    return True


def _only(dots: Dots, good: NDArray[np.bool_]) -> Dots:
    """The same dots, the others' sigma NaN."""
    if good.all():
        return dots
    return replace(dots, sigma=np.where(good[:, None], dots.sigma, np.nan))
