"""Dots that the image border truncates, of which a fit sees only a part.

A part of a disc or an ellipse gives its centre. A part of an outline that a hand drew gives a wrong one: by up to
pixels, depending on how irregular the outline is, and with almost no residual.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rafl.tracking.detection.appearance import MAX_CENTRE_SIGMA
from rafl.tracking.detection.detect import CORRELATED_VARIANCE_RATIO, Dots

Array = NDArray[Any]

EDGE_SIGMAS = 3.0  # sigmas of the blurred edge: this much of it belongs to the outline
ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)


def with_truncation_error(shape: tuple[int, int], dots: Dots) -> Dots:
    """Dots (D) of a frame; truncated ones of irregular outline get a larger sigma, or NaN where it is too large.

    If half of an outline is visible, the residual shows a quarter of the error that neighbouring pixels share. This was
    found with outlines irregular by 2 to 12 % of the radius.

    Args:
        shape: height and width of the frame.
        dots: in it.
    """
    height, width = shape
    truncated = _are_truncated(dots.parameters, height, width)
    if not truncated.any():
        return dots
    sigma = dots.sigma.copy()
    for row in np.flatnonzero(truncated & _are_irregular(dots)):
        a, b, c = dots.parameters[row, 2:5]
        x, y = np.linalg.solve([[a, b], [b, c]], [np.cos(ANGLES), np.sin(ANGLES)]) + dots.centre[row][:, None]
        visible = np.mean((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))
        sigma[row] /= max(visible, 0.1) ** 2
    inside = (dots.centre > -0.5) & (dots.centre < np.array((width, height)) - 0.5)
    good = ~truncated | np.all(inside & (sigma < MAX_CENTRE_SIGMA), axis=1)
    return replace(dots, sigma=np.where(good[:, None], sigma, np.nan))


def _are_irregular(dots: Dots) -> NDArray[np.bool_]:
    """Which dots (D) have residuals that neighbouring pixels share."""
    independent = (dots.noise_gain * (dots.residual * np.abs(dots.contrast))[:, None]) ** 2
    return np.asarray((dots.sigma**2).sum(axis=1) > CORRELATED_VARIANCE_RATIO * independent.sum(axis=1))


@njit(cache=True, error_model="numpy")
def _are_truncated(parameters: Array, height: int, width: int) -> NDArray[np.bool_]:
    """Which discs (D, 12) reach, with their blurred edge, beyond the border of a frame, (D)."""
    truncated = np.zeros(len(parameters), np.bool_)
    for k in range(len(parameters)):
        x, y, a, b, c = parameters[k, 0], parameters[k, 1], parameters[k, 2], parameters[k, 3], parameters[k, 4]
        determinant = abs(a * c - b * b)
        half_width = np.hypot(b, c) / determinant + EDGE_SIGMAS * np.sqrt(parameters[k, 5])
        half_height = np.hypot(a, b) / determinant + EDGE_SIGMAS * np.sqrt(parameters[k, 7])
        truncated[k] = x < half_width or y < half_height or x > width - 1 - half_width or y > height - 1 - half_height
    return truncated
