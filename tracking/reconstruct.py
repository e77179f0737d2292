"""From pixels of calibrated cameras to 3-D positions with their uncertainty."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from calibration.rig import Rig
from groundwork import InputError

Array = NDArray[Any]


@dataclass(frozen=True)
class CameraPixels:
    """What one camera saw of the named markers.

    Attributes:
        pixel: (T, M, 2), NaN where not seen.
        sigma: [px], (T, M), NaN where not seen.
    """

    pixel: Array
    sigma: Array


def on_rig_clock(pixels: CameraPixels, time: Array, offset: float) -> CameraPixels:
    """A camera's pixels at the rig's times, its own clock being `offset` [s] ahead."""
    if offset == 0.0:
        return pixels
    pixel = np.full_like(pixels.pixel, np.nan)
    sigma = np.full_like(pixels.sigma, np.nan)
    asked = time + offset
    for marker in range(pixel.shape[1]):
        seen = np.flatnonzero(np.isfinite(pixels.sigma[:, marker]))
        if len(seen) < 4:
            continue
        spline = CubicSpline(time[seen], pixels.pixel[seen, marker])
        after = np.searchsorted(time[seen], asked)
        inside = (after > 0) & (after < len(seen))
        gap = seen[np.minimum(after, len(seen) - 1)] - seen[np.maximum(after - 1, 0)]
        usable = inside & (gap == 1)
        pixel[usable, marker] = spline(asked[usable])
        sigma[usable, marker] = np.interp(asked[usable], time[seen], pixels.sigma[seen, marker])
    return CameraPixels(pixel, sigma)


def triangulate(rig: Rig, pixels: dict[str, CameraPixels]) -> tuple[Array, Array, dict[str, Array]]:
    """Weighted least squares over the cameras that see a marker; its plane where only one does.

    Args:
        rig: the cameras.
        pixels: by camera.

    Returns:
        Positions (T, M, 3) [m], NaN where no camera sees the marker; one standard deviation
        (T, M, 3) [m]; reprojection residual by camera (T, M) [px].

    Raises:
        InputError: a marker seen by one camera alone that has no plane.
    """
    shape = next(iter(pixels.values())).sigma.shape
    normal = np.zeros((*shape, 3, 3))
    right = np.zeros((*shape, 3))
    count = np.zeros(shape, dtype=int)
    ideal = {name: rig.cameras[name].undistort(item.pixel) for name, item in pixels.items()}
    for name, item in pixels.items():
        camera = rig.cameras[name]
        seen = np.isfinite(item.sigma)
        weight = np.where(seen, 1.0 / np.where(seen, item.sigma, 1.0) ** 2, 0.0)
        normal += weight[..., None, None] * (camera.matrix.T @ camera.matrix)
        gap = np.where(seen[..., None], ideal[name] - np.asarray(camera.offset), 0.0)
        right += weight[..., None] * (gap @ camera.matrix)
        count += seen
    for name, item in pixels.items():
        alone = np.isfinite(item.sigma) & (count == 1)
        plane = rig.cameras[name].plane
        if not alone.any():
            continue
        if plane is None:
            raise InputError(
                f"camera {name} alone sees some markers, and the calibration gives it no plane; "
                f"add `plane: {{normal: ..., offset_mm: ...}}` to camera {name} in calib.yaml"
            )
        direction = np.array(plane.normal)
        normal[alone] += np.outer(direction, direction) / plane.sigma**2
        right[alone] += direction * plane.offset / plane.sigma**2
    known = count > 0
    covariance = np.linalg.inv(np.where(known[..., None, None], normal, np.eye(3)))
    position = np.where(known[..., None], (covariance @ right[..., None])[..., 0], np.nan)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    sigma = np.where(known[..., None], np.sqrt(variance), np.nan)
    residual = {
        name: np.linalg.norm(rig.cameras[name].project(position) - item.pixel, axis=-1) for name, item in pixels.items()
    }
    return position, sigma, residual


def fill_gaps(position: Array, sigma: Array, time: Array, longest: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Bridge gaps of up to `longest` frames by a cubic through what was measured.

    Sigma grows by half the curve's bend across the gap. Longer gaps stay NaN.

    Returns:
        Positions, sigma (T, M, 3) and states (T, M): 0 missing, 1 measured, 2 filled.
    """
    position, sigma = position.copy(), sigma.copy()
    state = np.isfinite(position[..., 0]).astype(np.uint8)
    for marker in range(position.shape[1]):
        seen = np.flatnonzero(state[:, marker] == 1)
        if len(seen) < 4 or longest == 0:
            continue
        spline = CubicSpline(time[seen], position[seen, marker])
        for before, after in itertools.pairwise(seen):
            if not 1 < after - before <= longest + 1:
                continue
            gap = np.arange(before + 1, after)
            curve = spline(time[gap])
            share = ((time[gap] - time[before]) / (time[after] - time[before]))[:, None]
            line = (1 - share) * position[before, marker] + share * position[after, marker]
            base = np.maximum(sigma[before, marker], sigma[after, marker])
            position[gap, marker] = curve
            sigma[gap, marker] = np.sqrt(4.0 * base**2 + (0.5 * (curve - line)) ** 2)
            state[gap, marker] = 2
    return position, sigma, state
