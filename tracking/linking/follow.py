"""Following every dot of a recording through one camera's video."""

import heapq
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rafl.tracking.detection.appearance import find_family
from rafl.tracking.detection.detect import Dots, eight_bits
from rafl.tracking.linking.late_markers import Newcomer
from rafl.tracking.linking.shape_prior import Memory
from rafl.tracking.linking.tracker import FEW_SHAPES, Tracker
from rafl.tracking.reconstruction.uncertainty import places_and_errors, share_of_noise
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.reader import Video

from rafl.common.errors import InputError

Array = NDArray[Any]

FEWEST_MARKERS = 3
WORST = 10  # frames whose pictures are kept
NOTHING = np.empty((0, 2))


@dataclass(frozen=True)
class PixelTracks:
    """One camera's view of a recording; markers not named yet.

    Attributes:
        time: [s], (T), NaN where the video does not say.
        pixel: (T, D, 2), NaN where not measured; where the coding is known, as the others' motion mends it.
        sigma: one standard deviation along x and y [px], (T, D, 2).
        start: positions in the first frame that shows markers [px], (D, 2); of late ones where the others put them.
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
    noise = 1.0
    tracker: Tracker | None = None
    album = _Album()
    reading = video.read()
    for frame in reading:
        times.append(frame.time)
        damaged.append(frame.picture is None)
        sight = Sight(NOTHING, NOTHING, NOTHING, NOTHING[:, 0], frame.lag)
        if frame.picture is not None and tracker is None:
            found = find_family(frame.picture)
            most = max(most, 0 if found is None else len(found[1]))
            if found is not None and len(found[1]) >= FEWEST_MARKERS:
                tracker = Tracker(*found)
                noise = share_of_noise(found[1].grain, found[1].residual)
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
        paths, sigma = places_and_errors(*_whole(seen, late, len(tracker.pattern.rest)), noise)
    start = tracker.pattern.rest
    if late:
        start = _with_late_ones(start, paths, np.arange(len(start)) >= len(start) - len(late), tracker.marks.known)
    return PixelTracks(
        np.array(times), paths, sigma, start, len(late), np.array(damaged), pictures.result(), tuple(reading.notes)
    )


@dataclass(frozen=True)
class Sight:
    """The markers in one picture.

    Attributes:
        pixel: (D, 2), NaN where not seen.
        sigma: from the fits [px], (D, 2), NaN where not seen.
        leverage: what a grey level of independent noise in every pixel moves the centre by [px], (D, 2).
        step: by which the video's coding rounded the picture there [grey levels], (D), NaN where not known.
        lag: see `Frame`.
    """

    pixel: Array
    sigma: Array
    leverage: Array
    step: Array
    lag: float

    @classmethod
    def of(cls, dots: Dots, frame: Frame) -> "Sight":
        """Those of a frame; dots without a sigma are not seen."""
        pixel = np.where(np.isfinite(dots.sigma), dots.centre, np.nan)
        return cls(pixel, dots.sigma, dots.leverage, frame.step_at(pixel), frame.lag)


def _whole(seen: list[Sight], late: list[Newcomer], count: int) -> tuple[Array, Array, Array, Array, Array]:
    """Pixels, sigma, leverage (T, D, 2) and steps (T, D) of all markers, NaN where not seen, and what `lag` is (T).

    The last markers come late.
    """
    paths, fitted, leverage = np.full((3, len(seen), count, 2), np.nan)
    step = np.full((len(seen), count), np.nan)
    for frame, sight in enumerate(seen):
        known = len(sight.pixel)
        paths[frame, :known], fitted[frame, :known] = sight.pixel, sight.sigma
        leverage[frame, :known], step[frame, :known] = sight.leverage, sight.step
    for column, newcomer in enumerate(late, start=count - len(late)):
        for frame, (pixel, sigma) in newcomer.seen.items():
            paths[frame, column], fitted[frame, column] = pixel, sigma
    return paths, fitted, leverage, step, np.array([sight.lag for sight in seen])


def _with_late_ones(start: Array, paths: Array, late: NDArray[np.bool_], marks: NDArray[np.bool_]) -> Array:
    """Where markers were in the first picture [px], (D, 2): the late ones (D) as in all shapes that showed everybody.

    What was thought of one when it came into sight rests on a body bent otherwise.

    Args:
        start: where they were, late ones by what was thought [px], (D, 2).
        paths: all that was seen [px], (T, D, 2).
        late: who came into sight later, (D).
        marks: who does not ride on the body, (D).
    """
    memory, telling = Memory(start), ~late & ~marks
    for place in paths[np.isfinite(paths[..., 0]).all(axis=1)]:
        memory.add(place, np.ones(len(start), bool))
    if len(memory) < FEW_SHAPES or not telling.any():
        return start
    return np.where((late & ~marks)[:, None], memory.carried(start, telling).place, start)


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
