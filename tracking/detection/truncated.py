"""Dots cut by the picture's edge, of which a fit sees a part only.

What a part of an outline drawn by hand seems to say of the centre is as wrong as the outline is irregular, up to
pixels, and leaves next to no residual. But the same part is wrong in the same way: the picture that showed the dot
whole for the last time, cut alike, tells by how much.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rafl.tracking.detection.appearance import WORST_SIGMA
from rafl.tracking.detection.detect import SHARED_NOISE, Dots, fit_dots

Array = NDArray[Any]

BLURRED = 3.0  # standard deviations of the edge: so much of it belongs to the outline
WIDE, BESIDE = 3.0, 10.0  # radii and px about a dot's centre that are kept of a picture
TURNED = 1.0 / 3.0  # of the error told, that may be left: a dot turns, or comes nearer, after it was seen whole
ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)


@dataclass(frozen=True)
class _Look:
    """A dot as it was last seen whole.

    Attributes:
        picture: of its surroundings, grey levels.
        starts: its disc and those beside it there, (K, 12).
    """

    picture: NDArray
    starts: Array

    @classmethod
    def of(cls, image: NDArray, dots: Dots, row: int) -> "_Look":
        """Of one of these dots."""
        centre = dots.centre[row]
        reach = WIDE * dots.radius[row] + BESIDE
        left, top = np.maximum(np.rint(centre - reach), 0).astype(int)
        right, bottom = np.rint(centre + reach).astype(int)
        away = np.abs(dots.centre - centre).max(axis=1) - dots.radius
        beside = np.isfinite(dots.sigma[:, 0]) & (away < reach)
        beside[row] = False
        starts = np.concatenate([dots.parameters[row : row + 1], dots.parameters[beside]])
        starts[:, :2] -= left, top
        return cls(image[top : bottom + 1, left : right + 1].copy(), starts)

    def error(self, centre: Array, size: Array) -> tuple[Array, Array]:
        """What a fit to it is off by where a picture's edge cuts it, and its sigma [px], (2) each; NaN if it fails.

        Args:
            centre: of the dot in that picture [px], (2).
            size: width and height of that picture.
        """
        place = self.starts[0, :2]
        low = np.maximum(np.rint(place - centre), 0).astype(int)
        high = np.minimum(np.rint(place + size - centre), self.picture.shape[::-1]).astype(int)
        if (high - low < 2).any():
            return np.full(2, np.nan), np.full(2, np.nan)
        starts = self.starts.copy()
        starts[:, :2] -= low
        dots = fit_dots(np.ascontiguousarray(self.picture[low[1] : high[1], low[0] : high[0]]), starts, 1)
        return dots.centre[0] + low - place, dots.sigma[0]


@dataclass
class WholeLooks:
    """The last whole looks of a camera's markers, and what they say of those that the picture's edge cuts.

    Attributes:
        looks: of irregular markers that were seen whole and are not any more, (M).
        whole: which were in the last picture, (M).
        last: that picture and its dots.
    """

    looks: list[_Look | None]
    whole: NDArray[np.bool_]
    last: tuple[NDArray, Dots] | None = field(default=None)

    @classmethod
    def none(cls, count: int) -> "WholeLooks":
        """Of as many markers that were not seen yet."""
        return cls([None] * count, np.zeros(count, bool))

    def join(self) -> None:
        """One more marker, not seen whole yet."""
        self.looks.append(None)
        self.whole = np.append(self.whole, False)

    def judge(self, image: NDArray, dots: Dots) -> Dots:
        """The dots (M) of the next picture, those that its edge cuts put right; sigma NaN where that cannot be."""
        cut = _cut(dots.parameters, *image.shape)
        shown = dots.sigma[:, 0] == dots.sigma[:, 0]
        whole = shown & ~cut
        gone = self.whole & ~whole
        if self.last is not None and gone.any():
            irregular = _irregular(self.last[1])
            for row in np.flatnonzero(gone):
                self.looks[row] = _Look.of(*self.last, int(row)) if irregular[row] else None
        if (shown & cut).any():
            dots = self._put_right(image, dots, shown & cut)
        self.whole, self.last = whole, (image, dots)
        return dots

    def _put_right(self, image: NDArray, dots: Dots, cut: NDArray[np.bool_]) -> Dots:
        unknown = np.array([look is None for look in self.looks])
        sigma = np.where((cut & unknown)[:, None], doubted(image, dots).sigma, dots.sigma)
        parameters = dots.parameters.copy()
        size = np.array(image.shape[::-1])
        for row in np.flatnonzero(cut & ~unknown):
            look = self.looks[row]
            assert look is not None
            error, own = look.error(dots.centre[row], size)
            if np.isfinite(own).all():  # again, by where the edge really cuts it
                error, own = look.error(dots.centre[row] - error, size)
            left = TURNED * np.hypot(*error)
            sigma[row] = np.sqrt(sigma[row] ** 2 + own**2 + left**2)
            parameters[row] = look.starts[0]  # from which the next fit starts: a part of it says little of its shape
            parameters[row, :2] = dots.centre[row] - error
        return _half_seen(replace(dots, centre=parameters[:, :2], parameters=parameters, sigma=sigma), size)


def doubted(image: NDArray, dots: Dots) -> Dots:
    """Dots (D) never seen whole: those that the edge cuts get a larger sigma where they are irregular, or NaN.

    Where half of an outline is seen, errors that neighbouring pixels share show a quarter of their size in the residual
    (found with outlines irregular by 2 to 12 % of the radius).
    """
    sigma = dots.sigma.copy()
    height, width = image.shape
    for row in np.flatnonzero(_cut(dots.parameters, height, width) & _irregular(dots)):
        a, b, c = dots.parameters[row, 2:5]
        x, y = np.linalg.solve([[a, b], [b, c]], [np.cos(ANGLES), np.sin(ANGLES)]) + dots.centre[row][:, None]
        seen = np.mean((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))
        sigma[row] /= max(seen, 0.1) ** 2
    return _half_seen(replace(dots, sigma=sigma), np.array((width, height)))


def _irregular(dots: Dots) -> NDArray[np.bool_]:
    """Dots (D) whose residuals neighbouring pixels share."""
    white = (dots.leverage * (dots.residual * np.abs(dots.contrast))[:, None]) ** 2
    return np.asarray((dots.sigma**2).sum(axis=1) > SHARED_NOISE * white.sum(axis=1))


def _half_seen(dots: Dots, size: Array) -> Dots:
    """The same, sigma NaN where the centre is out of a picture of that width and height, or is known too badly."""
    inside = (dots.centre > -0.5) & (dots.centre < size - 0.5)
    good = np.all(inside & (dots.sigma < WORST_SIGMA), axis=1, keepdims=True)
    return replace(dots, sigma=np.where(good, dots.sigma, np.nan))


@njit(cache=True, error_model="numpy")
def _cut(parameters, height, width):
    """Which discs (D, 12) reach beyond a picture's edge, with their blur, (D)."""
    cut = np.zeros(len(parameters), np.bool_)
    for k in range(len(parameters)):
        x, y, a, b, c = parameters[k, 0], parameters[k, 1], parameters[k, 2], parameters[k, 3], parameters[k, 4]
        determinant = abs(a * c - b * b)
        across = np.hypot(b, c) / determinant + BLURRED * np.sqrt(parameters[k, 5])
        along = np.hypot(a, b) / determinant + BLURRED * np.sqrt(parameters[k, 7])
        cut[k] = x < across or y < along or x > width - 1 - across or y > height - 1 - along
    return cut
