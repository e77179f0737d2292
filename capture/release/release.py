"""The release of the load: the first frame of the free motion, and the interval of rest before it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

RELEASE_ACCELERATION_FRACTION = 0.3  # of the largest sustained acceleration; the release exceeds it at once
MEDIAN_WINDOW_FRAMES = 9  # an acceleration is sustained if the median over this window is large
REST_NOISE_FACTOR = 3.0  # at rest, markers stay within this multiple of the noise
MIN_REST_FRAMES = 3  # any frame is where it is, and two may be on either side of a turning point
MAX_REST_FRAMES = 50  # averaged at most: over a longer time hands tire and silicone creeps


@dataclass(frozen=True)
class Release:
    """Where the free motion of a recording begins.

    Attributes:
        start: frame nearest to the release of the load.
        rest_start: first frame of the interval of rest that ends at `start`; equals `start` if there is none.
    """

    start: int
    rest_start: int


def find_release(position: Array, start: int | None = None) -> Release:
    """Find the frame nearest to the first sudden acceleration of the markers.

    If the load is released between two frames, at a fraction f of their interval, the second differences at these
    frames are a (1 - f)^2 / 2 and a (2 - f^2) / 2, where a is the acceleration. Their ratio gives f.

    Args:
        position: marker positions [m], (T, M, 3), NaN where missing; evenly spaced in time.
        start: release frame if known; then only the interval of rest is searched.
    """
    change = _second_differences(position)
    if start is not None:
        return Release(start, _rest_start(position, start, change))
    quiet = change
    change = np.sqrt(np.maximum(change**2 - _noise_of_differences(position) ** 2, 0.0))
    sustained = _sustained_change(change)
    if not sustained.max() > 0.0:
        return Release(0, 0)
    threshold = RELEASE_ACCELERATION_FRACTION * sustained.max()
    sudden = int(np.argmax(np.minimum(np.nan_to_num(change), sustained) > threshold))
    before = max(sudden - 1, 0)
    small, large = float(np.nan_to_num(change[before])), float(change[sudden])
    f = np.linspace(0.0, 1.0, 201)
    best = f[np.argmin(np.abs((1.0 - f) ** 2 / (2.0 - f**2) - min(small / large, 0.5)))]
    start = before + int(best >= 0.5) if sudden > 0 else 0
    return Release(start, _rest_start(position, start, quiet))


def _second_differences(position: Array) -> Array:
    """Root mean square over markers of each frame's second difference [m], (T); at rest before frame 0."""
    return np.append(_rms_over_markers(np.diff(np.concatenate([position[:1], position]), n=2, axis=0)), np.nan)


def _noise_of_differences(position: Array) -> float:
    """Part of the second differences [m] that is noise, by the fourth ones, in which a smooth motion hardly shows.

    Of independent errors, the second differences have 6 times the variance, the fourth 70 times. 0 if all are missing.
    """
    fourth = _rms_over_markers(np.diff(position, n=4, axis=0))
    return float(np.nanmedian(fourth)) * np.sqrt(6.0 / 70.0) if np.isfinite(fourth).any() else 0.0


def _rms_over_markers(difference: Array) -> Array:
    """Root mean square over the measured markers (T, M, 3) of each frame [m], (T); NaN if none is measured."""
    length = np.linalg.norm(difference, axis=2)
    measured = np.isfinite(length)
    count = measured.sum(axis=1)
    rms = np.sqrt((np.where(measured, length, 0.0) ** 2).sum(axis=1) / np.maximum(count, 1))
    return np.asarray(np.where(count > 0, rms, np.nan))


def _sustained_change(change: Array) -> Array:
    """Median over each frame and those after it (T), so that single wrong frames do not count.

    After the end the specimen is taken to rest. Frames without markers do not count.
    """
    padded = np.append(change[:-1], np.zeros(MEDIAN_WINDOW_FRAMES))
    windows = np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_WINDOW_FRAMES)
    known = np.isfinite(windows).any(axis=1)
    median = np.zeros(len(windows))
    median[known] = np.nanmedian(windows[known], axis=1)
    return median


def _rest_start(position: Array, start: int, change: Array) -> int:
    """First frame from which on the markers are seen and stay, within noise, at their positions just before `start`."""
    quiet = change[1 : max(start - 1, 1)]
    if not np.isfinite(quiet).any():
        return start
    noise = float(np.nanmedian(quiet)) / np.sqrt(6.0)
    latest = position[max(start - MIN_REST_FRAMES, 0) : start]
    measured = np.isfinite(latest)
    with np.errstate(invalid="ignore"):
        rest = np.where(measured, latest, 0.0).sum(axis=0) / measured.sum(axis=0)  # NaN for markers never measured
    first = start
    for frame in range(start - 1, max(start - MAX_REST_FRAMES, 0) - 1, -1):
        distance = np.linalg.norm(position[frame] - rest, axis=1)
        distance = distance[np.isfinite(distance)]
        if not len(distance) or np.sqrt((distance**2).mean()) > REST_NOISE_FACTOR * noise:
            break
        first = frame
    return first if start - first >= MIN_REST_FRAMES else start
