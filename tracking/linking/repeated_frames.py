"""Frames that show the frame before again, as a camera or a capture program does that lost some."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# "Step" below: root mean square, over the dots, of their motion from one frame to the next, relative to its sigma. Two
# exposures differ by a step of about 1, or less where a codec copies a part of the frame before.
MAX_REPEATED_STEP = 0.2  # of a frame shown again; encoding it again gave up to 0.03
MIN_MOVING_STEP = 5.0  # of a body that moves without doubt
MIN_COMMON_DOTS = 3  # that both frames of a step must show


def find_repeated_frames(pixel: Array, sigma: Array) -> NDArray[np.bool_]:
    """Frames without any motion amid a motion, (T).

    A body that moves does not stand still from one frame to the next, and then go on. Where it turns it may seem to,
    for one step, and moves the other way afterwards. A body at rest is left alone: no motion surrounds its rest.

    Args:
        pixel: positions of one camera's dots [px], (T, D, 2), NaN where not measured.
        sigma: along x and y [px], (T, D, 2).
    """
    motion = np.diff(pixel, axis=0)
    relative = motion / np.hypot(sigma[1:], sigma[:-1])
    known = np.isfinite(relative.sum(axis=2))
    count = known.sum(axis=1)
    squares = np.where(known[..., None], relative, 0.0) ** 2
    step = np.sqrt(squares.sum(axis=(1, 2)) / np.maximum(2 * count, 1))
    step[count < MIN_COMMON_DOTS] = np.nan
    still = step < MAX_REPEATED_STEP
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    repeated = np.zeros(len(pixel), bool)
    for first, end in edges.reshape(-1, 2):  # of the steps without motion; `end` is the first one after them
        if first == 0 or not step[first - 1] > MIN_MOVING_STEP:
            continue
        if end == len(step):  # the video ends
            goes_on = end - first > 1
        else:
            onwards = np.nansum(motion[first - 1] * motion[end]) > 0.0
            goes_on = step[end] > MIN_MOVING_STEP and (end - first > 1 or onwards)
        repeated[first + 1 : end + 1] = goes_on
    return repeated
