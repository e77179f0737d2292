"""Frame times, and one clock for all cameras of a recording."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.tracking.reconstruction.triangulation import CameraPixels, nearest_frames, resample_pixels, triangulate
from rafl.tracking.video.reader import Video

Array = NDArray[Any]

SAME_RATE = 0.02  # relative difference of two frame rates that count as equal: containers round them
LEAST_DELAY_FRAMES = 0.5  # of a camera that began at another frame than the others
MAX_DELAY_FRAMES = 12.0  # between the starts of two cameras
# The delay with the lowest cost is searched around the MAX_MINIMA lowest samples. The true one may cost up to
# ACCEPTED_COST_RATIO times the lowest.
MAX_MINIMA, ACCEPTED_COST_RATIO = 8, 4.0
MIN_COMMON_MARKERS = 3  # that two cameras must share to be synchronised by reprojection
# At a tried delay both cameras must have this many marker observations at the same times (frames, without shared
# markers). Otherwise its cost is infinite.
MIN_COMMON_OBSERVATIONS = 20


def camera_times(times: dict[str, Array], videos: dict[str, Video], fps: float | None) -> dict[str, Array]:
    """Time of every frame by camera [s], from `fps` if given, else from the timestamps.

    The timestamps of a slow-motion file are scaled to the frame rate at which it was recorded.

    Args:
        times: timestamps by camera [s], (T).
        videos: by camera.
        fps: frame rate [1/s], or None.

    Raises:
        InputError: a video has fewer than two frames, no timestamps or some that do not increase, or frame rates
            differ.
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
            raise InputError(f"{path}: a folder of images has no times; give the true frame rate with --fps")
        if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
            frame = int(np.argmax(~np.isfinite(time) | np.r_[False, np.diff(time) <= 0]))
            raise InputError(
                f"{path}: expected timestamps that increase with every frame, found {1e3 * time[frame]:.6g} ms at "
                f"frame {frame}; give the true frame rate with --fps"
            )
        played, recorded = frame_rate(time), videos[camera].capture_fps
        result[camera] = time * played / recorded if recorded else time
    rates = {camera: frame_rate(time) for camera, time in result.items()}
    first, rate = next(iter(rates.items()))
    for camera, other in rates.items():
        if abs(other / rate - 1.0) > SAME_RATE:
            raise InputError(
                f"{videos[camera].path}: expected {rate:.6g} frames/s as in camera {first}, found {other:.6g}; record "
                "all cameras at one frame rate, or give the true one with --fps"
            )
    return result


def frame_rate(time: Array) -> float:
    """Frames per second of times (T) [s]."""
    return 1.0 / float(np.median(np.diff(time)))


def clock_text(delay: float, rate: float) -> str:
    """A delay [s] in seconds, as in `time_offset_s` of calib.yaml, and in frames at a rate [1/s]."""
    return f"{delay:+.6f} s ({delay * rate:+.2f} frames)"


def slow_motion_note(video: Video, time: Array) -> list[str]:
    """A note on a video whose timestamps (T) [s] play it more slowly than it was recorded, if they do."""
    played, recorded = frame_rate(time), video.capture_fps
    if not recorded or abs(played / recorded - 1.0) < SAME_RATE:
        return []
    return [
        f"{video.path.name}: plays at {played:.6g} frames/s and was recorded at {recorded:.6g}, says its capture-rate "
        "tag; the times are those of the recording"
    ]


def common_clock(times: dict[str, Array]) -> Array:
    """Times at which the recording is reconstructed [s], (T).

    These are the times of the first camera, and those of other cameras at which it dropped frames.
    """
    clock = next(iter(times.values()))
    step = float(np.median(np.diff(clock)))
    for time in times.values():
        gap = np.abs(time - clock[nearest_frames(clock, time)])
        inside = (time > clock[0]) & (time < clock[-1])
        clock = np.sort(np.concatenate([clock, time[inside & (gap > 0.7 * step)]]))
    return clock


def estimate_clock_delays(
    rig: Rig, pixels: dict[str, CameraPixels], times: dict[str, Array], by_motion: bool = False
) -> dict[str, float]:
    """Offset of each camera's clock from the first camera's [s], estimated from the motion; positive if it is ahead.

    If two cameras share markers, their reprojection residual is lowest at the true delay. Otherwise the motion of the
    markers that one camera sees must be explained by the motion that the other sees.

    Args:
        rig: the cameras.
        pixels: markers by camera.
        times: of the frames by camera [s], (T).
        by_motion: whether to leave out reprojection, which takes a hundred times as long.

    Raises:
        InputError: there is too little motion.
    """
    names = list(pixels)
    first = names[0]
    result = {first: 0.0}
    step = float(np.median(np.diff(times[first])))
    for other in names[1:]:
        seen = [np.isfinite(pixels[camera].sigma[..., 0]).any(0) for camera in (first, other)]
        both: NDArray[np.bool_] = np.asarray(seen[0] & seen[1])
        if both.sum() >= MIN_COMMON_MARKERS and not by_motion:
            cost = _reprojection_cost(rig, pixels, times, first, other, both)
        else:
            cost = _motion_cost(pixels, times, first, other)
        samples = step * np.arange(-MAX_DELAY_FRAMES, MAX_DELAY_FRAMES + 0.25, 0.5)
        costs = np.array([cost(delay) for delay in samples])
        if not np.isfinite(costs).any() or np.nanmin(costs) > 0.7 * np.nanmedian(costs):
            raise InputError(
                f"camera {other}: expected motion that shows the delay to camera {first}, found too little; record "
                "a livelier motion, or leave out --sync and set time_offset_s in calib.yaml"
            )
        minima = [
            minimize_scalar(cost, bounds=(start - 0.5 * step, start + 0.5 * step), method="bounded")
            for start in samples[np.argsort(costs)[:MAX_MINIMA]]
        ]
        # An oscillation repeats after one period; of the delays with an accepted cost the shortest is taken.
        accepted_cost = ACCEPTED_COST_RATIO * min(minimum.fun for minimum in minima) + 1e-9
        result[other] = min((float(minimum.x) for minimum in minima if minimum.fun < accepted_cost), key=abs)
    return result


def late_starts(
    rig: Rig, pixels: dict[str, CameraPixels], times: dict[str, Array]
) -> tuple[dict[str, float], list[str]]:
    """Time offsets of cameras [s], and notes on cameras that began at different times.

    Offsets are those of the calibration, and the motion may show others. Where the cameras recorded different numbers
    of frames, it is believed: some began or stopped at another time. Where the numbers are equal, a note asks. Delays
    of less than `LEAST_DELAY_FRAMES` could be errors of their estimate.

    Args:
        rig: the calibrated cameras.
        pixels: markers by camera, in the same order in all.
        times: by camera [s].
    """
    offsets = {camera: rig.cameras[camera].time_offset for camera in pixels}
    first = next(iter(pixels))
    counts = "the cameras recorded " + ", ".join(f"{len(times[camera])} ({camera})" for camera in pixels) + " frames"
    alike = len({len(time) for time in times.values()}) == 1
    try:
        if alike and not _may_differ(estimate_clock_delays(rig, pixels, times, by_motion=True), rig, times):
            return offsets, []
        found = estimate_clock_delays(rig, pixels, times)
    except InputError:
        return offsets, [] if alike else [f"{counts}; whether they began together, the motion does not show"]
    notes = []
    for camera, relative in found.items():
        offset = offsets[first] + relative
        delay = offset - offsets[camera]
        frames = delay * frame_rate(times[camera])
        if abs(frames) > LEAST_DELAY_FRAMES:
            when = "later" if delay < 0.0 else "earlier"
            began = f"by the motion, {camera} began {abs(frames):.1f} frames ({abs(delay):.3f} s) {when}"
            if alike:
                notes.append(f"{began} than {first}; unless a trigger started them together, track with --sync")
            else:
                offsets[camera] = offset
                notes.append(f"{counts}; {began}: corrected")
    return offsets, notes


def _may_differ(found: dict[str, float], rig: Rig, times: dict[str, Array]) -> bool:
    """Whether a camera began at another time than its calibration says, by clock delays [s] by camera."""
    first = rig.cameras[next(iter(found))].time_offset
    return any(
        abs(first + delay - rig.cameras[camera].time_offset) * frame_rate(times[camera]) > LEAST_DELAY_FRAMES
        for camera, delay in found.items()
    )


def _reprojection_cost(
    rig: Rig,
    pixels: dict[str, CameraPixels],
    times: dict[str, Array],
    first: str,
    other: str,
    both: NDArray[np.bool_],
) -> Callable[[float], float]:
    """Root mean square reprojection residual [px] as a function of the other camera's delay [s].

    `both` selects the markers that both cameras see, (M).
    """
    reference = CameraPixels(pixels[first].pixel[:, both], pixels[first].sigma[:, both])
    delayed = CameraPixels(pixels[other].pixel[:, both], pixels[other].sigma[:, both])
    pair = Rig({name: rig.cameras[name] for name in (first, other)})

    def cost(delay: float) -> float:
        shifted = resample_pixels(delayed, times[other] - delay, times[first])
        seen = np.isfinite(reference.sigma[..., 0]) & np.isfinite(shifted.sigma[..., 0])
        if seen.sum() < MIN_COMMON_OBSERVATIONS:
            return np.inf
        uniform = np.where(seen[..., None], 1.0, np.nan)
        # The large sigma keeps all residuals; each counts with at most 50 px.
        found = triangulate(
            pair,
            {first: CameraPixels(reference.pixel, uniform * 50.0), other: CameraPixels(shifted.pixel, uniform * 50.0)},
        )
        residual = np.concatenate([values[seen] for values in found[2].values()])
        return float(np.sqrt(np.mean(np.minimum(residual, 50.0) ** 2)))

    return cost


def _motion_cost(
    pixels: dict[str, CameraPixels], times: dict[str, Array], first: str, other: str
) -> Callable[[float], float]:
    """Share of one camera's motion that the other's does not explain, as a function of the delay [s]."""

    def principal_motion(item: CameraPixels, modes: int) -> Array:
        complete = np.isfinite(item.sigma[..., 0]).mean(axis=0) > 0.9
        path = item.pixel[:, complete].reshape(len(item.pixel), -1)
        path = np.where(np.isfinite(path), path - np.nanmean(path, axis=0), 0.0)
        left, size, _ = np.linalg.svd(path, full_matrices=False)
        scores: Array = left[:, :modes] * size[:modes]
        return scores

    reference = principal_motion(pixels[first], 1)
    delayed = CubicSpline(times[other], principal_motion(pixels[other], 3))

    def cost(delay: float) -> float:
        time = times[first] + delay
        inside = (time >= times[other][0]) & (time <= times[other][-1])
        if inside.sum() < MIN_COMMON_OBSERVATIONS:
            return np.inf
        a, b = reference[inside] - reference[inside].mean(axis=0), delayed(time[inside])
        basis = np.linalg.qr(b - b.mean(axis=0))[0]
        return float(1.0 - ((basis.T @ a) ** 2).sum() / ((a**2).sum() + 1e-12))

    return cost
