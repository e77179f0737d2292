"""Markers that come into sight after the first frame: from behind a hand, or from outside the picture.

A dot is taken in once it moves, in one look after the other, and stays in its place on the body the while; and where
the last pictures show it there nearly always. What stands still behind the body does neither. Beside a clamp, where
markers stand still too, a dot that was not there at first is taken in where the body's rows go on.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rafl.tracking.detection.appearance import DIM, IN_LINE, LINES, NEXT, Family, breadth_of, lines_through
from rafl.tracking.detection.detect import SAME_PLACE, Dots, apart, find_spots, fit_dots, starts_at
from rafl.tracking.detection.disc_model import PARAMETERS
from rafl.tracking.detection.truncated import doubted
from rafl.tracking.linking.late_marker_candidate import Candidate, Look
from rafl.tracking.linking.matching import NEIGHBOURS, Pattern
from rafl.tracking.linking.shape_prior import Belief, Memory
from scipy.optimize import linear_sum_assignment

Array = NDArray[Any]

# Frames from look to look; where the last one showed a dot that may be one; and where all that it showed keep still.
EVERY, SOON, SELDOM = 3, 2, 12
# Last pictures kept, in which candidates are followed back, and their size together; and while there is no candidate.
KEPT, MOST_BYTES, CALMLY = 60, 2**28, 2
FREE = 0.55  # spacings: how far on the body from known markers there may be another
FAR = 2.4  # breadths: how far from them at most
NEAR = 0.45  # spacings: how far from a candidate the same dot may seem to be at the next look
UNRIVALLED = 2.0  # times as far: likewise, where every other dot and candidate is as many times as far as that
SAME = 0.3  # spacings: how far from where it is expected a dot that is followed back may be
FARTHER, BLUR = 2.0, 0.5  # times as far as between its looks, and px: likewise before its first look
LOST = 2  # pictures before its first look without it, one after the other: there it was not in sight yet
FOUND, LEAST_SEEN = 0.8, 3  # of the pictures since its first look, and how many at least: those that must show it
FEWEST = 3  # markers of the body that tell where on it a dot belongs
PINNED = 0.15  # spacings: how far a dot that keeps its place in the picture may seem to move on the body
JUMP = 0.5  # spacings: how far beside the body's motion no dot goes from picture to picture
HOPPING, RESTING = 0.02, 0.1  # of how far a dot goes in all, and of the body's steps: its steps if it only hops
ALIKE = 1.2  # ratio of radii within a family


@dataclass(frozen=True)
class Newcomer:
    """A marker that came into sight late.

    Attributes:
        rest: where it belongs in the pattern [px], (2).
        sigma: standard deviation of that along x and along y [px].
        parameters: of its disc, (12).
        seen: its place and sigma [px] by frame, up to the present one.
    """

    rest: Array
    sigma: float
    parameters: Array
    seen: dict[int, tuple[Array, Array]]


class _Earlier(NamedTuple):
    """A picture, the known markers' places there [px], (M, 2), and which of these tell of the body, (M)."""

    number: int
    image: NDArray
    place: Array
    body: NDArray[np.bool_]


@dataclass
class Newcomers:
    """Looks out for markers that are not known yet.

    Attributes:
        family: what they look like.
        unsure: standard deviation of where in the pattern each known marker belongs [px], (M).
    """

    family: Family
    unsure: Array
    _candidates: list[Candidate] = field(default_factory=list)
    _due: int = 0  # frame of the next look
    _recent: deque[_Earlier] = field(default_factory=deque)
    _first: NDArray | None = None  # picture

    def look(
        self,
        number: int,
        image: NDArray,
        place: Array,
        seen: NDArray[np.bool_],
        marks: NDArray[np.bool_],
        pattern: Pattern,
        parameters: Array,
    ) -> list[Newcomer]:
        """Markers that have become known.

        Args:
            number: of the frame.
            image: its picture.
            place: of the known markers [px], (M, 2).
            seen: which of them are measured, (M).
            marks: which of them do not ride on the body, (M).
            pattern: of the known markers.
            parameters: of their discs, (M, 12).
        """
        now = _Earlier(number, image, place, seen & ~marks)
        self._recent.append(now)
        self._first = image if self._first is None else self._first
        most = KEPT if self._candidates else CALMLY  # few: decoding is slower in memory that no cache holds
        while len(self._recent) > max(min(most, MOST_BYTES // image.nbytes), 1):
            self._recent.popleft()
        if number < self._due or 2 * now.body.sum() < (~marks).sum():
            return []
        spacing, breadth = float(np.median(pattern.spacing)), breadth_of(pattern.rest[now.body])
        found = self._strangers(image, place, FAR * breadth, 0.5 * FREE * spacing, parameters)
        if not len(found) and not self._candidates:
            self._due = number + EVERY
            return []
        own = self._at_rest(pattern, now, found).place
        near = np.linalg.norm(own[:, None] - pattern.rest[now.body], axis=2).min(axis=1) < FAR * breadth
        self._count(now, own[near], found[near], NEAR * spacing)
        settled = all(item.settled() for item in self._candidates)
        self._due = number + (EVERY if not self._candidates else SELDOM if settled else SOON)
        rest = pattern.rest[~marks]
        ready = [item for item in self._candidates if item.carried() or self._stands(item, rest, parameters, spacing)]
        self._candidates = [item for item in self._candidates if item not in ready]
        newcomers: list[Newcomer] = []
        for item in ready:
            newcomer = self._followed_back(item, pattern, parameters, spacing)
            others = np.concatenate([pattern.rest, *(other.rest[None] for other in newcomers)])
            if newcomer is not None and np.linalg.norm(others - newcomer.rest, axis=1).min() > FREE * spacing:
                newcomers.append(newcomer)
        self.unsure = np.append(self.unsure, [newcomer.sigma for newcomer in newcomers])
        return newcomers

    def _strangers(self, image: NDArray, place: Array, reach: float, free: float, parameters: Array) -> Array:
        """Dots of the family within reach [px] of the body that are no known marker's, so not near one, (D, 2)."""
        low, high = place.min(0) - reach, place.max(0) + reach
        region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        spots = find_spots(image, self.family.radius, self.family.least(self.family.contrast), region, hurried=True)
        away = np.linalg.norm(spots[:, None] - place[None], axis=2).min(axis=1, initial=np.inf)
        strange = spots[away > free]
        if not len(strange):
            return np.empty((0, 2))
        starts = _starts(strange, parameters)
        dots = fit_dots(image, np.concatenate([starts, _moved(parameters, place)]), len(starts))
        return apart(dots[self._admitted(dots)], SAME_PLACE * self.family.radius).centre

    def _admitted(self, dots: Dots) -> NDArray[np.bool_]:
        good = self.family.admits(dots) & (dots.contrast / self.family.contrast > DIM)
        return good & (np.abs(np.log(dots.radius / self.family.radius)) < np.log(ALIKE))

    def _at_rest(self, pattern: Pattern, then: _Earlier, points: Array) -> Belief:
        """Where points (P, 2) of a picture [px] would be in the pattern."""
        if not len(points):
            return Belief(points, np.empty(0))
        body, count = np.flatnonzero(then.body), len(points)
        rest = np.concatenate([pattern.rest[body], points])
        unsure = np.append(self.unsure[body], np.full(count, np.inf))
        memory = Memory(np.concatenate([then.place[body], points]))
        believed = memory.carried(rest, unsure == 0.0, Belief(rest, unsure))
        return Belief(believed.place[-count:], believed.sigma[-count:])

    def _count(self, now: _Earlier, rest: Array, found: Array, most: float) -> None:
        """Candidates that this look does not show are given up; what it shows for the first time becomes one.

        Args:
            now: the picture.
            rest: where the dots would be in the pattern [px], (D, 2).
            found: the dots [px], (D, 2).
            most: how far one may seem to be from where it was before [px], if it has a rival.
        """
        before = self._candidates
        gaps = np.array([[item.gap(*dot) for item in before] for dot in zip(rest, found, strict=True)])
        gaps = gaps.reshape(len(found), len(before))
        pairs = zip(*linear_sum_assignment(np.minimum(gaps, UNRIVALLED * most)), strict=True)
        known = {row: before[column] for row, column in pairs if _matches(gaps, row, column, most)}
        self._candidates = [known.get(row, Candidate()) for row in range(len(found))]
        for item, own, place in zip(self._candidates, rest, found, strict=True):
            item.looks.append(Look(now.number, own, place, now.place))

    def _stands(self, candidate: Candidate, rest: Array, parameters: Array, spacing: float) -> bool:
        """Whether it stands still where the rows of the body at rest (M, 2) go on, and did not at first."""
        if not candidate.still(PINNED * spacing) or candidate.settled() or self._first is None:
            return False
        own, beside = np.median(candidate.rest, axis=0), IN_LINE * spacing
        if np.linalg.norm(rest - own, axis=1).min() > NEXT * breadth_of(rest):
            return False
        least = min(lines_through(place, np.delete(rest, k, axis=0), beside) for k, place in enumerate(rest))
        if lines_through(own, rest, beside) < np.clip(least, 1, LINES):
            return False
        return not self._admitted(fit_dots(self._first, _starts(candidate.place[-1:], parameters)))[0]

    def _followed_back(
        self, candidate: Candidate, pattern: Pattern, parameters: Array, spacing: float
    ) -> Newcomer | None:
        """The candidate in the last pictures; None where too few since its first look show it, or several dots."""
        first = candidate.looks[0].frame
        carried = self._carried_since(pattern.rest, np.median(candidate.rest, axis=0), first)
        if not candidate.rides():  # followed where it is in the picture, not where it seems to be on the body
            carried = dict.fromkeys(carried, np.zeros(2))
        looks = [look for look in candidate.looks if look.frame in carried]
        frames, stray = [look.frame for look in looks], np.array([look.place - carried[look.frame] for look in looks])
        seen: dict[int, tuple[Array, Array]] = {}
        shown = np.full(PARAMETERS, np.nan)
        since = lost = 0
        off, farthest = stray[-1], 0.0
        for then in reversed(self._recent):
            between = then.number >= first
            if between:
                since += 1
                off = np.array([np.interp(then.number, frames, along) for along in stray.T])
            expected = carried[then.number] + off
            near = np.argsort(np.linalg.norm(then.place - expected, axis=1))[:NEIGHBOURS]
            starts = np.concatenate([_starts(expected[None], parameters), _moved(parameters[near], then.place[near])])
            dots = doubted(then.image, fit_dots(then.image, starts, 1))
            miss = float(np.linalg.norm(dots.centre[0] - expected))
            if self._admitted(dots)[0] and miss < (
                SAME * spacing if between else min(SAME * spacing, FARTHER * farthest + BLUR)
            ):
                farthest, lost, off = max(farthest, miss), 0, off + dots.centre[0] - expected
                shown = shown if seen else dots.parameters[0]
                seen[then.number] = dots.centre[0], dots.sigma[0]
            elif not between:
                lost += 1
                if lost == LOST:
                    break
        path = np.array([(seen[number][0], carried[number]) for number in seen if number >= first]).reshape(-1, 2, 2)
        if len(path) < max(FOUND * since, LEAST_SEEN) or _hops(path[:, 0], path[:, 1], spacing):
            return None
        home = self._home(pattern, seen)
        return None if home is None else Newcomer(*home, shown, seen)

    def _carried_since(self, rest: Array, own: Array, first: int) -> dict[int, Array]:
        """Where the markers put a dot in the last pictures [px], (2), by frame.

        Always the same markers since its first look, as more of them put it elsewhere; where fewer were known before,
        those carry it on from there.

        Args:
            rest: where markers belong in the pattern [px], (M, 2).
            own: where the dot does [px], (2).
            first: frame of its first look.
        """
        count = min(len(then.place) for then in self._recent if then.number >= first)
        memory, off = Memory(np.concatenate([rest[:count], own[None]])), np.zeros(2)
        carried: dict[int, Array] = {}
        for then, later in zip(reversed(self._recent), [None, *reversed(self._recent)], strict=False):
            if later is not None and len(then.place) < count:
                count = len(then.place)
                memory = Memory(np.concatenate([rest[:count], own[None]]))
                off = carried[later.number] - _carried(memory, later, count)
            carried[then.number] = _carried(memory, then, count) + off
        return carried

    def _home(self, pattern: Pattern, seen: dict[int, tuple[Array, Array]]) -> tuple[Array, float] | None:
        """Where in the pattern a dot belongs, and how well that is known [px], by its places and sigma by frame.

        Best where the body was bent as it is in the pattern; None where no picture shows enough of that.
        """
        beliefs = []
        for then in self._recent:
            body = np.flatnonzero(then.body)
            if then.number in seen and len(body) >= FEWEST:
                place, sigma = self._at_rest(pattern, then, seen[then.number][0][None])
                unlike = np.hypot(_bent(pattern.rest[body], then.place[body]), sigma[0])
                beliefs.append((float(unlike), then.number, place[0], float(sigma[0])))
        return min(beliefs)[2:] if beliefs else None


def _matches(gaps: Array, row: int, column: int, most: float) -> bool:
    """Whether of the gaps between dots and candidates (D, C) this is small enough, if need be for want of a rival."""
    gap, others = gaps[row, column], np.append(np.delete(gaps[row], column), np.delete(gaps[:, column], row))
    alone = UNRIVALLED * gap < others.min(initial=np.inf)
    return bool(gap < (UNRIVALLED * most if alone else most))


def _carried(memory: Memory, then: _Earlier, count: int) -> Array:
    """Where the first so many markers of a picture put the one that comes after them in the memory [px], (2)."""
    place, known = np.append(then.place[:count], [[0.0, 0.0]], axis=0), np.append(then.body[:count], False)
    return memory.carried(place, known).place[-1]


def _hops(found: Array, carried: Array, spacing: float) -> bool:
    """Whether what was followed [px], (T, 2), is one dot after the other.

    Then it jumps from where the body would have carried it on, (T, 2), to the next; or they mostly stand still.
    """
    if np.linalg.norm(np.diff(found - carried, axis=0), axis=1).max() > JUMP * spacing:
        return True
    steps, body = (np.median(np.linalg.norm(np.diff(way, axis=0), axis=1)) for way in (found, carried))
    return bool(steps < HOPPING * np.linalg.norm(np.std(found, axis=0)) and steps < RESTING * body)


def _bent(rest: Array, place: Array) -> float:
    """How far places (M, 2) are from those at rest moved, turned and scaled to fit them: root mean square [px]."""
    before, after = ((item - item.mean(axis=0)) @ [1.0, 1j] for item in (rest, place))
    left = after - before * np.vdot(before, after) / np.vdot(before, before)
    return float(np.sqrt((np.abs(left) ** 2).mean()))


def _starts(places: Array, parameters: Array) -> Array:
    """Of fits (D, 12) at places (D, 2): discs as the known markers' are."""
    usual = np.nanmedian(parameters, axis=0)
    return starts_at(places, usual[2:5], usual[8], usual[9])


def _moved(parameters: Array, place: Array) -> Array:
    """Discs at other places."""
    return np.concatenate([place, parameters[:, 2:]], axis=1)
