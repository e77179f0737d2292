"""Correct dots that are truncated at the image border, where a fit sees only a part of them.

If an outline is drawn by hand, a part of it gives a wrong centre: by up to pixels, depending on how irregular the
outline is, and with almost no residual. But the same part always gives the same error. The last frame that showed the
dot completely is therefore truncated alike, and the fit to it gives the error.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rafl.tracking.detection.appearance import MAX_CENTRE_SIGMA
from rafl.tracking.detection.detect import CORRELATED_VARIANCE_RATIO, Dots, fit_dots

Array = NDArray[Any]

EDGE_SIGMAS = 3.0  # sigmas of the blurred edge: this much of it belongs to the outline
VIEW_RADII = 3.0  # a view reaches this many radii from the dot's centre
VIEW_MARGIN = 10.0  # px: and this much farther
REMAINING_ERROR = 1.0 / 3.0  # fraction of the correction: the dot may have turned or come nearer since the view
ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)


@dataclass(frozen=True)
class _View:
    """The last complete view of a dot.

    Attributes:
        image: of the dot and its surroundings [grey levels], (H, W).
        starts: parameters of its disc and of the discs beside it in this image, (K, 12).
    """

    image: Array
    starts: Array

    @classmethod
    def of(cls, image: Array, dots: Dots, row: int) -> "_View":
        """The view of one of the dots in a frame."""
        centre = dots.centre[row]
        reach = VIEW_RADII * dots.radius[row] + VIEW_MARGIN
        left, top = np.maximum(np.rint(centre - reach), 0).astype(int)
        right, bottom = np.rint(centre + reach).astype(int)
        distance = np.abs(dots.centre - centre).max(axis=1) - dots.radius
        beside = np.isfinite(dots.sigma[:, 0]) & (distance < reach)
        beside[row] = False
        starts = np.concatenate([dots.parameters[row : row + 1], dots.parameters[beside]])
        starts[:, :2] -= left, top
        return cls(image[top : bottom + 1, left : right + 1].copy(), starts)

    def error(self, centre: Array, size: Array) -> tuple[Array, Array]:
        """The fit's error when the border truncates the dot, and its sigma [px], (2) each; NaN if the fit fails.

        Args:
            centre: of the dot in the frame whose border truncates it [px], (2).
            size: width and height of that frame [px].
        """
        position = self.starts[0, :2]
        low = np.maximum(np.rint(position - centre), 0).astype(int)
        high = np.minimum(np.rint(position + size - centre), self.image.shape[::-1]).astype(int)
        if (high - low < 2).any():
            return np.full(2, np.nan), np.full(2, np.nan)
        starts = self.starts.copy()
        starts[:, :2] -= low
        dots = fit_dots(np.ascontiguousarray(self.image[low[1] : high[1], low[0] : high[0]]), starts, 1)
        return dots.centre[0] + low - position, dots.sigma[0]


@dataclass
class CompleteViews:
    """The last complete views of one camera's markers; they correct the positions of truncated dots.

    Attributes:
        views: of irregular markers that were complete and are not any more, (M).
        complete: which markers the last frame showed completely, (M).
        last: the last frame and its dots.
    """

    views: list[_View | None]
    complete: NDArray[np.bool_]
    last: tuple[Array, Dots] | None = field(default=None)

    @classmethod
    def empty(cls, count: int) -> "CompleteViews":
        """For this many markers that have not been seen yet."""
        return cls([None] * count, np.zeros(count, bool))

    def add_marker(self) -> None:
        """Add a marker that has not been seen completely yet."""
        self.views.append(None)
        self.complete = np.append(self.complete, False)

    def correct(self, image: Array, dots: Dots) -> Dots:
        """Return the next frame's dots (M), truncated ones corrected; sigma is NaN where that is impossible."""
        truncated = _are_truncated(dots.parameters, *image.shape)
        seen = dots.sigma[:, 0] == dots.sigma[:, 0]
        complete = seen & ~truncated
        lost = self.complete & ~complete
        if self.last is not None and lost.any():
            irregular = _are_irregular(self.last[1])
            for row in np.flatnonzero(lost):
                self.views[row] = _View.of(*self.last, int(row)) if irregular[row] else None
        if (seen & truncated).any():
            dots = self._correct(image, dots, seen & truncated)
        self.complete, self.last = complete, (image, dots)
        return dots

    def _correct(self, image: Array, dots: Dots, truncated: NDArray[np.bool_]) -> Dots:
        unknown = np.array([view is None for view in self.views])
        sigma = np.where((truncated & unknown)[:, None], truncated_dots(image, dots).sigma, dots.sigma)
        parameters = dots.parameters.copy()
        size = np.array(image.shape[::-1])
        for row in np.flatnonzero(truncated & ~unknown):
            view = self.views[row]
            assert view is not None
            error, error_sigma = view.error(dots.centre[row], size)
            if np.isfinite(error_sigma).all():  # again, truncated at the corrected position
                error, error_sigma = view.error(dots.centre[row] - error, size)
            remaining = REMAINING_ERROR * np.hypot(*error)
            sigma[row] = np.sqrt(sigma[row] ** 2 + error_sigma**2 + remaining**2)
            parameters[row] = view.starts[0]  # the next fit starts from these: a truncated dot says little of its shape
            parameters[row, :2] = dots.centre[row] - error
        return _without_uncertain(replace(dots, centre=parameters[:, :2], parameters=parameters, sigma=sigma), size)


def truncated_dots(image: Array, dots: Dots) -> Dots:
    """Return dots (D) that were never seen completely; truncated ones of irregular outline get a larger sigma or NaN.

    If half of an outline is visible, the residual shows a quarter of the error that neighbouring pixels share. This was
    found with outlines irregular by 2 to 12 % of the radius.
    """
    sigma = dots.sigma.copy()
    height, width = image.shape
    for row in np.flatnonzero(_are_truncated(dots.parameters, height, width) & _are_irregular(dots)):
        a, b, c = dots.parameters[row, 2:5]
        x, y = np.linalg.solve([[a, b], [b, c]], [np.cos(ANGLES), np.sin(ANGLES)]) + dots.centre[row][:, None]
        visible = np.mean((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))
        sigma[row] /= max(visible, 0.1) ** 2
    return _without_uncertain(replace(dots, sigma=sigma), np.array((width, height)))


def _are_irregular(dots: Dots) -> NDArray[np.bool_]:
    """Which dots (D) have residuals that neighbouring pixels share."""
    independent = (dots.noise_gain * (dots.residual * np.abs(dots.contrast))[:, None]) ** 2
    return np.asarray((dots.sigma**2).sum(axis=1) > CORRELATED_VARIANCE_RATIO * independent.sum(axis=1))


def _without_uncertain(dots: Dots, size: Array) -> Dots:
    """Set sigma to NaN where the centre is outside a frame of this width and height or where sigma is too large."""
    inside = (dots.centre > -0.5) & (dots.centre < size - 0.5)
    good = np.all(inside & (dots.sigma < MAX_CENTRE_SIGMA), axis=1, keepdims=True)
    return replace(dots, sigma=np.where(good, dots.sigma, np.nan))


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
