"""One marker's dot: found under a position that a person points at, and followed on from there."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.tracking.detection.appearance import MarkerAppearance
from rafl.tracking.detection.detect import (
    MIN_SEPARATION_RADII,
    RADIUS_RANGE,
    Dots,
    find_candidates,
    fit_candidates,
    fit_dots,
)
from rafl.tracking.linking.tracker import PREDICTION_GATE

Array = NDArray[Any]

REACH_PX = 5 * int(RADIUS_RANGE[1])  # around the position, in which dots are searched
POINTING_ERROR_PX = 4.0  # of a person beyond the edge of the dot
NEIGHBOURS = 4  # nearest markers, whose motion predicts the marker's
USUAL_SPACING_RADII = 6.0  # of markers, where no other is near


@dataclass(frozen=True)
class PointedDot:
    """The dot under a position.

    Attributes:
        dot: the one.
        appearance: of the markers around it, or of the dot itself if there are none.
    """

    dot: Dots
    appearance: MarkerAppearance

    @property
    def centre(self) -> Array:
        """[px], (2)."""
        return np.asarray(self.dot.centre[0])

    @property
    def sigma(self) -> Array:
        """Of the centre, from the fit [px], (2)."""
        return np.asarray(self.dot.sigma[0])


def dot_at(image: Array, position: Array, markers: Array) -> PointedDot | None:
    """Fit the dot under a position, as the tracker fits dots; None if there is none.

    Whether markers are dark is told by those around; without any, the better fit decides.

    Args:
        image: grey levels, (H, W).
        position: (2) [px].
        markers: positions of markers in the frame, (K, 2) [px], NaN where not seen.
    """
    corner = np.maximum(np.rint(position).astype(int) - REACH_PX, 0)
    end = np.rint(position).astype(int) + REACH_PX
    part = np.ascontiguousarray(image[corner[1] : max(end[1], 0), corner[0] : max(end[0], 0)])
    if min(part.shape) < 2 * RADIUS_RANGE[0]:
        return None
    known = markers[np.isfinite(markers[:, 0])] - corner
    found: list[tuple[int, float, PointedDot]] = []
    for dark in (True, False):
        dots = fit_candidates(part, find_candidates(part, dark), dark)
        if not len(dots):
            continue
        distance = np.linalg.norm(dots.centre - (position - corner), axis=1)
        nearest = int(np.argmin(distance - dots.radius))
        if distance[nearest] > dots.radius[nearest] + POINTING_ERROR_PX:
            continue
        own = np.zeros(len(dots), bool)
        if len(known):
            apart = np.linalg.norm(dots.centre[:, None] - known, axis=2).min(axis=1)
            own = apart < MIN_SEPARATION_RADII * dots.radius
        like = dots[own] if own.any() else dots[nearest : nearest + 1]
        dot = _moved(dots[nearest : nearest + 1], corner)
        found.append((-int(own.sum()), float(dot.misfit[0]), PointedDot(dot, MarkerAppearance.from_dots(dark, like))))
    return min(found, key=lambda item: item[:2])[2] if found else None


def load_kernels() -> None:
    """Load the compiled code of `dot_at` and `follow_on`, so that the first dot does not wait for it."""
    x, y = np.meshgrid(np.arange(80.0), np.arange(80.0))
    image = np.where(np.hypot(x - 40.0, y - 40.0) < 7.0, 40, 170).astype(np.uint8)
    dot = dot_at(image, np.array([40.0, 40.0]), np.array([[40.0, 40.0]]))
    if dot is not None:
        list(follow_on(dot, 0, np.full((2, 1, 2), np.nan), np.arange(2), lambda row: image))


def _moved(dots: Dots, corner: NDArray[np.int64]) -> Dots:
    """Dots of a part of a frame in the pixels of the frame."""
    parameters = dots.parameters.copy()
    parameters[:, :2] += corner
    return Dots(
        **{name: getattr(dots, name) for name in dots.__dataclass_fields__}
        | {
            "centre": dots.centre + corner,
            "parameters": parameters,
        }
    )


def follow_on(
    start: PointedDot,
    marker: int,
    path: Array,
    rows: NDArray[np.int64],
    image_of: Callable[[int], Array | None],
) -> Iterator[tuple[int, Array, Array]]:
    """Follow a marker's dot from row to row for as long as the fit holds.

    It ends where the dot does not look like a marker, is too far from where the markers around lead it, is that of
    another marker, or where the marker's own track has it.

    Args:
        start: the dot in the first of `rows`.
        marker: its index.
        path: positions of all markers as known [px], (T, M, 2), NaN where not seen.
        rows: indices along T of the frames, in order; the first is that of `start`.
        image_of: the frame of a row, grey levels (H, W), or None.

    Yields:
        Row, centre (2) and sigma (2) [px] of each frame after the first.
    """
    others = np.arange(path.shape[1]) != marker
    parameters, moved = start.dot.parameters[0].copy(), np.zeros(2)
    for before, row in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        image = image_of(row)
        if image is None:
            return
        shift, spacing = _motion_around(path[before][others], path[row][others], parameters[:2])
        if shift is None:
            shift, spacing = moved, USUAL_SPACING_RADII * start.appearance.radius
        beginning = parameters.copy()
        beginning[:2] += shift
        near = path[row][others]
        near = near[np.isfinite(near[:, 0])]
        starts = np.tile(beginning, (1 + len(near), 1))
        starts[1:, :2] = near
        dot = fit_dots(image, starts, 1)
        separation = MIN_SEPARATION_RADII * start.appearance.radius
        if (
            not start.appearance.matches(dot)[0]
            or not dot.within(image)[0]
            or np.hypot(*(dot.centre[0] - beginning[:2])) > PREDICTION_GATE * spacing
            or (len(near) and np.hypot(*(near - dot.centre[0]).T).min() < separation)
            or np.hypot(*(path[row, marker] - dot.centre[0])) < separation
        ):
            return
        moved = dot.centre[0] - parameters[:2]
        parameters = dot.parameters[0].copy()
        yield row, dot.centre[0], dot.sigma[0]


def _motion_around(before: Array, after: Array, position: Array) -> tuple[Array | None, float]:
    """Mean motion of the nearest markers (2) [px], weighted by nearness, and the distance to the nearest one [px].

    Args:
        before: positions of the other markers in the frame before, (K, 2), NaN where not seen.
        after: in this frame, (K, 2).
        position: of the marker in the frame before, (2).
    """
    distance = np.linalg.norm(before - position, axis=1)
    known = np.flatnonzero(np.isfinite(distance) & np.isfinite(after[:, 0]) & (distance > 0.0))
    if not len(known):
        return None, 0.0
    nearest = known[np.argsort(distance[known])[:NEIGHBOURS]]
    weight = 1.0 / distance[nearest]
    motion: Array = (weight[:, None] * (after - before)[nearest]).sum(axis=0) / weight.sum()
    return motion, float(distance[nearest[0]])
