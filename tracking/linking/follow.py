"""Tracking all markers of a recording through one camera's video."""

import heapq
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.tracking.detection.appearance import find_markers
from rafl.tracking.detection.detect import Dots, to_eight_bits
from rafl.tracking.linking.late_markers import LateMarker
from rafl.tracking.linking.repeated_frames import find_repeated_frames
from rafl.tracking.linking.shape_prior import ShapePrior
from rafl.tracking.linking.tracker import Tracker
from rafl.tracking.reconstruction.uncertainty import with_error_floor
from rafl.tracking.video.reader import Video

Array = NDArray[Any]

MIN_MARKERS = 3
MIN_SHAPES = 6  # with fewer shapes, the shape prior is not relied on for the start of late-detected markers
WORST_FRAME_COUNT = 10  # frames whose images are kept for the report


@dataclass(frozen=True)
class PixelTracks:
    """One camera's view of a recording, before the markers get their names.

    Attributes:
        time: [s], (T), NaN where the video gives none.
        pixel: positions [px], (T, D, 2), NaN where not measured.
        sigma: along x and y [px], (T, D, 2).
        start: positions in the first frame that shows markers [px], (D, 2); predicted for late-detected markers.
        late_count: number of late-detected markers, which are the last ones.
        damaged: frames that could not be decoded, (T).
        repeated: frames that show the one before again while the body moves, (T).
        images: the first frame and the ten worst ones as JPEG, by frame number.
        notes: contradictions in the video's own statements.
    """

    time: Array
    pixel: Array
    sigma: Array
    start: Array
    late_count: int
    damaged: NDArray[np.bool_]
    repeated: NDArray[np.bool_]
    images: dict[int, bytes]
    notes: tuple[str, ...]


def follow(video: Video, tick: Callable[[], None]) -> PixelTracks:
    """Find the markers in the first frame that shows some, and track them and late-detected ones to the last frame.

    Args:
        video: of one camera.
        tick: called after every frame.

    Raises:
        InputError: fewer than three markers, or a video that cannot be decoded.
    """
    times: list[float] = []
    detections: list[Detections] = []  # of the markers known at that frame
    late: list[LateMarker] = []
    damaged: list[bool] = []
    max_dots = 0
    tracker: Tracker | None = None
    worst_frames = _WorstFrames()
    reading = video.read()
    for frame in reading:
        times.append(frame.time)
        damaged.append(frame.image is None)
        detected = NO_MARKERS
        if frame.image is not None and tracker is None:
            found = find_markers(frame.image)
            max_dots = max(max_dots, 0 if found is None else len(found[1]))
            if found is not None and len(found[1]) >= MIN_MARKERS:
                tracker = Tracker(*found)
                detected = Detections.of(found[1])
        elif frame.image is not None and tracker is not None:
            detected = Detections.of(tracker.advance(frame.image))
            late += tracker.add_late_markers(len(times) - 1, frame.image)
        elif tracker is not None:
            tracker.skip_frame()
        if frame.image is not None and tracker is not None:
            worst_frames.consider(len(times) - 1, frame.image, detected.sigma)
        detections.append(detected)
        tick()
    if all(damaged):
        raise InputError(f"expected frames in {video.path}, found none that decode; copy it again from the camera")
    if tracker is None:
        raise InputError(
            f"{video.path}: expected at least {MIN_MARKERS} dots of one size in a frame, found {max_dots} at most; "
            "check that dots of 3 to 32 px radius contrast with the skin"
        )
    with ThreadPoolExecutor(1) as background:
        images = background.submit(worst_frames.encode)
        pixel, fit_sigma, half_width = _assemble(detections, late, len(tracker.pattern.rest))
        sigma = with_error_floor(pixel, fit_sigma, half_width, video.predicted_frames)
    start = tracker.pattern.rest
    if late:
        is_late = np.arange(len(start)) >= len(start) - len(late)
        start = _predict_late_starts(start, pixel, is_late, tracker.static_dots.mask)
    repeated = find_repeated_frames(pixel, sigma)
    pixel[repeated], sigma[repeated] = np.nan, np.nan
    return PixelTracks(
        np.array(times),
        pixel,
        sigma,
        start,
        len(late),
        np.array(damaged),
        repeated,
        images.result(),
        tuple(reading.notes),
    )


@dataclass(frozen=True)
class Detections:
    """The markers in one frame.

    Attributes:
        pixel: positions [px], (D, 2), NaN where not visible.
        sigma: from the fits [px], (D, 2), NaN where not visible.
        half_width: of their outlines along x and y [px], (D, 2).
    """

    pixel: Array
    sigma: Array
    half_width: Array

    @classmethod
    def of(cls, dots: Dots) -> "Detections":
        """From the dots of a frame; those without a sigma are not visible."""
        return cls(np.where(np.isfinite(dots.sigma), dots.centre, np.nan), dots.sigma, dots.half_width)


NO_MARKERS = Detections(*np.empty((3, 0, 2)))


def _assemble(detections: list[Detections], late: list[LateMarker], count: int) -> tuple[Array, Array, Array]:
    """Positions, sigmas and half widths of all `count` markers [px], (T, D, 2) each; late-detected ones last.

    They are NaN where not measured.
    """
    pixel, sigma, half_width = np.full((3, len(detections), count, 2), np.nan)
    for frame, detected in enumerate(detections):
        known = len(detected.pixel)
        pixel[frame, :known], sigma[frame, :known] = detected.pixel, detected.sigma
        half_width[frame, :known] = np.where(np.isfinite(detected.sigma), detected.half_width, np.nan)
    for column, marker in enumerate(late, start=count - len(late)):
        for frame, (position, position_sigma) in marker.seen.items():
            pixel[frame, column], sigma[frame, column] = position, position_sigma
    return pixel, sigma, half_width


def _predict_late_starts(start: Array, pixel: Array, late: NDArray[np.bool_], static: NDArray[np.bool_]) -> Array:
    """The positions at the start [px], (D, 2), with those of late-detected markers predicted from the whole recording.

    Their position estimated at their detection is less accurate, because the body was bent differently then.

    Args:
        start: positions at the start, for late-detected markers as estimated at their detection [px], (D, 2).
        pixel: positions in all frames [px], (T, D, 2).
        late: which markers were detected late, (D).
        static: which are static dots, (D).
    """
    prior, known = ShapePrior(start), ~late & ~static
    for positions in pixel[np.isfinite(pixel[..., 0]).all(axis=1)]:
        prior.add_shape(positions, np.ones(len(start), bool))
    if len(prior) < MIN_SHAPES or not known.any():
        return start
    return np.where((late & ~static)[:, None], prior.predict(start, np.where(known, 0.0, np.inf)).position, start)


class _WorstFrames:
    """The first frame and the worst ones: those with most markers missing or the largest sigma."""

    def __init__(self) -> None:
        self.first: tuple[int, Array] | None = None
        self.worst: list[tuple[float, int, Array]] = []  # a heap with the least bad frame first

    def consider(self, number: int, image: Array, sigma: Array) -> None:
        """Keep a frame's image if it is one of the worst so far; `sigma` are its markers' [px], (D, 2)."""
        badness = float(sigma.max(initial=0.0))
        if badness != badness:  # NaN: some markers are missing
            located = sigma[sigma == sigma]
            badness = len(sigma) - 0.5 * len(located) + float(located.max(initial=0.0))
        if self.first is not None and len(self.worst) == WORST_FRAME_COUNT and badness <= self.worst[0][0]:
            return
        if self.first is None:
            self.first = (number, image)
        else:
            push = heapq.heappush if len(self.worst) < WORST_FRAME_COUNT else heapq.heappushpop
            push(self.worst, (badness, number, image))

    def encode(self) -> dict[int, bytes]:
        """The images as JPEG, by frame number."""
        kept = {number: image for _, number, image in self.worst}
        kept |= {} if self.first is None else {self.first[0]: self.first[1]}
        quality = [cv2.IMWRITE_JPEG_QUALITY, 80]
        return {
            number: cv2.imencode(".jpg", to_eight_bits(image), quality)[1].tobytes() for number, image in kept.items()
        }
