"""How well dots were really located: what one picture cannot tell about itself.

Compression moves whole dots a little, most where the picture changes slowly, and leaves no trace in
the fit. But markers ride on one body: what a marker's path has that the others' do not is error.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Errors of coded pictures beside those that independent errors of one step in each pixel would make: along an axis in
# which the marker keeps still, and along its way, where the encoder lets it lag. Measured on libx264, crf 18 to 28,
# dots of 8 px; its quickest presets lag twice as far.
STILL, LAGGING = 0.45, 1.0
FEWEST_FRAMES, FEWEST_MARKERS = 40, 8
MODES = 12  # of the body's motion, at most
MANY = 1500  # frames, evenly chosen, are enough
TELLING = 0.3  # of a fit's variance: an excess smaller than this may be chance


def with_shared_errors(pixel: Array, sigma: Array) -> Array:
    """Standard deviations (T, D, 2) that also hold what a marker's path has beyond its fits' errors.

    Each marker is predicted from the modes in which the others move. Left as they are where too few
    frames or markers tell.

    Args:
        pixel: paths [px], (T, D, 2), NaN where not seen.
        sigma: from the fits [px], (T, D, 2).
    """
    seen = np.isfinite(sigma[..., 0])
    markers = np.flatnonzero(seen.mean(axis=0) > 0.8)
    frames = np.flatnonzero(seen[:, markers].all(axis=1)) if len(markers) else np.zeros(0, int)
    if len(frames) < FEWEST_FRAMES or len(markers) < FEWEST_MARKERS:
        return sigma
    frames = frames[:: max(len(frames) // MANY, 1)]
    path = pixel[np.ix_(frames, markers)]
    path = path - path.mean(axis=0)
    count = min(MODES, len(frames) // 4, len(markers) // 2)
    excess = np.zeros((len(markers), 2))
    for k in range(len(markers)):
        others = np.delete(path, k, axis=1).reshape(len(frames), -1)
        square, modes = np.linalg.eigh(others.T @ others)  # ascending
        size = np.sqrt(np.maximum(square[-count:], 1e-12 * square[-1]))
        basis = others @ modes[:, -count:] / size
        gain = basis.T @ path[:, k]
        missed = ((path[:, k] - basis @ gain) ** 2).sum(axis=0) / (len(frames) - count)
        # The modes carry the others' errors too.
        carried = 1.0 + (gain**2 / size[:, None] ** 2).sum(axis=0)
        own = (sigma[np.ix_(frames, markers[k : k + 1])][:, 0] ** 2).mean(axis=0)
        beyond = missed / carried - own
        excess[k] = np.where(beyond > TELLING * own, beyond, 0.0)
    added = np.zeros((sigma.shape[1], 2))
    added[:] = np.median(excess, axis=0)
    added[markers] = excess
    return np.sqrt(sigma**2 + added)


def with_coding_errors(pixel: Array, sigma: Array, leverage: Array, step: Array) -> Array:
    """Standard deviations (T, D, 2) no smaller than what the coding of the pictures leads one to expect.

    An encoder passes over changes below its step: a dot that moves a little stays where it was, and the picture it
    leaves is clean, so that the fit does not show it.

    Args:
        pixel: paths [px], (T, D, 2), NaN where not seen.
        sigma: so far [px], (T, D, 2).
        leverage: what a grey level of independent noise in every pixel moves a centre by [px], (T, D, 2), NaN where
            not known.
        step: by which the picture was rounded there [grey levels], (T, D), NaN where not known: as in other frames.
    """
    told = np.isfinite(step)
    square = np.nansum(step**2, axis=0) / np.maximum(told.sum(axis=0), 1)
    usual = np.where(told.any(axis=0), square, np.nansum(step**2) / max(told.sum(), 1)) ** 0.5
    still = STILL * np.nan_to_num(leverage * np.where(told, step, usual)[..., None])
    count = np.maximum(np.isfinite(pixel).sum(axis=0), 1)
    mean = np.nansum(pixel, axis=0) / count
    spread = np.nansum((pixel - mean) ** 2, axis=0) / count
    moves = spread > 4.0 * (still**2).sum(axis=0) / count
    return np.maximum(sigma, np.where(moves, LAGGING / STILL, 1.0) * still)
