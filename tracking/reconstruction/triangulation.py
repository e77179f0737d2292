"""Triangulation: 3-D positions and their uncertainty from the pixels of calibrated cameras."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from rafl.calibration.camera import Camera, OrthographicCamera
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError

Array = NDArray[Any]

SAME_TIME_FRAMES = 0.02  # times that differ by less than this need no interpolation [frame intervals]
HALF_FRAME = 0.5 + 0.5 * SAME_TIME_FRAMES  # how far from a row the frame may be that it shows [frame intervals]
# A camera is an outlier if its residual exceeds so many sigmas plus so many pixels.
OUTLIER_SIGMAS, OUTLIER_PIXELS = 6.0, 1.5
MAX_ITERATIONS = 8  # of Gauss-Newton; a pinhole camera's equations are not quite linear


@dataclass(frozen=True)
class CameraPixels:
    """Pixels of the named markers in one camera.

    Attributes:
        pixel: (T, M, 2), NaN where not seen.
        sigma: of each coordinate [px], (T, M, 2), NaN where not seen.
    """

    pixel: Array
    sigma: Array


def resample_pixels(pixels: CameraPixels, own: Array, requested: Array) -> CameraPixels:
    """A camera's pixels at other times than those of its frames, by a cubic spline.

    NaN outside the recording, and where one of the two frames around a time does not show the marker.

    Args:
        pixels: as filmed.
        own: times of the frames [s], (S).
        requested: times [s], (T).
    """
    interval = float(np.median(np.diff(own)))
    nearest = nearest_frames(own, requested)
    same = np.abs(own[nearest] - requested) < SAME_TIME_FRAMES * interval
    pixel = np.where(same[:, None, None], pixels.pixel[nearest], np.nan)
    sigma = np.where(same[:, None, None], pixels.sigma[nearest], np.nan)
    if same.all():
        return CameraPixels(pixel, sigma)
    for marker in range(pixel.shape[1]):
        seen = np.flatnonzero(np.isfinite(pixels.sigma[:, marker, 0]))
        if len(seen) < 4:
            continue
        spline = CubicSpline(own[seen], pixels.pixel[seen, marker])
        after = np.searchsorted(own[seen], requested)
        inside = (after > 0) & (after < len(seen)) & ~same
        gap = own[seen[np.minimum(after, len(seen) - 1)]] - own[seen[np.maximum(after - 1, 0)]]
        usable = inside & (gap < 1.6 * interval)
        pixel[usable, marker] = spline(requested[usable])
        for axis in range(2):
            sigma[usable, marker, axis] = np.interp(requested[usable], own[seen], pixels.sigma[seen, marker, axis])
    return CameraPixels(pixel, sigma)


def nearest_frames(own: Array, requested: Array) -> NDArray[np.int64]:
    """Index of the frame nearest to each requested time (T), for frames at increasing times `own` (S >= 2)."""
    after = np.clip(np.searchsorted(own, requested), 1, len(own) - 1)
    nearest: NDArray[np.int64] = after - (requested - own[after - 1] < own[after] - requested)
    return nearest


def shown_frames(own: Array, requested: Array) -> NDArray[np.int64]:
    """Index of the frame shown at each requested time (T): the nearest, -1 if it is over half a frame interval away.

    The later of two frames that are as near, as those of a camera that is half a frame late are throughout.
    """
    interval = float(np.median(np.diff(own)))
    after = np.clip(np.searchsorted(own, requested), 1, len(own) - 1)
    nearer = requested - own[after - 1] < own[after] - requested - SAME_TIME_FRAMES * interval
    shown = np.where(nearer, after - 1, after)
    return np.where(np.abs(own[shown] - requested) <= HALF_FRAME * interval, shown, -1)


def coincide(own: Array, requested: Array) -> bool:
    """Whether every requested time (T) that shows a frame is the frame's own, for frames at times `own` (S) [s]."""
    shown = shown_frames(own, requested)
    apart = np.abs(own[shown] - requested)[shown >= 0]
    return bool((apart < SAME_TIME_FRAMES * np.median(np.diff(own))).all())


def triangulate(rig: Rig, pixels: dict[str, CameraPixels]) -> tuple[Array, Array, dict[str, Array]]:
    """Triangulate every marker by weighted least squares over the cameras that see it.

    Where one camera alone sees a marker, that camera's plane is added as a measurement. A camera with too large a
    residual is left out. If only two cameras see a marker and they disagree, it counts as not seen. The standard
    deviations contain what an orthographic model makes of a camera's perspective.

    Args:
        rig: the cameras.
        pixels: by camera.

    Returns:
        Positions (T, M, 3) [m], NaN where no camera sees the marker, or only one without a plane; their standard
        deviations (T, M, 3) [m]; reprojection residuals by camera (T, M) [px].

    Raises:
        InputError: a camera without a plane sees markers alone, and no marker is seen by several cameras.
    """
    seen = {name: np.isfinite(item.sigma[..., 0]) for name, item in pixels.items()}
    alone = _count(seen) == 1
    for name in pixels:
        if rig.cameras[name].plane is None and (seen[name] & alone).any() and not (_count(seen) > 1).any():
            raise InputError(
                f"camera {name} alone sees the markers, and the calibration gives it no plane; name the "
                "markers with --specimen, or add `plane: {normal: ..., offset_mm: ...}` to the camera in calib.yaml"
            )
    return triangulate_some(rig, pixels)


def triangulate_some(rig: Rig, pixels: dict[str, CameraPixels]) -> tuple[Array, Array, dict[str, Array]]:
    """`triangulate` for a part of a recording, in which no marker need be seen by enough cameras."""
    seen = {name: np.isfinite(item.sigma[..., 0]) for name, item in pixels.items()}
    ideal = {name: rig.cameras[name].undistort(item.pixel) for name, item in pixels.items()}
    alone = _count(seen) == 1
    for name in pixels:
        if rig.cameras[name].plane is None:
            seen[name] = seen[name] & ~alone
    solution = _Solution.of(rig, pixels, ideal, seen)
    excess = _excess(rig, pixels, seen, solution.position)
    outlying = (_count(seen) > 1) & (np.max(list(excess.values()), axis=0) > 0)
    if outlying.any():
        seen = _drop_outliers(rig, pixels, ideal, seen, outlying)
        solution = _Solution.of(rig, pixels, ideal, seen)
    residual = {
        name: np.linalg.norm(rig.cameras[name].project(solution.position) - item.pixel, axis=-1)
        for name, item in pixels.items()
    }
    return solution.position, np.hypot(solution.sigma, _model_error(rig, pixels, seen, solution)), residual


def _model_error(
    rig: Rig, pixels: dict[str, CameraPixels], seen: dict[str, NDArray[np.bool_]], solution: "_Solution"
) -> Array:
    """What the errors of the camera models add to the positions [m], (T, M, 3)."""
    right = np.zeros_like(solution.position)
    alone = _count(seen) == 1
    for name, item in pixels.items():
        camera = rig.cameras[name]
        by_plane = 0.0 if camera.plane is None else camera.plane.sigma
        error = camera.model_error(solution.position, np.where(seen[name] & alone, by_plane, 0.0))
        weighted = np.where(seen[name][..., None], error / item.sigma**2, 0.0)
        right += np.einsum("...k,...ki->...i", weighted, camera.projection_jacobian(solution.position))
    result: Array = (solution.covariance @ right[..., None])[..., 0]
    return result


def _count(seen: dict[str, NDArray[np.bool_]]) -> NDArray[np.int64]:
    """Number of cameras that see each marker, (T, M)."""
    count: NDArray[np.int64] = np.sum(list(seen.values()), axis=0)
    return count


@dataclass(frozen=True)
class _Solution:
    """Positions [m], (T, M, 3), and their covariances [m^2], (T, M, 3, 3), NaN where no camera sees the marker."""

    position: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations [m], (T, M, 3)."""
        result: Array = np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))
        return result

    @classmethod
    def of(
        cls, rig: Rig, pixels: dict[str, CameraPixels], ideal: dict[str, Array], seen: dict[str, NDArray[np.bool_]]
    ) -> "_Solution":
        """Solve for the positions from the cameras that see each marker, `seen` (T, M).

        The lines of sight give a linear estimate. For orthographic cameras it is the solution; for pinhole cameras,
        Gauss-Newton on the reprojection residuals follows.
        """
        count = _count(seen)
        known = count > 0
        position = np.where(known[..., None], 0.0, np.full(3, np.nan))
        covariance = np.broadcast_to(np.eye(3), (*count.shape, 3, 3))
        linear = all(isinstance(rig.cameras[name], OrthographicCamera) for name in pixels)
        for iteration in range(1 if linear else MAX_ITERATIONS):
            normal = np.zeros((*count.shape, 3, 3))
            right = np.zeros((*count.shape, 3))
            for name, item in pixels.items():
                camera = rig.cameras[name]
                if iteration == 0:
                    slopes, gap = camera.sight_equations(ideal[name])
                else:
                    slopes = camera.projection_jacobian(position)
                    gap = ideal[name] - camera.project_undistorted(position)
                slopes = np.where(seen[name][..., None, None], slopes, 0.0)
                gap = np.where(seen[name][..., None], gap, 0.0)
                weight = 1.0 / np.where(seen[name][..., None], item.sigma, 1.0) ** 2
                normal += np.einsum("...k,...ki,...kj->...ij", weight, slopes, slopes)
                right += np.einsum("...k,...ki,...k->...i", weight, slopes, gap)
                alone = seen[name] & (count == 1)
                if alone.any():
                    plane = camera.plane
                    assert plane is not None
                    direction = np.array(plane.normal)
                    normal[alone] += np.outer(direction, direction) / plane.sigma**2
                    off = plane.offset - position[alone] @ direction
                    right[alone] += off[:, None] * direction / plane.sigma**2
            covariance = np.linalg.inv(np.where(known[..., None, None], normal, np.eye(3)))
            step = (covariance @ right[..., None])[..., 0]
            position = position + step
            if np.abs(step).max(initial=0.0) < 1e-12:
                break
        return cls(position, np.where(known[..., None, None], covariance, np.nan))


def _excess(
    rig: Rig, pixels: dict[str, CameraPixels], seen: dict[str, NDArray[np.bool_]], position: Array
) -> dict[str, Array]:
    """Residuals above the outlier limit of noise and calibration, by camera (T, M) [px]; -inf where not seen."""
    result = {}
    for name, item in pixels.items():
        camera = rig.cameras[name]
        gap = np.linalg.norm(camera.project(position) - item.pixel, axis=-1)
        with np.errstate(invalid="ignore"):
            result[name] = np.where(seen[name], gap - outlier_limit(item.sigma, camera), -np.inf)
    return result


def outlier_limit(sigma: Array, camera: Camera) -> Array:
    """Reprojection residual above which a pixel of the given sigma (..., 2) is an outlier [px], (...)."""
    limit: Array = OUTLIER_SIGMAS * np.sqrt((sigma**2).sum(-1) + 2.0 * camera.residual**2) + OUTLIER_PIXELS
    return limit


def _drop_outliers(
    rig: Rig,
    pixels: dict[str, CameraPixels],
    ideal: dict[str, Array],
    seen: dict[str, NDArray[np.bool_]],
    outlying: NDArray[np.bool_],
) -> dict[str, NDArray[np.bool_]]:
    """Which camera sees which marker, by camera (T, M), without outliers.

    For every outlying marker (T, M), the one camera is left out without which the others agree. If there is no such
    camera, or there are only two, none sees the marker.
    """
    names = list(pixels)
    count = _count(seen)
    result = {name: of_camera & ~(outlying & (count == 2)) for name, of_camera in seen.items()}
    several = outlying & (count > 2)
    if not several.any():
        return result
    excess_without = np.full((len(names), *outlying.shape), np.inf)
    for k, left_out in enumerate(names):
        others = {name: of_camera & (name != left_out) for name, of_camera in seen.items()}
        position = _Solution.of(rig, pixels, ideal, others).position
        excess = np.max(list(_excess(rig, pixels, others, position).values()), axis=0)
        excess_without[k] = np.where(seen[left_out], excess, np.inf)
    dropped = excess_without.argmin(axis=0)
    agreed = np.take_along_axis(excess_without, dropped[None], axis=0)[0] <= 0
    for k, name in enumerate(names):
        result[name] = result[name] & ~(several & (~agreed | (dropped == k)))
    return result
