"""From pixels of calibrated cameras to 3-D positions with their uncertainty."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig
from scipy.interpolate import CubicSpline

from rafl.common.errors import InputError

Array = NDArray[Any]

SAME_FRAME = 0.02  # of a frame: clocks closer than this need no interpolation
WRONG = 6.0  # standard deviations of a residual, and
WRONG_PIXELS = 1.5  # px on top: beyond both, a camera is taken to have seen something else
STEPS = 8  # of Gauss and Newton; a pinhole camera's equations are not quite linear


@dataclass(frozen=True)
class CameraPixels:
    """What one camera saw of the named markers.

    Attributes:
        pixel: (T, M, 2), NaN where not seen.
        sigma: of each coordinate [px], (T, M, 2), NaN where not seen.
    """

    pixel: Array
    sigma: Array


def at_times(pixels: CameraPixels, own: Array, asked: Array) -> CameraPixels:
    """A camera's pixels at other times than its own, by a cubic through the frames around each.

    NaN outside its recording and where one of the two frames around was not seen.

    Args:
        pixels: as filmed.
        own: times of the frames filmed [s], (S).
        asked: [s], (T).
    """
    step = float(np.median(np.diff(own)))
    nearest = nearest_frames(own, asked)
    same = np.abs(own[nearest] - asked) < SAME_FRAME * step
    pixel = np.where(same[:, None, None], pixels.pixel[nearest], np.nan)
    sigma = np.where(same[:, None, None], pixels.sigma[nearest], np.nan)
    if same.all():
        return CameraPixels(pixel, sigma)
    for marker in range(pixel.shape[1]):
        seen = np.flatnonzero(np.isfinite(pixels.sigma[:, marker, 0]))
        if len(seen) < 4:
            continue
        spline = CubicSpline(own[seen], pixels.pixel[seen, marker])
        after = np.searchsorted(own[seen], asked)
        inside = (after > 0) & (after < len(seen)) & ~same
        gap = own[seen[np.minimum(after, len(seen) - 1)]] - own[seen[np.maximum(after - 1, 0)]]
        usable = inside & (gap < 1.6 * step)
        pixel[usable, marker] = spline(asked[usable])
        for axis in range(2):
            sigma[usable, marker, axis] = np.interp(asked[usable], own[seen], pixels.sigma[seen, marker, axis])
    return CameraPixels(pixel, sigma)


def nearest_frames(own: Array, asked: Array) -> NDArray[np.int64]:
    """Of frames at times own (S >= 2), rising, the nearest to each time asked (T)."""
    after = np.clip(np.searchsorted(own, asked), 1, len(own) - 1)
    return after - (asked - own[after - 1] < own[after] - asked)


def shown_frames(own: Array, asked: Array) -> NDArray[np.int64]:
    """Of frames at times own (S >= 2), the one that shows each time asked (T); -1 where none is within half a frame."""
    nearest = nearest_frames(own, asked)
    return np.where(np.abs(own[nearest] - asked) <= 0.5 * np.median(np.diff(own)), nearest, -1)


def triangulate(rig: Rig, pixels: dict[str, CameraPixels]) -> tuple[Array, Array, dict[str, Array]]:
    """Weighted least squares over the cameras that see a marker; its plane where only one does.

    A camera whose residual says that it saw something else is left out; where two disagree and nobody
    says which is wrong, the marker counts as not seen.

    Args:
        rig: the cameras.
        pixels: by camera.

    Returns:
        Positions (T, M, 3) [m], NaN where no camera sees the marker, or one that has no plane; one standard deviation
        (T, M, 3) [m]; reprojection residual by camera (T, M) [px].

    Raises:
        InputError: all markers seen by one camera alone that has no plane.
    """
    seen = {name: np.isfinite(item.sigma[..., 0]) for name, item in pixels.items()}
    ideal = {name: rig.cameras[name].undistort(item.pixel) for name, item in pixels.items()}
    alone = _count(seen) == 1
    for name in pixels:
        if rig.cameras[name].plane is None:
            if (seen[name] & alone).any() and not (_count(seen) > 1).any():
                raise InputError(
                    f"camera {name} alone sees the markers, and the calibration gives it no plane; add "
                    f"`plane: {{normal: ..., offset_mm: ...}}` to camera {name} in calib.yaml"
                )
            seen[name] = seen[name] & ~alone
    solved = _Solved.of(rig, pixels, ideal, seen)
    excess = _excess(rig, pixels, seen, solved.position)
    wrong = (_count(seen) > 1) & (np.max(list(excess.values()), axis=0) > 0)
    if wrong.any():
        seen = _without_wrong(rig, pixels, ideal, seen, wrong)
        solved = _Solved.of(rig, pixels, ideal, seen)
    residual = {
        name: np.linalg.norm(rig.cameras[name].project(solved.position) - item.pixel, axis=-1)
        for name, item in pixels.items()
    }
    return solved.position, solved.sigma, residual


def _count(seen: dict[str, NDArray[np.bool_]]) -> NDArray[np.int64]:
    """How many cameras see each marker, (T, M)."""
    return np.sum(list(seen.values()), axis=0)


@dataclass(frozen=True)
class _Solved:
    position: Array
    sigma: Array

    @classmethod
    def of(
        cls, rig: Rig, pixels: dict[str, CameraPixels], ideal: dict[str, Array], seen: dict[str, NDArray[np.bool_]]
    ) -> "_Solved":
        """Positions and their standard deviations from the cameras marked as seeing them."""
        count = _count(seen)
        position = np.zeros((*count.shape, 3))
        known = count > 0
        covariance = np.broadcast_to(np.eye(3), (*count.shape, 3, 3))
        linear = all(isinstance(rig.cameras[name], OrthographicCamera) for name in pixels)
        for _ in range(1 if linear else STEPS):
            normal = np.zeros((*count.shape, 3, 3))
            right = np.zeros((*count.shape, 3))
            for name, item in pixels.items():
                camera = rig.cameras[name]
                slopes = camera.slopes(position)
                sigma = np.where(seen[name][..., None], item.sigma, 1.0)
                weight = np.where(seen[name][..., None], 1.0 / sigma**2, 0.0)
                gap = np.where(seen[name][..., None], ideal[name] - camera.ideal(position), 0.0)
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
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        return cls(np.where(known[..., None], position, np.nan), np.where(known[..., None], sigma, np.nan))


def _excess(
    rig: Rig, pixels: dict[str, CameraPixels], seen: dict[str, NDArray[np.bool_]], position: Array
) -> dict[str, Array]:
    """By how many pixels each residual (T, M) exceeds what noise and calibration explain; -inf where not seen."""
    result = {}
    for name, item in pixels.items():
        camera = rig.cameras[name]
        gap = np.linalg.norm(camera.project(position) - item.pixel, axis=-1)
        sigma = np.sqrt((item.sigma**2).sum(-1) + 2.0 * camera.residual**2)
        with np.errstate(invalid="ignore"):
            result[name] = np.where(seen[name], gap - WRONG * sigma - WRONG_PIXELS, -np.inf)
    return result


def _without_wrong(
    rig: Rig,
    pixels: dict[str, CameraPixels],
    ideal: dict[str, Array],
    seen: dict[str, NDArray[np.bool_]],
    wrong: NDArray[np.bool_],
) -> dict[str, NDArray[np.bool_]]:
    """Who sees what, after leaving out of every wrong point the one camera without which the others agree."""
    names = list(pixels)
    count = _count(seen)
    result = {name: of_camera & ~(wrong & (count == 2)) for name, of_camera in seen.items()}
    several = wrong & (count > 2)
    if not several.any():
        return result
    worst = np.full((len(names), *wrong.shape), np.inf)
    for k, left_out in enumerate(names):
        others = {name: of_camera & (name != left_out) for name, of_camera in seen.items()}
        position = _Solved.of(rig, pixels, ideal, others).position
        excess = np.max(list(_excess(rig, pixels, others, position).values()), axis=0)
        worst[k] = np.where(seen[left_out], excess, np.inf)
    best = worst.argmin(axis=0)
    agreed = np.take_along_axis(worst, best[None], axis=0)[0] <= 0
    for k, name in enumerate(names):
        result[name] = result[name] & ~(several & (~agreed | (best == k)))
    return result
