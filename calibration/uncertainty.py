"""How far the uncertainty of a calibration moves the pixels of points."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import Camera, OrthographicCamera

Array = NDArray[Any]

# Differences of [mx, my, skew] in px/mm, of the rotation vector in rad, of the offset in px, and of k1, k2. The
# projection is nearly linear over them, and they are far above rounding.
STEPS = np.array([1e-4] * 3 + [1e-6] * 3 + [1e-3] * 2 + [1e-6] * 2)


def calibration_sigma(camera: Camera, points: Array) -> float:
    """Root mean square, over points (..., 3) [m], of the standard deviations of a coordinate of their pixels [px].

    They follow from the covariance of the camera's parameters in `calib.yaml`; NaN for a camera without one.
    """
    if camera.covariance is None or not isinstance(camera, OrthographicCamera):
        return float("nan")
    base = camera.project(points)
    slopes = np.stack(
        [(_changed(camera, k, step).project(points) - base) / step for k, step in enumerate(STEPS)], axis=-1
    )
    variance = np.einsum("...k,kl,...l->...", slopes, np.asarray(camera.covariance), slopes)
    return float(np.sqrt(variance.mean()))


def _changed(camera: OrthographicCamera, parameter: int, step: float) -> OrthographicCamera:
    """The camera with one of the ten parameters of the covariance changed."""
    values = np.array(
        [*(1e-3 * np.array([*camera.scale, camera.skew])), *camera.rotation_vector, *camera.offset, *camera.distortion]
    )
    values[parameter] += step
    return replace(
        camera,
        scale=tuple((1e3 * values[:2]).tolist()),
        skew=float(1e3 * values[2]),
        rotation_vector=tuple(values[3:6].tolist()),
        offset=tuple(values[6:8].tolist()),
        distortion=tuple(values[8:].tolist()),
    )
