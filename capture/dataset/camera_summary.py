"""What is said about cameras that were found elsewhere than their calibration has them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import Camera
from rafl.capture.dataset.refine_cameras import REFERENCE_SIGMA, Refinement
from rafl.capture.dataset.registered import Registered
from rafl.capture.registration.camera_change import CLOCK, CameraChange
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset

Array = NDArray[Any]

PREFIX = "camera_change_"  # of the names of attributes
# Numbers of an attribute: turn, shift and clock; as many standard deviations; and seven of the pixels.
CHANGE_NUMBERS = 2 * (CLOCK + 1) + 7
CAMERA_HEADINGS = ("camera", "turned [degrees]", "shifted [mm]", "clock", "pixels moved", "left unexplained")
MAX_SIGMAS = 3.0  # a larger change of the pixels is more than the calibration's uncertainty
# Squared length of a change of the pose, in standard deviations, that is exceeded by chance as rarely as 3 sigmas: of a
# chi-squared distribution of six degrees of freedom.
MAX_SQUARED_LENGTH = 20.1
LEAST_CLOCK_ERROR = 0.05  # that is worth a warning [frames]
OTHER_CAUSES = (
    "something else is wrong: the size, preset or material in the specimen file; the names of markers; or perspective, "
    "if a camera is near and its calibration orthographic (rafl-calibrate --model pinhole)"
)


@dataclass(frozen=True)
class CameraRow:
    """One camera's change in words. Each text is the lines of a cell.

    Attributes:
        camera: its name.
        turn, shift: along x, y and z, with their standard deviations, in degrees and mm.
        clock: what to add to its time offset, with its standard deviation, in s and in frames.
        moved: root mean square change of the markers' pixels at rest, and the calibration's own uncertainty of them.
        remains: difference between simulated and recorded pixels that is left, in px and mm, and the pixels' own
            standard deviation.
        touched: whether the change is more than the calibration's uncertainty, and explains the pixels.
        late: whether the clock differs from its calibration, and the pixels are explained.
        explained: whether what remains is as small as the pixels' own standard deviation lets expect.
    """

    camera: str
    turn: tuple[str, ...]
    shift: tuple[str, ...]
    clock: tuple[str, str]
    moved: tuple[str, ...]
    remains: tuple[str, str]
    touched: bool
    late: bool
    explained: bool

    @property
    def cells(self) -> list[tuple[str, ...]]:
        """The lines of the cells under `CAMERA_HEADINGS`."""
        return [(self.camera,), self.turn, self.shift, self.clock, self.moved, self.remains]


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
    for name in found.changes:
        if name not in item.views:
            continue
        change, unexplained = found.changes[name], found.unexplained[name]
        camera, calibrated = item.views[name].camera, item.recording.views[name].camera
        moved, sigma = _pixel_change(change, camera, rest)
        own = calibrated.calibration_sigma((rest - pose.translation) @ pose.rotation)
        value = change.value[:CLOCK]
        length = float(value @ np.linalg.solve(change.covariance[:CLOCK, :CLOCK], value))
        variances = np.diagonal(item.views[name].covariance, axis1=-2, axis2=-1)
        expected = float(np.sqrt(np.nanmean(variances)))
        scale = float(np.linalg.det((slope := camera.jacobian(change.centre)) @ slope.T) ** 0.25)
        if _touched(moved, own, length) and moved < unexplained:
            remains, dots = _remains(unexplained, scale, expected)
            raise InputError(
                f"--refine-cameras: camera {name} would have its pixels moved by {moved:.2g} px, but {remains} remain "
                f"between the simulated and the recorded motion, {dots}: a moved camera does not explain the pixels, "
                f"and {OTHER_CAUSES}. Correct that, or leave the option out"
            )
        sigmas = np.sqrt(np.diag(change.covariance))
        pixels = [moved, sigma, own, unexplained, length, expected, scale]
        result[PREFIX + name] = np.concatenate([change.value, sigmas, pixels])
    return result


def _remains(unexplained: float, scale: float, expected: float) -> tuple[str, str]:
    """What remains [px], also in mm by the scale of the image [px/m], and the pixels' standard deviation [px]."""
    return f"{unexplained:.2g} px = {1e3 * unexplained / scale:.2g} mm", f"where sigma is {expected:.2g} px"


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
    """The changes of the cameras of a dataset; those of its latest recording if they differ.

    Raises:
        InputError: the attribute of a change is not what `change_attributes` makes.
    """
    found: dict[str, Array] = {}
    for recording, item in dataset.trajectories.items():
        for key, content in item.attributes.items():
            if key.startswith(PREFIX):
                numbers = np.asarray(content)
                if numbers.shape != (CHANGE_NUMBERS,) or numbers.dtype.kind not in "fiu":
                    raise InputError(
                        f"{dataset.name}, recording {recording}, {key}: expected {CHANGE_NUMBERS} numbers, found "
                        f"{content!r:.60}; build the dataset again"
                    )
                found[key.removeprefix(PREFIX)] = numbers.astype(float)
    rows = []
    for name, numbers in found.items():
        value, sigma, pixels = np.split(numbers, [CLOCK + 1, 2 * CLOCK + 2])
        moved, moved_sigma, own, unexplained, length, expected, scale = pixels
        late, late_sigma = value[CLOCK], sigma[CLOCK]
        frames, frames_sigma = late / dataset.simulator.time_step, late_sigma / dataset.simulator.time_step
        known = () if np.isnan(own) else (f"calibration +- {own:.2g} px",)
        rows.append(
            CameraRow(
                name,
                _pairs(np.degrees(value[:3]), np.degrees(sigma[:3])),
                _pairs(1e3 * value[3:CLOCK], 1e3 * sigma[3:CLOCK]),
                _clock(late, late_sigma, dataset.simulator.time_step),
                (f"{moved:.3g} +- {moved_sigma:.2g} px", *known),
                _remains(unexplained, scale, expected),
                _touched(moved, own, length),
                _off(frames, frames_sigma),
                bool(unexplained <= MAX_SIGMAS * expected),
            )
        )
    if all(row.explained for row in rows):
        return rows
    return [replace(row, touched=False, late=False) for row in rows]  # all cameras were found together


def _clock(late: float, sigma: float, frame: float) -> tuple[str, str]:
    """What to add to a time offset, with its standard deviation, in s and in frames of a length [s]."""
    if sigma < 2.0 * REFERENCE_SIGMA * frame:
        return ("reference", "of the others")
    return (f"{late:+.6f} +- {sigma:.1g} s", f"{late / frame:+.3f} +- {sigma / frame:.1g} frames")


def _off(clock: float, sigma: float) -> bool:
    """Whether a clock differs from its calibration [frames]."""
    return abs(clock) > max(LEAST_CLOCK_ERROR, MAX_SIGMAS * sigma)


def _pairs(values: Array, sigmas: Array) -> tuple[str, ...]:
    return tuple(f"{value:+.3f} +- {sigma:.2g}" for value, sigma in zip(values, sigmas, strict=True))


def camera_warnings(dataset: Dataset) -> list[str]:
    """A line for every camera that was touched or has another clock, and for every one that no model explains."""
    rows = camera_rows(dataset)
    clocks = [
        f"camera {row.camera}: its clock was found off; the dataset has the one found. Add {row.clock[0]} "
        f"({row.clock[1]}) to its time_offset_s in calib.yaml before the next recording"
        for row in rows
        if row.late
    ]
    touched = [
        f"camera {row.camera}: found turned by {', '.join(row.turn)} degrees about x, y and z since its calibration, "
        f"and shifted by {', '.join(row.shift)} mm; it was touched, or the body is not as the model has it. The "
        "dataset has the camera where it was found; calibrate again before the next recording"
        for row in rows
        if row.touched
    ]
    return [*_doubts(rows), *clocks, *touched]


def _doubts(rows: list[CameraRow]) -> list[str]:
    """A line on the cameras whose pixels no change of the cameras explains."""
    if not (doubtful := [row for row in rows if not row.explained]):
        return []
    names = ", ".join(row.camera for row in doubtful)
    remains = "; ".join(f"{row.camera} {', '.join(row.remains)}" for row in doubtful)
    return [
        f"camera{'s' if len(doubtful) > 1 else ''} {names}: a moved camera does not explain the pixels. What remains "
        f"between the simulated and the recorded motion ({remains}) is there whatever the cameras' poses and clocks. "
        f"So {OTHER_CAUSES}. Correct that, or leave --refine-cameras out: the turns, shifts and clocks that the "
        "dataset has now are not to be relied on"
    ]
