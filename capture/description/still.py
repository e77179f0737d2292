"""The dots of a recording at rest: their mean positions while nothing moves."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.registration.recording import Recording
from rafl.capture.registration.registration import average_frames
from rafl.capture.registration.release import REST_NOISE_FACTOR, find_release
from rafl.capture.registration.rigid import MIN_MARKERS
from rafl.common.errors import InputError

Array = NDArray[Any]

MIN_REST_FRAMES = 3  # before a release


@dataclass(frozen=True)
class Dots:
    """Dots of a specimen at rest.

    Attributes:
        names: in the file, or numbers from 1 where it has none, (M).
        position: [m], (M, 3).
        sigma: standard deviations of the positions [m], (M, 3).
    """

    names: tuple[str, ...]
    position: Array
    sigma: Array

    def select(self, chosen: NDArray[np.bool_]) -> "Dots":
        """The dots where `chosen` (M) is true."""
        names = tuple(name for name, kept in zip(self.names, chosen, strict=True) if kept)
        return Dots(names, self.position[chosen], self.sigma[chosen])


def dots_at_rest(recording: Recording, label: str) -> Dots:
    """Mean positions over all frames if nothing moves, else over the rest before the first sudden motion.

    Args:
        recording: in any frame of reference.
        label: of the recording, for messages.

    Raises:
        InputError: the specimen never rests, or fewer than three dots are seen.
    """
    frames = _frames_at_rest(recording)
    if frames.stop - frames.start < MIN_REST_FRAMES and len(recording.position) >= MIN_REST_FRAMES:
        raise InputError(
            f"{label}: expected a specimen that rests, found it moving in all {len(recording.position)} frames; film "
            "it again once it hangs still"
        )
    position, sigma = average_frames(recording.position[frames], recording.sigma[frames])
    names = recording.names or tuple(str(number + 1) for number in range(len(position)))
    dots = Dots(names, position, sigma).select(np.isfinite(position[:, 0]))
    if len(dots.names) < MIN_MARKERS:
        raise InputError(
            f"{label}: expected at least {MIN_MARKERS} dots, found {len(dots.names)}; check that the tracks show the "
            "specimen's dots"
        )
    return dots


def _frames_at_rest(recording: Recording) -> slice:
    """All frames if the dots stay, within noise, at their median positions; else those at rest before the release."""
    position = recording.position
    everything = slice(0, len(position))
    seen = np.isfinite(position[..., 0]).any(axis=0)
    if len(position) < MIN_REST_FRAMES or not seen.any():
        return everything
    position, sigma = position[:, seen], recording.sigma[:, seen]
    distance = _root_mean_square(position - np.nanmedian(position, axis=0))
    change = _root_mean_square(np.diff(position, 2, axis=0))
    scatter = np.median(change[np.isfinite(change)]) / np.sqrt(6.0) if np.isfinite(change).any() else 0.0
    # A lossy video may repeat an error from frame to frame, so that the scatter is less than the error.
    error = np.sqrt(3.0) * np.nanmedian(np.where(np.isfinite(position), sigma, np.nan).min(axis=2))
    if not (distance > REST_NOISE_FACTOR * max(scatter, error)).any():
        return everything
    release = find_release(position)
    return slice(release.rest_start, release.start)


def _root_mean_square(vectors: Array) -> Array:
    """Root mean square length over the dots of each frame, (T), of (T, M, 3); NaN where all are missing."""
    square = (vectors**2).sum(axis=2)
    known = np.isfinite(square)
    count = known.sum(axis=1)
    mean = np.where(known, square, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.asarray(np.where(count > 0, np.sqrt(mean), np.nan))
