"""Markers that come into sight after the first frame: from behind a hand, or from outside the picture.

A dot is taken in once it moves, in one look after the other, and stays in its place on the body the while; and where
the last pictures show it there nearly always. What stands still behind the body does neither.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking.affine import carry
from tracking.cut import doubted
from tracking.disc import PARAMETERS
from tracking.dots import SAME_PLACE, Dots, apart, find_spots, fit_dots, start_of
from tracking.family import DIM, Family
from tracking.shape import NEIGHBOURS, Pattern

Array = NDArray[Any]

EVERY, SOON = 12, 4  # frames from look to look; where the last one showed a dot that may be one
LOOKS = 3  # one after the other that show a dot before it is believed
KEPT, MOST_BYTES = 60, 2**28  # last pictures, in which a dot is followed back, and their size together
FREE = 0.55  # spacings: how far on the body from known markers there may be another
FAR = 1.8  # breadths: how far from them at most
BESIDE = 0.5  # sine of the angle from the line to its nearest neighbour, from which on one stands beside a marker
SAME = 0.3  # spacings: how far on the body a dot may seem to move from look to look
MOVING = 0.5  # px: root mean square way through the picture that shows that something moves
CARRIED = 0.5  # of that way: how far it may move on the body the while
FOUND = 0.8  # of the pictures since it was first seen
ALIKE = 1.2  # ratio of radii within a family


@dataclass(eq=False)
class _Candidate:
    """A dot not known yet: its places on the body at rest and in the picture [px], look by look."""

    rest: list[Array]
    place: list[Array]
    since: int  # frame of the first look

    def carried(self) -> bool:
        """Whether the looks show that the body carries it."""
        way, stray = (np.linalg.norm(np.std(places, axis=0)) for places in (self.place, self.rest))
        return len(self.place) >= LOOKS and bool(way > MOVING and stray < CARRIED * way)


@dataclass(frozen=True)
class Newcomer:
    """A marker that came into sight late.

    Attributes:
        rest: where it belongs in the pattern [px], (2).
        parameters: of its disc, (12).
        seen: its place and sigma [px] by frame, up to the present one.
    """

    rest: Array
    parameters: Array
    seen: dict[int, tuple[Array, Array]]


@dataclass
class Newcomers:
    """Looks out for markers that are not known yet."""

    family: Family
    candidates: list[_Candidate] = field(default_factory=list)
    due: int = 0  # frame of the next look
    recent: deque[tuple[int, NDArray, Array]] = field(default_factory=deque)

    def look(
        self, number: int, image: NDArray, place: Array, seen: NDArray[np.bool_], marks: NDArray[np.bool_],
        pattern: Pattern, parameters: Array,
    ) -> list[Newcomer]:  # fmt: skip
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
        self.recent.append((number, image, place))
        most = KEPT if self.candidates else EVERY  # fresh memory is slow
        while len(self.recent) > max(min(most, MOST_BYTES // image.nbytes), 1):
            self.recent.popleft()
        if number < self.due or 2 * (seen & ~marks).sum() < (~marks).sum():
            return []
        body, spacing = seen & ~marks, float(np.median(pattern.spacing))
        breadth = _breadth(pattern.rest[body])
        found = self._strangers(image, place, FAR * breadth, pattern, parameters)
        rest = carry(place[body], pattern.rest[body], found)
        away = np.linalg.norm(rest[:, None] - pattern.rest[None], axis=2)
        fit = (away.min(axis=1) > FREE * spacing) & (away[:, body].min(axis=1) < FAR * breadth)
        self._count(found[fit], rest[fit], number, SAME * spacing)
        self.due = number + (SOON if self.candidates else EVERY)
        ready = [item for item in self.candidates if item.carried()]
        self.candidates = [item for item in self.candidates if item not in ready]
        followed = [self._followed_back(item, ~marks, pattern, parameters, SAME * spacing) for item in ready]
        return [newcomer for newcomer in followed if newcomer is not None]

    def _strangers(self, image: NDArray, place: Array, reach: float, pattern: Pattern, parameters: Array) -> Array:
        """Dots of the family within reach [px] of the body that are no known marker's [px], (D, 2)."""
        spacing = float(np.median(pattern.spacing))
        low, high = place.min(0) - reach, place.max(0) + reach
        region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        spots = find_spots(image, self.family.radius, self.family.least(self.family.contrast), region)
        away = np.linalg.norm(spots[:, None] - place[None], axis=2).min(axis=1, initial=np.inf)
        strange = spots[away > 0.5 * FREE * spacing]
        if not len(strange):
            return np.empty((0, 2))
        starts = _starts(strange, parameters)
        dots = fit_dots(image, np.concatenate([starts, _moved(parameters, place)]), len(starts))
        return apart(dots[self._admitted(dots)], SAME_PLACE * self.family.radius).centre

    def _admitted(self, dots: Dots) -> NDArray[np.bool_]:
        good = self.family.admits(dots) & (dots.contrast / self.family.contrast > DIM)
        return good & (np.abs(np.log(dots.radius / self.family.radius)) < np.log(ALIKE))

    def _count(self, found: Array, rest: Array, number: int, same: float) -> None:
        """Candidates that this look does not show are given up; what it shows for the first time becomes one."""
        earlier, self.candidates = self.candidates, []
        for place, own in zip(found, rest, strict=True):
            gaps = [float(np.linalg.norm(item.rest[-1] - own)) for item in earlier]
            near = bool(gaps) and min(gaps) < same
            item = earlier.pop(int(np.argmin(gaps))) if near else _Candidate([], [], number)
            item.rest.append(own)
            item.place.append(place)
            self.candidates.append(item)

    def _followed_back(
        self, candidate: _Candidate, body: NDArray[np.bool_], pattern: Pattern, parameters: Array, same: float
    ) -> Newcomer | None:
        """The candidate in the last pictures; None where too few of those since its first look show it."""
        rest = np.median(candidate.rest, axis=0)
        seen: dict[int, tuple[Array, Array]] = {}
        shown = np.full(PARAMETERS, np.nan)
        since = 0
        for number, image, place in self.recent:
            riding = body[: len(place)]
            expected = carry(pattern.rest[: len(place)][riding], place[riding], rest[None])
            near = np.argsort(np.linalg.norm(place - expected, axis=1))[:NEIGHBOURS]
            starts = np.concatenate([_starts(expected, parameters), _moved(parameters[near], place[near])])
            dots = doubted(image, fit_dots(image, starts, 1))
            since += number >= candidate.since
            if self._admitted(dots)[0] and np.linalg.norm(dots.centre[0] - expected[0]) < same:
                seen[number] = dots.centre[0], dots.sigma[0]
                shown = dots.parameters[0]
        enough = sum(number >= candidate.since for number in seen) >= FOUND * since
        return Newcomer(rest, shown, seen) if enough and seen else None


def _breadth(rest: Array) -> float:
    """How far apart the markers' lines are: the usual distance to the nearest that is not in line with the nearest."""
    way = rest[:, None] - rest[None]
    distance = np.linalg.norm(way, axis=2) + np.where(np.eye(len(rest), dtype=bool), np.inf, 1e-9)
    nearest = way[np.arange(len(rest)), distance.argmin(axis=1)] / distance.min(axis=1)[:, None]
    sine = np.abs(way[..., 0] * nearest[:, None, 1] - way[..., 1] * nearest[:, None, 0]) / distance
    beside = np.where(sine > BESIDE, distance, np.inf).min(axis=1)
    return float(np.median(np.where(beside < np.inf, beside, distance.min(axis=1))))


def _starts(places: Array, parameters: Array) -> Array:
    """Of fits (D, 12) at places (D, 2): discs as the known markers' are."""
    usual = np.nanmedian(parameters, axis=0)
    starts = [start_of(x, y, usual[2:5], usual[8], usual[9]) for x, y in places]
    return np.array(starts).reshape(-1, PARAMETERS)


def _moved(parameters: Array, place: Array) -> Array:
    """Discs at other places."""
    return np.concatenate([place, parameters[:, 2:]], axis=1)
