"""When the load leaves: the first frame of the free motion, and the stretch of rest before it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SUDDEN = 0.3  # of the largest lasting acceleration: what the load's leaving causes at once
LASTING = 9  # frames
STILL = 3.0  # times the noise: how far markers may be from where they rest
LONGEST = 50  # frames that are averaged at most: in longer ones hands tire and silicone creeps


@dataclass(frozen=True)
class Release:
    """Where the free motion of a recording begins.

    Attributes:
        start: the frame nearest to the load's leaving.
        still: first frame of the stretch of rest that ends there; equals `start` where there is none.
    """

    start: int
    still: int


def find_release(position: Array, start: int | None = None) -> Release:
    """From the motion: the frame nearest to when markers are first accelerated suddenly.

    A load that leaves between two frames, a share f of their distance after the first, makes the second differences
    around these frames a (1 - f)^2 / 2 and a (2 - f^2) / 2 with a the acceleration; their ratio gives f.

    Args:
        position: of the markers [m], (T, M, 3), NaN where missing; even in time.
        start: where it is known; then only the stretch of rest is sought.
    """
    change = _second_differences(position)
    if start is not None:
        return Release(start, _rest_before(position, start, change))
    lasting = _lasting(change)
    if not lasting.max() > 0.0:
        return Release(0, 0)
    sudden = int(np.argmax(np.minimum(np.nan_to_num(change), lasting) > SUDDEN * lasting.max()))
    before = max(sudden - 1, 0)
    small, large = float(np.nan_to_num(change[before])), float(change[sudden])
    share = np.linspace(0.0, 1.0, 201)
    late = share[np.argmin(np.abs((1.0 - share) ** 2 / (2.0 - share**2) - min(small / large, 0.5)))]
    start = before + int(late >= 0.5) if sudden > 0 else 0
    return Release(start, _rest_before(position, start, change))


def _second_differences(position: Array) -> Array:
    """Root mean square over markers of each frame's second difference [m], (T); the specimen rests before frame 0."""
    padded = np.concatenate([position[:1], position])
    change = np.linalg.norm(padded[2:] - 2.0 * padded[1:-1] + padded[:-2], axis=2)
    seen = np.isfinite(change)
    count = seen.sum(axis=1)
    size = np.sqrt((np.where(seen, change, 0.0) ** 2).sum(axis=1) / np.maximum(count, 1))
    return np.append(np.where(count > 0, size, np.nan), np.nan)


def _lasting(change: Array) -> Array:
    """Median over a frame and those after it: single wrong frames do not count."""
    padded = np.append(np.nan_to_num(change), np.zeros(LASTING - 1))
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, LASTING), axis=1)


def _rest_before(position: Array, start: int, change: Array) -> int:
    """The first frame from which on markers stay, within noise, where they are just before the start."""
    quiet = change[1 : max(start - 1, 1)]
    if not np.isfinite(quiet).any():
        return start
    noise = float(np.nanmedian(quiet)) / np.sqrt(6.0)
    latest = position[max(start - 3, 0) : start]
    seen = np.isfinite(latest)
    with np.errstate(invalid="ignore"):
        place = np.where(seen, latest, 0.0).sum(axis=0) / seen.sum(axis=0)  # NaN where never seen
    first = start
    for frame in range(start - 1, max(start - LONGEST, 0) - 1, -1):
        away = np.linalg.norm(position[frame] - place, axis=1)
        away = away[np.isfinite(away)]
        if len(away) and np.sqrt((away**2).mean()) > STILL * noise:
            break
        first = frame
    return first
