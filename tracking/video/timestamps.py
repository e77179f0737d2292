"""One clock for all cameras of a recording."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.rig import Rig
from rafl.tracking.reconstruction.triangulation import CameraPixels, at_times, nearest_frames, triangulate
from rafl.tracking.video.reader import Video
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from rafl.common.errors import InputError

Array = NDArray[Any]

LONGEST_DELAY = 12.0  # frames that cameras may have been started apart
VALLEYS, AS_GOOD = 8, 4.0  # delays looked at closely; how much worse than the best may still be the true one
FEWEST_COMMON = 3  # markers that two cameras must share to be synchronised by position


def camera_times(times: dict[str, Array], videos: dict[str, Video], fps: float | None) -> dict[str, Array]:
    """The time of every frame by camera [s]: `fps` where given, else the videos' own stamps.

    Raises:
        InputError: fewer than two frames, or stamps that do not rise.
    """
    result = {}
    for camera, time in times.items():
        path = videos[camera].path
        if len(time) < 2:
            raise InputError(f"{path}: expected at least two frames, found {len(time)}; is the video complete?")
        if fps is not None:
            result[camera] = np.arange(len(time)) / fps
            continue
        if path.is_dir():
            raise InputError(f"{path}: a folder of pictures has no times; give the true rate with --fps")
        if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
            frame = int(np.argmax(~np.isfinite(time) | np.r_[False, np.diff(time) <= 0]))
            raise InputError(
                f"{path}: expected a later time with every frame, found {1e3 * time[frame]:.6g} ms at frame {frame}; "
                "give the true rate with --fps"
            )
        result[camera] = time
    rates = {camera: 1.0 / float(np.median(np.diff(time))) for camera, time in result.items()}
    first, rate = next(iter(rates.items()))
    for camera, other in rates.items():
        if abs(other / rate - 1.0) > 0.02:
            raise InputError(
                f"{videos[camera].path}: expected {rate:.6g} frames/s as in camera {first}, found {other:.6g}; record "
                "all cameras at one rate, or give the true rate with --fps"
            )
    return result


def common_clock(times: dict[str, Array]) -> Array:
    """Times at which the recording is reconstructed [s], (T): the first camera's, and others' that it dropped."""
    clock = next(iter(times.values()))
    step = float(np.median(np.diff(clock)))
    for time in times.values():
        gap = np.abs(time - clock[nearest_frames(clock, time)])
        inside = (time > clock[0]) & (time < clock[-1])
        clock = np.sort(np.concatenate([clock, time[inside & (gap > 0.7 * step)]]))
    return clock


def delays(rig: Rig, pixels: dict[str, CameraPixels], times: dict[str, Array]) -> dict[str, float]:
    """By how much each camera's clock runs ahead of the first's [s], from the motion.

    Two cameras that see the same markers agree on their places only where their clocks do. Cameras that
    share no marker must at least see the body move alike.

    Raises:
        InputError: too little motion to tell.
    """
    names = list(pixels)
    first = names[0]
    result = {first: 0.0}
    step = float(np.median(np.diff(times[first])))
    for other in names[1:]:
        both = np.isfinite(pixels[first].sigma[..., 0]).any(0) & np.isfinite(pixels[other].sigma[..., 0]).any(0)
        if both.sum() >= FEWEST_COMMON:
            cost = _disagreement(rig, pixels, times, first, other, both)
        else:
            cost = _unlikeness(pixels, times, first, other)
        tried = step * np.arange(-LONGEST_DELAY, LONGEST_DELAY + 0.25, 0.5)
        costs = np.array([cost(delay) for delay in tried])
        if not np.isfinite(costs).any() or np.nanmin(costs) > 0.7 * np.nanmedian(costs):
            raise InputError(
                f"camera {other}: expected motion that shows how its clock stands against camera {first}'s, found "
                "too little; film a livelier motion, or leave out --sync and set time_offset_s in calib.yaml"
            )
        valleys = [
            minimize_scalar(cost, bounds=(start - 0.5 * step, start + 0.5 * step), method="bounded")
            for start in tried[np.argsort(costs)[:VALLEYS]]
        ]
        # A swing looks much the same one period on: of delays as good, the shortest.
        best = min(valley.fun for valley in valleys)
        result[other] = min((float(valley.x) for valley in valleys if valley.fun < AS_GOOD * best + 1e-9), key=abs)
    return result


def _disagreement(rig, pixels, times, first, other, both):
    """Root mean square reprojection residual [px] as a function of the other camera's delay [s]."""
    mine = CameraPixels(pixels[first].pixel[:, both], pixels[first].sigma[:, both])
    theirs = CameraPixels(pixels[other].pixel[:, both], pixels[other].sigma[:, both])
    pair = Rig({name: rig.cameras[name] for name in (first, other)})

    def cost(delay: float) -> float:
        shifted = at_times(theirs, times[other] - delay, times[first])
        seen = np.isfinite(mine.sigma[..., 0]) & np.isfinite(shifted.sigma[..., 0])
        if seen.sum() < 20:
            return np.inf
        even = np.where(seen[..., None], 1.0, np.nan)
        # Judged by the robust mean of residuals without leaving any out.
        found = triangulate(
            pair, {first: CameraPixels(mine.pixel, even * 50.0), other: CameraPixels(shifted.pixel, even * 50.0)}
        )
        residual = np.concatenate([values[seen] for values in found[2].values()])
        return float(np.sqrt(np.mean(np.minimum(residual, 50.0) ** 2)))

    return cost


def _unlikeness(pixels, times, first, other):
    """The share of one view's motion that the other's does not explain, as a function of the delay [s]."""

    def motion(item: CameraPixels, modes: int) -> Array:
        whole = np.isfinite(item.sigma[..., 0]).mean(axis=0) > 0.9
        path = item.pixel[:, whole].reshape(len(item.pixel), -1)
        path = np.where(np.isfinite(path), path - np.nanmean(path, axis=0), 0.0)
        left, size, _ = np.linalg.svd(path, full_matrices=False)
        return left[:, :modes] * size[:modes]

    mine, theirs = motion(pixels[first], 1), CubicSpline(times[other], motion(pixels[other], 3))

    def cost(delay: float) -> float:
        asked = times[first] + delay
        inside = (asked >= times[other][0]) & (asked <= times[other][-1])
        if inside.sum() < 20:
            return np.inf
        a, b = mine[inside] - mine[inside].mean(axis=0), theirs(asked[inside])
        basis = np.linalg.qr(b - b.mean(axis=0))[0]
        return float(1.0 - ((basis.T @ a) ** 2).sum() / ((a**2).sum() + 1e-12))

    return cost
