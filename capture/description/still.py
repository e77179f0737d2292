"""The dots of a recording at rest: their mean positions while nothing moves."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.registration.averaging import average_recording
from rafl.capture.registration.recording import Recording
from rafl.capture.registration.rigid import MIN_MARKERS, RigidTransform
from rafl.capture.release.release import REST_NOISE_FACTOR, find_release
from rafl.common.errors import InputError

Array = NDArray[Any]

MIN_REST_FRAMES = 3  # before a release


@dataclass(frozen=True)
class Dots:
    """Dots of a specimen at rest.

    Attributes:
        names: in the file, or numbers from 1 where it has none, (M).
        position: [m], (M, 3).
        axes: unit vectors along which each dot was measured, the rows of (M, 3, 3). Where one camera saw it, the last
            is the line of sight, away from the camera.
        sigma: standard deviations of the positions along the axes [m], (M, 3); infinite where not measured.
    """

    names: tuple[str, ...]
    position: Array
    axes: Array
    sigma: Array

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Along which axes each dot was measured, (M, 3)."""
        return np.isfinite(self.sigma)

    def precision(self, model_sigma: float = 0.0) -> Array:
        """Inverse covariances of the positions [1/m^2], (M, 3, 3), of rank 2 where one camera saw the dot.

        model_sigma: adds to the standard deviations [m].
        """
        scaled = self.axes / np.hypot(self.sigma, model_sigma)[..., None]
        return np.asarray(scaled.swapaxes(1, 2) @ scaled)

    def select(self, chosen: NDArray[np.bool_]) -> "Dots":
        """The dots where `chosen` (M) is true."""
        names = tuple(name for name, kept in zip(self.names, chosen, strict=True) if kept)
        return Dots(names, self.position[chosen], self.axes[chosen], self.sigma[chosen])

    def moved(self, pose: RigidTransform) -> "Dots":
        """The dots after a rigid motion."""
        return replace(self, position=pose.apply(self.position), axes=self.axes @ pose.rotation.T)


def dots_at_rest(recording: Recording, label: str) -> Dots:
    """Mean positions over the frames at rest: most of them, or those before the first sudden motion.

    Args:
        recording: in any frame of reference.
        label: of the recording, for messages.

    Raises:
        InputError: the specimen never rests, or fewer than three dots are seen.
    """
    frames, count = _frames_at_rest(recording), len(recording.position)
    if frames.sum() < min(MIN_REST_FRAMES, count):
        raise InputError(
            f"{label}: expected a specimen that rests, found no rest in most of its {count} frames, nor before a "
            "release; film it again once it hangs still"
        )
    position, axes, sigma = average_recording(recording, frames)
    names = recording.names or tuple(str(number + 1) for number in range(len(position)))
    dots = Dots(names, position, axes, sigma).select(np.isfinite(position[:, 0]))
    if len(dots.names) < MIN_MARKERS:
        raise InputError(
            f"{label}: expected at least {MIN_MARKERS} dots, found {len(dots.names)}; check that the tracks show the "
            "specimen's dots"
        )
    return dots


def _frames_at_rest(recording: Recording) -> NDArray[np.bool_]:
    """Frames in which the dots are, within noise, at their median positions; if few, those at rest before a release."""
    position = recording.position
    seen = np.isfinite(position[..., 0]).any(axis=0)
    if len(position) < MIN_REST_FRAMES or not seen.any():
        return np.ones(len(position), bool)
    position, sigma = position[:, seen], recording.sigma[:, seen]
    distance = _root_mean_square(position - np.nanmedian(position, axis=0))
    change = _root_mean_square(np.diff(position, 2, axis=0))
    scatter = np.median(change[np.isfinite(change)]) / np.sqrt(6.0) if np.isfinite(change).any() else 0.0
    # A lossy video may repeat an error from frame to frame, so that the scatter is less than the error.
    error = np.sqrt(3.0) * np.nanmedian(np.where(np.isfinite(position), sigma, np.nan).min(axis=2))
    moved: NDArray[np.bool_] = distance > REST_NOISE_FACTOR * max(scatter, error)
    if moved.mean() < 0.5:
        return ~moved
    release, rest = find_release(position), np.zeros(len(position), bool)
    rest[release.rest_start : release.start] = True
    return rest


def _root_mean_square(vectors: Array) -> Array:
    """Root mean square length over the dots of each frame, (T), of (T, M, 3); NaN where all are missing."""
    square = (vectors**2).sum(axis=2)
    known = np.isfinite(square)
    count = known.sum(axis=1)
    mean = np.where(known, square, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.asarray(np.where(count > 0, np.sqrt(mean), np.nan))
