"""What is said about cameras that were found elsewhere than their calibration has them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import Camera
from rafl.capture.dataset.refine_cameras import Refinement
from rafl.capture.dataset.registered import Registered
from rafl.capture.registration.camera_change import CLOCK, CameraChange
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset

Array = NDArray[Any]

PREFIX = "camera_change_"  # of the names of attributes
MAX_SIGMAS = 3.0  # a larger change of the pixels is more than the calibration's uncertainty
# Squared length of a change of the pose, in standard deviations, that is exceeded by chance as rarely as 3 sigmas: of a
# chi-squared distribution of six degrees of freedom.
MAX_SQUARED_LENGTH = 20.1
LEAST_CLOCK_ERROR = 0.05  # that is worth a warning [frames]


@dataclass(frozen=True)
class CameraRow:
    """One camera's change in words.

    Attributes:
        camera: its name.
        turn, shift, clock: with their standard deviations, in degrees, mm and frames.
        pixels: root mean square change of the markers' pixels at rest, the calibration's own uncertainty of them, and
            what the model leaves unexplained.
        touched: whether the change is more than the calibration's uncertainty.
        late: what to add to `time_offset_s` [s] if the clock differs from its calibration; empty otherwise.
        doubt: why the camera's or the body's model is in doubt; empty if what it leaves unexplained is as expected.
    """

    camera: str
    turn: str
    shift: str
    clock: str
    pixels: str
    touched: bool
    late: str
    doubt: str


def change_attributes(found: Refinement | None, item: Registered, rest: Array) -> dict[str, Array]:
    """Attributes of a recording that hold the changes of its cameras; see `datasets/README.md`.

    Args:
        found: changes of the cameras; None if they were not searched.
        item: the recording, with its cameras as calibrated.
        rest: places of the markers at rest [m], (M, 3).

    Raises:
        InputError: a camera's change is smaller than what the model leaves unexplained.
    """
    pose, result = item.registration.pose, dict[str, Array]()
    if found is None:
        return result
    for name in set(found.changes) & set(item.views):
        change = found.changes[name]
        camera, calibrated = item.views[name].camera, item.recording.views[name].camera
        moved, sigma = _pixel_change(change, camera, rest)
        own = calibrated.calibration_sigma((rest - pose.translation) @ pose.rotation)
        value = change.value[:CLOCK]
        length = float(value @ np.linalg.solve(change.covariance[:CLOCK, :CLOCK], value))
        if _touched(moved, own, length) and moved < found.unexplained[name]:
            raise InputError(
                f"--refine-cameras: camera {name} would have its pixels moved by {moved:.2g} px, but the simulated "
                f"motion is {found.unexplained[name]:.2g} px from the recorded one in any case: errors of the model "
                "cannot be told from a turned camera; leave the option out, or check the specimen file"
            )
        sigmas = np.sqrt(np.diag(change.covariance))
        variances = np.diagonal(item.views[name].covariance, axis1=-2, axis2=-1)
        expected = float(np.sqrt(np.nanmean(variances)))
        scale = float(np.linalg.det((slope := camera.jacobian(change.centre)) @ slope.T) ** 0.25)
        pixels = [moved, sigma, own, found.unexplained[name], length, expected, scale]
        result[PREFIX + name] = np.concatenate([change.value, sigmas, pixels])
    return result


def _touched(moved: float, calibration: float, squared_length: float) -> bool:
    """Whether a change is more than its own uncertainty and that of the calibration.

    Args:
        moved: root mean square change of the pixels [px].
        calibration: uncertainty of the pixels [px]; NaN if not known.
        squared_length: of the change of the pose, in standard deviations.
    """
    return bool(squared_length > MAX_SQUARED_LENGTH and moved > MAX_SIGMAS * np.nan_to_num(calibration))


def _pixel_change(change: CameraChange, camera: Camera, points: Array) -> tuple[float, float]:
    """Root mean square change of a coordinate of the pixels, and its standard deviation [px]."""
    now = change.moved(camera)
    slope = change.pose_slope(now, points)
    variance = np.einsum("...k,kl,...l->...", slope, change.covariance[:CLOCK, :CLOCK], slope)
    return float(np.sqrt(((now.project(points) - camera.project(points)) ** 2).mean())), float(np.sqrt(variance.mean()))


def camera_rows(dataset: Dataset) -> list[CameraRow]:
    """The changes of the cameras of a dataset; those of its latest recording if they differ."""
    found: dict[str, object] = {}
    for item in dataset.trajectories.values():
        found |= {key.removeprefix(PREFIX): value for key, value in item.attributes.items() if key.startswith(PREFIX)}
    rows = []
    for name, numbers in found.items():
        value, sigma, pixels = np.split(np.asarray(numbers, dtype=float), [CLOCK + 1, 2 * CLOCK + 2])
        moved, moved_sigma, own, unexplained, length, expected, scale = pixels
        in_body = f"{unexplained:.2g} px ({1e3 * unexplained / scale:.2g} mm)"
        doubt = f"{in_body} where the dots are known to {expected:.2g} px"
        frames = 1.0 / dataset.simulator.time_step
        known = "" if np.isnan(own) else f" (calibration +- {own:.2g})"
        rows.append(
            CameraRow(
                name,
                _pairs(np.degrees(value[:3]), np.degrees(sigma[:3])),
                _pairs(1e3 * value[3:CLOCK], 1e3 * sigma[3:CLOCK]),
                _pairs(frames * value[CLOCK:], frames * sigma[CLOCK:]),
                f"{moved:.3g} +- {moved_sigma:.2g}{known}, {unexplained:.2g} unexplained",
                _touched(moved, own, length),
                f"{value[CLOCK]:+.6f} +- {sigma[CLOCK]:.1g}"
                if _off(frames * value[CLOCK], frames * sigma[CLOCK])
                else "",
                doubt if unexplained > MAX_SIGMAS * expected else "",
            )
        )
    return rows


def _off(clock: float, sigma: float) -> bool:
    """Whether a clock differs from its calibration [frames]."""
    return abs(clock) > max(LEAST_CLOCK_ERROR, MAX_SIGMAS * sigma)


def _pairs(values: Array, sigmas: Array) -> str:
    return ", ".join(f"{value:+.3f} +- {sigma:.2g}" for value, sigma in zip(values, sigmas, strict=True))


def camera_warnings(dataset: Dataset) -> list[str]:
    """A line for every camera that was touched or has another clock, and for every one that no model explains."""
    rows = camera_rows(dataset)
    doubts = [
        f"camera {row.camera}: the simulated motion is {row.doubt} from the recorded one, whatever the material and "
        "the camera's pose; the camera shows perspective that its calibration leaves out, or the body is not as the "
        "model has it"
        for row in rows
        if row.doubt
    ]
    clocks = [
        f"camera {row.camera}: its clock was found off; the dataset has the one found. Add {row.late} s to its "
        "time_offset_s in calib.yaml before the next recording"
        for row in rows
        if row.late
    ]
    return [*doubts, *clocks] + [
        f"camera {row.camera}: found turned by {row.turn} degrees about x, y and z since its calibration, and shifted "
        f"by {row.shift} mm; it was touched, or the body is not as the model has it. The dataset has the camera where "
        "it was found; calibrate again before the next recording"
        for row in rows
        if row.touched
    ]
