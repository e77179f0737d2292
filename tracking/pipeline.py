"""One recording's whole way: videos to tracks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.rig import Rig, rig_text
from groundwork import InputError, sha256
from tracking.follow import FEWEST_MARKERS, PixelTracks, follow
from tracking.layout import MarkerLayout
from tracking.naming import name_by_layout, name_by_rows
from tracking.reconstruct import CameraPixels, fill_gaps, on_rig_clock, triangulate
from tracking.tracks import MEASURED, Tracks
from tracking.video import Video

Array = NDArray[Any]


@dataclass(frozen=True)
class TrackingSettings:
    """How a recording is tracked.

    Attributes:
        layout: of the specimen's markers; None to name by row and column.
        fps: true frames per second; None to believe the video.
        fill: longest gap that is bridged [frames].
    """

    layout: MarkerLayout | None
    fps: float | None
    fill: int


def track_recording(videos: dict[str, Video], rig: Rig, settings: TrackingSettings, tick: Callable[[], None]) -> Tracks:
    """Find, follow, name and reconstruct the markers of one recording.

    Args:
        videos: by camera.
        rig: the cameras.
        settings: how.
        tick: called after every frame of every video.

    Raises:
        InputError: a video without enough markers or of unknown rate, or one that cannot be decoded.
    """
    for video in videos.values():
        if settings.fps is None and video.path.is_dir():
            raise InputError(f"{video.path}: a folder of pictures has no times; give the true rate with --fps")
    followed = {camera: follow(video, tick) for camera, video in videos.items()}
    frames = min(len(item.time) for item in followed.values())
    time = _time(followed, videos, settings.fps, frames)
    names = {camera: _names(item, videos[camera], rig, camera, settings.layout) for camera, item in followed.items()}
    order = _all_names(names, settings.layout)
    pixels = {}
    for camera, item in followed.items():
        pixel = np.full((frames, len(order), 2), np.nan)
        sigma = np.full((frames, len(order)), np.nan)
        for dot, name in enumerate(names[camera]):
            if name:
                pixel[:, order.index(name)] = item.pixel[:frames, dot]
                sigma[:, order.index(name)] = item.sigma[:frames, dot]
        pixels[camera] = on_rig_clock(CameraPixels(pixel, sigma), time, rig.cameras[camera].time_offset)
    position, sigma, residual = triangulate(rig, pixels)
    position, sigma, state = fill_gaps(position, sigma, time, settings.fill)
    measured = int((state == MEASURED).any(axis=0).sum())
    if measured < FEWEST_MARKERS:
        raise InputError(f"expected at least {FEWEST_MARKERS} markers, tracked {measured}; check the lighting")
    return Tracks(
        tuple(order),
        time,
        position,
        sigma,
        state,
        {camera: item.pixel for camera, item in pixels.items()},
        residual,
        {camera: item.sigma for camera, item in pixels.items()},
        float(1.0 / np.median(np.diff(time))),
        rig_text(rig),
        {str(video.path): sha256(video.path) for video in videos.values()},
        f"fps = {settings.fps or 'from the video'}; fill = {settings.fill} frames; "
        f"named by {'layout' if settings.layout else 'row and column'}",
    )


def _time(followed: dict[str, PixelTracks], videos: dict[str, Video], fps: float | None, frames: int) -> Array:
    """The recording's clock [s], (T): `fps` where given, else the videos' own timestamps."""
    if frames < 2:
        raise InputError("expected at least two frames; is the video complete?")
    if fps is not None:
        return np.arange(frames) / fps
    clocks = {}
    for camera, item in followed.items():
        time = item.time[:frames]
        if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
            raise InputError(
                f"{videos[camera].path}: expected a later time with every frame, found another; give the true "
                "rate with --fps"
            )
        clocks[camera] = time
    first = next(iter(clocks.values()))
    step = float(np.median(np.diff(first)))
    for camera, time in clocks.items():
        late = np.abs(time - first)
        if late.max() > 0.5 * step:
            raise InputError(
                f"{videos[camera].path}: expected the frame times of the other camera, found frame "
                f"{int(np.argmax(late > 0.5 * step))} {1e3 * late.max():.1f} ms apart; record both cameras "
                "at one rate, or give the true rate with --fps"
            )
    return first


def _names(item: PixelTracks, video: Video, rig: Rig, camera: str, layout: MarkerLayout | None) -> list[str | None]:
    if layout is not None:
        chosen = name_by_layout(item.start, layout, rig.cameras[camera], str(video.path))
        return [layout.names[index] if index >= 0 else None for index in chosen]
    prefix = f"{camera}-" if len(rig.cameras) > 1 else ""
    return [prefix + name for name in name_by_rows(item.start)]


def _all_names(names: dict[str, list[str | None]], layout: MarkerLayout | None) -> list[str]:
    found = [name for of_camera in names.values() for name in of_camera if name]
    if layout is not None:
        return [name for name in layout.names if name in found]
    return sorted(dict.fromkeys(found), key=lambda name: [int(p) if p.isdigit() else p for p in _parts(name)])


def _parts(name: str) -> list[str]:
    head, _, tail = name.rpartition("r")
    row, _, column = tail.partition("c")
    return [head, row, column]
