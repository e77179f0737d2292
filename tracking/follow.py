"""Following every dot of a recording through one camera's video."""

import heapq
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from groundwork import InputError
from tracking.affine import carry
from tracking.cut import WholeLooks
from tracking.disc import PARAMETERS
from tracking.dots import SAME_PLACE, SHADES, Dots, apart, eight_bits, find_spots, fit_dots, shade_of, start_of
from tracking.family import Family, find_family
from tracking.frame import Frame
from tracking.memory import Memory
from tracking.motion import Motion
from tracking.newcomers import Newcomer, Newcomers
from tracking.noise import places_and_errors
from tracking.shape import Pattern, recognise
from tracking.video import Video

Array = NDArray[Any]

FEWEST_MARKERS = 3
WORST = 10  # frames whose pictures are kept
CALM = 0.22  # spacings: surprise up to which the dot at a marker's predicted place is its own
STRAY = 0.33  # spacings: how far from its prediction a dot found there may be
SEED_REACH = 2.2  # spacings: how far from where it is expected a marker may be
DISPUTED = 0.5  # of the distance from another marker's place: how far from its own a dot that comes back may be
RECHECK = 4  # frames between searches for markers out of sight
NOTHING = np.empty((0, 2))


@dataclass(frozen=True)
class PixelTracks:
    """One camera's view of a recording; markers not named yet.

    Attributes:
        time: [s], (T), NaN where the video does not say.
        pixel: (T, D, 2), NaN where not measured; where the coding is known, as the others' motion mends it.
        sigma: one standard deviation along x and y [px], (T, D, 2).
        start: positions in the first frame that shows markers [px], (D, 2); of late ones where the others carry them.
        late: how many markers, the last ones, came into sight later.
        damaged: frames that could not be decoded, (T).
        pictures: the first frame and the worst ten, by number, as JPEG.
        notes: what the video said that contradicts itself.
    """

    time: Array
    pixel: Array
    sigma: Array
    start: Array
    late: int
    damaged: NDArray[np.bool_]
    pictures: dict[int, bytes]
    notes: tuple[str, ...]


def follow(video: Video, tick: Callable[[], None]) -> PixelTracks:
    """Find the markers in the first frame that shows some and follow them, and those that come later, to the last.

    Args:
        video: one camera's.
        tick: called after every frame.

    Raises:
        InputError: fewer than three markers, or a video that cannot be decoded.
    """
    times: list[float] = []
    seen: list[Sight] = []  # of as many markers as were known then
    late: list[Newcomer] = []
    damaged: list[bool] = []
    most = 0
    tracker: Tracker | None = None
    album = _Album()
    reading = video.read()
    for frame in reading:
        times.append(frame.time)
        damaged.append(frame.picture is None)
        sight = Sight(NOTHING, NOTHING, NOTHING, NOTHING[:, 0])
        if frame.picture is not None and tracker is None:
            found = find_family(frame.picture)
            most = max(most, 0 if found is None else len(found[1]))
            if found is not None and len(found[1]) >= FEWEST_MARKERS:
                tracker = Tracker(*found)
                sight = Sight.of(tracker.looks.judge(frame.picture, found[1]), frame)
        elif frame.picture is not None and tracker is not None:
            sight = Sight.of(tracker.advance(frame.picture), frame)
            late += tracker.look_out(len(times) - 1, frame.picture)
        elif tracker is not None:
            tracker.pass_over()
        if frame.picture is not None and tracker is not None:
            album.consider(len(times) - 1, frame.picture, sight.sigma)
        seen.append(sight)
        tick()
    if all(damaged):
        raise InputError(f"expected frames in {video.path}, found none that decode; copy it again from the camera")
    if tracker is None:
        raise InputError(
            f"{video.path}: expected at least {FEWEST_MARKERS} dots of one size in a frame, found {most} at most; "
            "check that dots of 3 to 32 px radius contrast with the skin"
        )
    with ThreadPoolExecutor(1) as aside:
        pictures = aside.submit(album.pictures)
        paths, sigma = places_and_errors(*_whole(seen, late, len(tracker.pattern.rest)))
    return PixelTracks(
        np.array(times), paths, sigma, tracker.pattern.rest, len(late), np.array(damaged),
        pictures.result(), tuple(reading.notes),
    )  # fmt: skip


@dataclass(frozen=True)
class Sight:
    """The markers in one picture.

    Attributes:
        pixel: (D, 2), NaN where not seen.
        sigma: from the fits [px], (D, 2), NaN where not seen.
        leverage: what a grey level of independent noise in every pixel moves the centre by [px], (D, 2).
        step: by which the video's coding rounded the picture there [grey levels], (D), NaN where not known.
    """

    pixel: Array
    sigma: Array
    leverage: Array
    step: Array

    @classmethod
    def of(cls, dots: Dots, frame: Frame) -> "Sight":
        """Those of a frame; dots without a sigma are not seen."""
        pixel = np.where(np.isfinite(dots.sigma), dots.centre, np.nan)
        return cls(pixel, dots.sigma, dots.leverage, frame.step_at(pixel))


def _whole(seen: list[Sight], late: list[Newcomer], count: int) -> tuple[Array, Array, Array, Array]:
    """Pixels, sigma, leverage (T, D, 2) and steps (T, D) of all markers, NaN where not seen; the last come late."""
    paths, fitted, leverage = np.full((3, len(seen), count, 2), np.nan)
    step = np.full((len(seen), count), np.nan)
    for frame, sight in enumerate(seen):
        known = len(sight.pixel)
        paths[frame, :known], fitted[frame, :known] = sight.pixel, sight.sigma
        leverage[frame, :known], step[frame, :known] = sight.leverage, sight.step
    for column, newcomer in enumerate(late, start=count - len(late)):
        for frame, (pixel, sigma) in newcomer.seen.items():
            paths[frame, column], fitted[frame, column] = pixel, sigma
    return paths, fitted, leverage, step


class _Album:
    """The first frame, and those in which most markers are lost or worst located."""

    def __init__(self) -> None:
        self.first: tuple[int, NDArray] | None = None
        self.worst: list[tuple[float, int, NDArray]] = []  # a heap, the least bad on top

    def consider(self, number: int, picture: NDArray, sigma: Array) -> None:
        """Keeps a picture if it is among the worst so far."""
        badness = float(sigma.max(initial=0.0))
        if badness != badness:  # some are not seen
            located = sigma[sigma == sigma]
            badness = len(sigma) - 0.5 * len(located) + float(located.max(initial=0.0))
        if self.first is not None and len(self.worst) == WORST and badness <= self.worst[0][0]:
            return
        if self.first is None:
            self.first = (number, picture)
        else:
            push = heapq.heappush if len(self.worst) < WORST else heapq.heappushpop
            push(self.worst, (badness, number, picture))

    def pictures(self) -> dict[int, bytes]:
        """JPEG by frame."""
        kept = {number: picture for _, number, picture in self.worst}
        kept |= {} if self.first is None else {self.first[0]: self.first[1]}
        quality = [cv2.IMWRITE_JPEG_QUALITY, 80]
        return {
            number: cv2.imencode(".jpg", eight_bits(picture), quality)[1].tobytes() for number, picture in kept.items()
        }


class Tracker:
    """Follows the markers of one camera from picture to picture."""

    def __init__(self, family: Family, first: Dots) -> None:
        self.family = family
        self.pattern = Pattern.of(first.centre)
        self.parameters = first.parameters.copy()
        self.motion = Motion(first.centre)
        self.memory = Memory(first.centre)
        self.missing = np.zeros(len(first), dtype=np.int64)  # frames since each was seen
        self.searched = 0  # frames since the last search
        self.newcomers = Newcomers(family)
        self.looks = WholeLooks.none(len(first))

    def advance(self, image: NDArray) -> Dots:
        """The markers' dots (D) in the next picture, sigma NaN where a marker is not seen."""
        expected = self._expected()
        dots = None
        if self.motion.surprise.min() < CALM:
            dots = self._where_expected(image, expected)
        self.searched += 1
        if dots is None or not self._holds(dots) or self.searched >= self._patience():
            found = self._search(image, expected)
            better = dots is None or np.isfinite(found.sigma[:, 0]).sum() > np.isfinite(dots.sigma[:, 0]).sum()
            dots = found if better or dots is None else dots
            self.searched = 0
        dots = self.looks.judge(image, _only(dots, self._undisputed(dots)))
        self._learn(dots)
        return dots

    def pass_over(self) -> None:
        """A frame that shows nothing."""
        self.motion.remember(self._expected())
        self.missing += 1

    def look_out(self, number: int, image: NDArray) -> list[Newcomer]:
        """After `advance`: markers that have become known, followed from now on."""
        place, seen = self.motion.last, self.missing == 0
        found = self.newcomers.look(number, image, place, seen, self.pattern, self.parameters)
        for newcomer in found:
            rest = self.pattern.rest
            places = np.concatenate([carry(rest, place, newcomer.rest[None]) for place in self.motion.places])
            if number in newcomer.seen:
                places[-1] = newcomer.seen[number][0]
            self.motion.join(places)
            self.memory.join(newcomer.rest)
            self.looks.join()
            self.pattern = Pattern.of(np.concatenate([rest, newcomer.rest[None]]))
            self.parameters = np.concatenate([self.parameters, newcomer.parameters[None]])
            self.missing = np.append(self.missing, 0 if number in newcomer.seen else 1)
        return found

    def _holds(self, dots: Dots) -> bool:
        """Whether all markers that were in sight are among the dots, and some were."""
        wanted = self.missing == 0
        return bool(wanted.any()) and not np.isnan(dots.sigma[wanted]).any()

    def _patience(self) -> float:
        return RECHECK if self.missing.any() else np.inf

    def _expected(self) -> Array:
        """Where the motion so far puts the markers; those out of sight where the others carry them."""
        if not self.missing.any():
            return self.motion.expected()
        seen = self.missing == 0
        return self.memory.carried(self.motion.expected(), seen) if seen.any() else self.motion.last

    def _where_expected(self, image: NDArray, expected: Array) -> Dots | None:
        """The dots at the markers' expected places; None where they are not all their own."""
        start = self.parameters.copy()
        start[:, :2] = expected
        dots = fit_dots(image, start)
        good = self.family.admits(dots)
        same = SAME_PLACE * self.family.radius
        calm = _own(dots.parameters, self.parameters, expected, self.missing, self.pattern.spacing, same, good)
        return _only(dots, good) if calm else None

    def _search(self, image: NDArray, expected: Array) -> Dots:
        """Every dot near the body, matched to the markers all at once."""
        hidden = int(self.missing.min())
        uncertain = 1.0 + 0.3 * min(hidden, 10)
        margin = (SEED_REACH + 1.0) * float(np.median(self.pattern.spacing)) + 2.0 * self.family.radius
        margin *= uncertain
        low, high = expected.min(0) - margin, expected.max(0) + margin
        shape = np.median(self.parameters[:, 2:5], axis=0)
        level = float(np.median(self.parameters[:, 9]))
        region = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        least = self.family.least(float(np.nanmin(np.abs(self.parameters[:, 8]))))
        spots = find_spots(image, self.family.radius, least, region)
        starts = [start_of(x, y, shape, self.family.contrast, level) for x, y in spots]
        dots = fit_dots(image, np.array(starts).reshape(-1, PARAMETERS))
        dots = apart(dots[self.family.admits(dots)], SAME_PLACE * self.family.radius)
        speed = np.linalg.norm(expected - self.motion.last, axis=1) / self.pattern.spacing
        trusted = -speed - 0.2 * np.minimum(self.missing, 10)
        surprise = float(self.motion.surprise.min())
        sureness = 0.0 if hidden else 1.0 / (1.0 + (2.0 * surprise) ** 2) if np.isfinite(surprise) else 0.3
        steady = np.zeros(len(expected))
        if (self.missing > 0).any() and surprise < CALM:  # who is out of sight could take the place of who is in sight
            steady[self.missing == 0] = 1.0 - surprise / CALM
        reach = SEED_REACH * uncertain
        match = recognise(self.pattern, self.motion.last, expected, trusted, dots.centre, reach, sureness, steady)
        chosen = dots[np.maximum(match, 0)] if len(dots) else Dots.none(len(match))
        return _only(chosen, match >= 0)

    def _undisputed(self, dots: Dots) -> NDArray[np.bool_]:
        """Which markers are seen, and not by dots that could as well be another's.

        Those that were in sight before; and of the others those whose dots lie where these put them, less than half as
        far from there as from where they put another marker out of sight, one by one, each a help for the next. If all
        out of sight are back, it is enough that two dots lie less than half as far off as if they were exchanged.
        """
        shown = np.isfinite(dots.sigma[:, 0])
        if not self.missing.any():
            return shown
        sure = shown & (self.missing == self.missing.min())
        while sure.any() and (shown & ~sure).any():
            place = self.memory.carried(dots.centre, sure)
            asked, out = np.flatnonzero(shown & ~sure), np.flatnonzero(~sure)
            gaps = np.linalg.norm(dots.centre[asked][:, None] - place[out], axis=2)
            mine = asked[:, None] == out
            own, other = gaps[mine], np.where(mine, np.inf, gaps)
            clear = own < DISPUTED * other.min(axis=1)
            if len(asked) == len(out):
                kept, exchanged = np.hypot(own[:, None], own), np.hypot(other, other.T)
                clear |= (kept < DISPUTED * exchanged).all(axis=1)
            clear &= own < DISPUTED * self.pattern.spacing[asked]
            if not clear.any():
                return sure
            sure[asked[clear]] = True
        return shown

    def _learn(self, dots: Dots) -> None:
        seen, place = np.isfinite(dots.sigma[:, 0]), dots.centre
        self.motion.judge(place, seen & (self.missing == 0), self.pattern.spacing)
        if not seen.all():
            place = np.where(seen[:, None], place, self._expected())
            place = self.memory.carried(place, seen)
        self.memory.add(place, seen)
        self.motion.remember(place)
        self.missing = np.where(seen, 0, self.missing + 1)
        self.parameters[seen] = dots.parameters[seen]


@njit(cache=True)
def _own(parameters, before, expected, missing, spacing, same, good):  # type: ignore[no-untyped-def]
    """Leaves in good (M) the markers whose own dots these are; False where too few lie near their expected places.

    before: parameters in the picture before. same: distance below which two dots are one.
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
        if good[k] and missing[k] == 0:
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
