"""Tracks of a rig in which one camera's clock is late: what `rafl-track` makes of exact motions with errors."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from rafl.calibration.camera import Camera
from rafl.calibration.rig import Rig, rig_text
from rafl.tracking.reconstruction.gap_filling import fill_gaps
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.reconstruction.triangulation import (
    CameraPixels,
    coincide,
    resample_pixels,
    shown_frames,
    triangulate,
)
from rafl.tracking.video.timestamps import common_clock


def film(
    cameras: Mapping[str, Camera],
    times: Mapping[str, np.ndarray],
    motion: Callable[[np.ndarray], np.ndarray],
    sigma: float,
    random: np.random.Generator,
) -> dict[str, CameraPixels]:
    """Pixels by camera, with errors, of markers that move (S) -> (S, M, 3) [m], in frames at times [s], (S)."""
    result = {}
    for name, camera in cameras.items():
        pixel = camera.project(motion(times[name]))
        result[name] = CameraPixels(pixel + random.normal(0.0, sigma, pixel.shape), np.full_like(pixel, sigma))
    return result


def track(
    cameras: Mapping[str, Camera],
    times: Mapping[str, np.ndarray],
    pixels: Mapping[str, CameraPixels],
    names: tuple[str, ...],
    longest: int = 0,
) -> Tracks:
    """Tracks of pixels filmed at times on one clock [s]."""
    clock, rig = common_clock(dict(times)), Rig(dict(cameras))
    frame = {name: shown_frames(own, clock) for name, own in times.items()}
    rows = {name: resample_pixels(pixels[name], own, clock) for name, own in times.items()}
    apart = [name for name, own in times.items() if not coincide(own, clock)]
    position, sigma, residual = triangulate(rig, rows)
    position, sigma, state = fill_gaps(position, sigma, clock, longest)
    return Tracks(
        names=names,
        time=clock - clock[0],
        position=position,
        sigma=sigma,
        state=state,
        pixel={name: item.pixel for name, item in rows.items()},
        residual=residual,
        pixel_sigma={name: item.sigma for name, item in rows.items()},
        damaged={name: np.zeros(len(clock), bool) for name in rows},
        frame=frame,
        images={name: {} for name in rows},
        fps=1.0 / float(np.median(np.diff(clock))),
        calibration=rig_text(rig),
        sources={},
        settings="",
        lag={name: np.where(own < 0, 0.0, times[name][own] - clock) for name, own in frame.items()},
        filmed_time={name: times[name] - clock[0] for name in apart},
        filmed_pixel={name: pixels[name].pixel for name in apart},
        filmed_sigma={name: pixels[name].sigma for name in apart},
        longest_gap=longest,
    )


def as_in_version_1(tracks: Tracks) -> Tracks:
    """The tracks as programs wrote them that kept only the pixels interpolated to the times of the rows."""
    return replace(tracks, filmed_time={}, filmed_pixel={}, filmed_sigma={})
