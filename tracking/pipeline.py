"""One recording's whole way: videos to tracks."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.calibration.rig import Rig, rig_text
from rafl.tracking.linking.follow import FEWEST_MARKERS, PixelTracks, follow
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.naming import name_by_layout, name_by_rows
from rafl.tracking.reconstruction.gap_filling import MEASURED, fill_gaps
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, at_times, shown_frames, triangulate
from rafl.tracking.video.reader import Video
from rafl.tracking.video.timestamps import camera_times, common_clock, delays

from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.common.version import VERSION

Array = NDArray[Any]


@dataclass(frozen=True)
class TrackingSettings:
    """How a recording is tracked.

    Attributes:
        layout: of the specimen's markers; None to name by row and column.
        fps: true frames per second; None to believe the video.
        fill: longest gap that is bridged [frames].
        sync: whether to find the cameras' delays from the motion.
    """

    layout: MarkerLayout | None
    fps: float | None
    fill: int
    sync: bool = False

    def text(self) -> str:
        """All of it in words, for the tracks file; equal for equal settings."""
        named = "row and column"
        if self.layout is not None:
            digest = hashlib.sha256(repr(self.layout.names).encode() + self.layout.positions.tobytes()).hexdigest()
            named = f"layout of {len(self.layout.names)} markers {digest[:16]}"
        clock = "synchronised by the motion" if self.sync else "calibrated"
        return f"fps = {self.fps or 'from the video'}; fill = {self.fill} frames; clocks {clock}; named by {named}"


def finished(path: Path, videos: dict[str, Video], rig: Rig, settings: TrackingSettings) -> Tracks | None:
    """The tracks at `path`, where they are whole and of just these videos, cameras and settings; else None."""
    if not path.is_file():
        return None
    try:
        tracks = read_tracks(path)
    except InputError:
        return None
    same = tracks.calibration == rig_text(rig) and tracks.settings == settings.text() and tracks.version == VERSION
    return tracks if same and tracks.sources == _sources(videos) else None


def _sources(videos: dict[str, Video]) -> dict[str, str]:
    return {video.path.name: sha256(video.path) for video in videos.values()}


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
    times = camera_times({camera: item.time for camera, item in followed.items()}, videos, settings.fps)
    names = {camera: _names(item, videos[camera], rig, camera, settings.layout) for camera, item in followed.items()}
    order = _all_names(names, settings.layout)
    filmed = {camera: _in_order(item, names[camera], order) for camera, item in followed.items()}
    ahead = {camera: rig.cameras[camera].time_offset for camera in filmed}
    notes = [note for item in followed.values() for note in item.notes]
    if settings.sync and len(filmed) > 1:
        ahead = delays(rig, filmed, times)
        notes += [f"camera {camera}: clock {1e3 * delay:+.3f} ms by the motion" for camera, delay in ahead.items()]
    on_rig = {camera: time - ahead[camera] for camera, time in times.items()}
    clock = common_clock(on_rig)
    frame = {camera: shown_frames(time, clock) for camera, time in on_rig.items()}
    pixels = {camera: at_times(item, on_rig[camera], clock) for camera, item in filmed.items()}
    position, sigma, residual = triangulate(rig, pixels)
    position, sigma, state = fill_gaps(position, sigma, clock, settings.fill)
    measured = int((state == MEASURED).any(axis=0).sum())
    if measured < FEWEST_MARKERS:
        raise InputError(f"expected at least {FEWEST_MARKERS} markers, tracked {measured}; check the lighting")
    for camera, item in followed.items():
        lost = np.flatnonzero(item.damaged)
        if len(lost):
            notes.append(f"{videos[camera].path.name}: frames {_ranges(lost)} are damaged and count as missing")
    return Tracks(
        names=tuple(order),
        time=clock - clock[0],
        position=position,
        sigma=sigma,
        state=state,
        pixel={camera: item.pixel for camera, item in pixels.items()},
        residual=residual,
        pixel_sigma={camera: item.sigma for camera, item in pixels.items()},
        damaged={camera: item.damaged[frame[camera]] & (frame[camera] >= 0) for camera, item in followed.items()},
        frame=frame,
        pictures={camera: item.pictures for camera, item in followed.items()},
        fps=float(1.0 / np.median(np.diff(clock))),
        calibration=rig_text(rig),
        sources=_sources(videos),
        settings=settings.text(),
        notes=tuple(notes),
    )


def _in_order(item: PixelTracks, names: list[str | None], order: list[str]) -> CameraPixels:
    pixel = np.full((len(item.time), len(order), 2), np.nan)
    sigma = np.full_like(pixel, np.nan)
    for dot, name in enumerate(names):
        if name:
            pixel[:, order.index(name)] = item.pixel[:, dot]
            sigma[:, order.index(name)] = item.sigma[:, dot]
    return CameraPixels(pixel, sigma)


def _ranges(frames: NDArray[np.int64]) -> str:
    """Frames in words: 3, 7 to 9, 12."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    words = [str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    return ", ".join(words[:12]) + (f" and {len(words) - 12} more stretches" if len(words) > 12 else "")


def _names(item: PixelTracks, video: Video, rig: Rig, camera: str, layout: MarkerLayout | None) -> list[str | None]:
    if layout is not None:
        chosen = name_by_layout(item.start, layout, rig.cameras[camera], str(video.path))
        return [layout.names[index] if index >= 0 else None for index in chosen]
    prefix = f"{camera}-" if len(rig.cameras) > 1 else ""
    return [prefix + name for name in name_by_rows(item.start, item.late)]


def _all_names(names: dict[str, list[str | None]], layout: MarkerLayout | None) -> list[str]:
    found = [name for of_camera in names.values() for name in of_camera if name]
    if layout is not None:
        return [name for name in layout.names if name in found]
    return sorted(dict.fromkeys(found), key=lambda name: [int(p) if p.isdigit() else p for p in _parts(name)])


def _parts(name: str) -> list[str]:
    head, _, tail = name.rpartition("r")
    row, _, column = tail.partition("c")
    return [head, row, column]
