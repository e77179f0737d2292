"""The tracking of one recording, from its videos to its tracks."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.camera import OrthographicCamera
from rafl.calibration.rig import Rig, rig_text
from rafl.calibration.summary import MAX_SILENT_BIAS_M, OTHER_SET_UP
from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.common.version import VERSION
from rafl.tracking.linking.follow import MIN_MARKERS, PixelTracks, follow
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.linking.naming import averted_markers, name_by_layout, name_by_rows
from rafl.tracking.reconstruction.gap_filling import MEASURED, fill_gaps
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks
from rafl.tracking.reconstruction.triangulation import (
    CameraPixels,
    coincide,
    resample_pixels,
    shown_frames,
    triangulate,
)
from rafl.tracking.video.reader import Video
from rafl.tracking.video.timestamps import (
    camera_times,
    clock_text,
    common_clock,
    estimate_clock_delays,
    frame_rate,
    late_starts,
    slow_motion_note,
)

Array = NDArray[Any]

# Share of the markers that a load or the weight hardly displaces, those near the clamp, and how far they may be from
# their places [m]: as far as `rafl-capture` allows.
NEAREST_SHARE, MAX_OFF_PLACE = 0.2, 3e-3
NAMES_SHOWN = 4  # of the markers on a face that no camera films


@dataclass(frozen=True)
class TrackingSettings:
    """Settings for tracking a recording.

    Attributes:
        layout: layout of the specimen's markers; None to name the markers by row and column.
        fps: true frame rate [1/s]; None to use the video's.
        fill: longest gap to fill [frames].
        sync: whether to estimate the cameras' clock offsets from the motion.
    """

    layout: MarkerLayout | None
    fps: float | None
    fill: int
    sync: bool = False

    def text(self) -> str:
        """The settings as text for the tracks file. Equal settings give equal texts."""
        named = "row and column"
        if self.layout is not None:
            digest = hashlib.sha256(repr(self.layout.names).encode() + self.layout.positions.tobytes()).hexdigest()
            named = f"layout of {len(self.layout.names)} markers {digest[:16]}"
        clock = "synchronised by the motion" if self.sync else "calibrated"
        return f"fps = {self.fps or 'from the video'}; fill = {self.fill} frames; clocks {clock}; named by {named}"


def existing_tracks(path: Path, videos: dict[str, Video], rig: Rig, settings: TrackingSettings) -> Tracks | None:
    """Read the tracks at `path`; None unless they are complete and made from these videos, cameras and settings.

    Tracks of an earlier program that lack what a camera filmed between the rows are not complete.
    """
    if not path.is_file():
        return None
    try:
        tracks = read_tracks(path)
    except InputError:
        return None
    same = tracks.calibration == rig_text(rig) and tracks.settings == settings.text() and tracks.version == VERSION
    complete = not any(tracks.lacks_filmed(camera) for camera in tracks.pixel)
    return tracks if same and complete and tracks.sources == _sources(videos) else None


def _sources(videos: dict[str, Video]) -> dict[str, str]:
    return {video.path.name: sha256(video.path) for video in videos.values()}


def track_recording(videos: dict[str, Video], rig: Rig, settings: TrackingSettings, tick: Callable[[], None]) -> Tracks:
    """Find, follow, name and reconstruct the markers of one recording.

    Args:
        videos: by camera.
        rig: the calibrated cameras.
        settings: tracking settings.
        tick: called after every frame of every video.

    Raises:
        InputError: a video has too few markers or no known frame rate, or cannot be decoded.
    """
    for video in videos.values():
        if settings.fps is None and video.path.is_dir():
            raise InputError(f"{video.path}: a folder of images has no times; give the true frame rate with --fps")
    followed = {camera: follow(video, tick) for camera, video in videos.items()}
    times = camera_times({camera: item.time for camera, item in followed.items()}, videos, settings.fps)
    names = {
        camera: _marker_names(item, videos[camera], rig, camera, settings.layout) for camera, item in followed.items()
    }
    order = _ordered_names(names, settings.layout)
    in_order = {camera: _arrange_columns(item, names[camera], order) for camera, item in followed.items()}
    offsets = {camera: rig.cameras[camera].time_offset for camera in in_order}
    notes = [note for item in followed.values() for note in item.notes]
    if settings.fps is None:
        notes += [note for camera, item in followed.items() for note in slow_motion_note(videos[camera], item.time)]
    if settings.sync and len(in_order) > 1:
        offsets = estimate_clock_delays(rig, in_order, times)
        notes += [
            f"camera {camera}: clock offset {clock_text(offset, frame_rate(times[camera]))}, from the motion"
            for camera, offset in offsets.items()
        ]
    elif len(in_order) > 1:
        offsets, remarks = late_starts(rig, in_order, times)
        notes += remarks
    rig_times = {camera: time - offsets[camera] for camera, time in times.items()}
    clock = common_clock(rig_times)
    frame = {camera: shown_frames(time, clock) for camera, time in rig_times.items()}
    pixels = {camera: resample_pixels(item, rig_times[camera], clock) for camera, item in in_order.items()}
    apart = [camera for camera, time in rig_times.items() if not coincide(time, clock)]
    notes += [_late_note(camera, rig_times[camera], clock, frame[camera]) for camera in apart]
    position, sigma, residual = triangulate(rig, pixels)
    notes += [note for camera in in_order for note in _perspective_note(rig, camera, position)]
    position, sigma, state = fill_gaps(position, sigma, clock, settings.fill)
    measured = int((state == MEASURED).any(axis=0).sum())
    if measured < MIN_MARKERS:
        raise InputError(
            f"expected at least {MIN_MARKERS} markers, tracked {measured}; check the lighting and the calibration"
        )
    if settings.layout is not None:
        seen = {name for name, known in zip(order, (state == MEASURED).any(axis=0), strict=True) if known}
        other_frame = _frame_note(settings.layout, order, position)
        notes += other_frame
        averted = {} if other_frame else averted_markers(settings.layout, [rig.cameras[camera] for camera in followed])
        notes += _lost_notes([name for name in settings.layout.names if name not in seen], averted)
    for camera, item in followed.items():
        for frames, what in (
            (item.damaged, "are damaged"),
            (item.repeated, "show the frame before again while the body moves"),
        ):
            if frames.any():
                text = _range_text(np.flatnonzero(frames))
                notes.append(f"{videos[camera].path.name}: frames {text} {what} and count as missing")
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
        images={camera: item.images for camera, item in followed.items()},
        fps=float(1.0 / np.median(np.diff(clock))),
        calibration=rig_text(rig),
        sources=_sources(videos),
        settings=settings.text(),
        notes=tuple(notes),
        videos={camera: str(video.path.absolute()) for camera, video in videos.items()},
        lag={camera: np.where(shown < 0, 0.0, rig_times[camera][shown] - clock) for camera, shown in frame.items()},
        filmed_time={camera: rig_times[camera] - clock[0] for camera in apart},
        filmed_pixel={camera: in_order[camera].pixel for camera in apart},
        filmed_sigma={camera: in_order[camera].sigma for camera in apart},
        longest_gap=settings.fill,
    )


def _late_note(camera: str, time: Array, clock: Array, frame: NDArray[np.int64]) -> str:
    """A note on a camera that films at other times [s] than the rows, of which each shows a frame, or none (-1)."""
    shown = frame >= 0
    late = clock_text(float(np.median(time[frame[shown]] - clock[shown])), frame_rate(clock))
    return (
        f"camera {camera}: films {late} from the times of the tracks; its dots are interpolated there, and kept as "
        "filmed too"
    )


def _perspective_note(rig: Rig, camera: str, position: Array) -> list[str]:
    """A note on an orthographic camera whose perspective makes an error at positions (T, M, 3) [m]."""
    model = rig.cameras[camera]
    seen = model.perspective if isinstance(model, OrthographicCamera) else None
    known = position[np.isfinite(position[..., 0])]
    if seen is None or not len(known):
        return []
    pixels_per_metre = np.linalg.norm(model.projection_jacobian(np.zeros(3))[0])
    error = float(np.abs(model.model_error(known, np.zeros(len(known)))).max() / pixels_per_metre)
    if error < MAX_SILENT_BIAS_M:
        return []
    return [
        f"camera {camera}: its calibration shows perspective, as from {seen.distance:.2f} m away; the orthographic "
        f"model is up to {1e3 * error:.2f} mm wrong, which sigma contains; calibrate with --model pinhole"
    ]


def _frame_note(layout: MarkerLayout, names: list[str], position: Array) -> list[str]:
    """A note if even the markers nearest to their places in the layout are far from them: the frame is another.

    Args:
        layout: places on the undeformed specimen.
        names: of the tracked markers (M).
        position: [m], (T, M, 3).
    """
    places = layout.positions[[layout.names.index(name) for name in names]]
    off = np.full_like(places, np.nan)
    seen = np.isfinite(position[..., 0]).any(axis=0)
    off[seen] = np.nanmedian(position[:, seen], axis=0) - places[seen]
    distance = np.linalg.norm(off, axis=1)
    near = distance <= np.nanquantile(distance, NEAREST_SHARE)
    x, y, z = 1e3 * off[near].mean(axis=0)
    if distance[near].max() < MAX_OFF_PLACE:
        return []
    return [
        f"even the markers nearest to their places in the specimen file are {x:.1f}, {y:.1f}, {z:.1f} mm off along x, "
        f"y, z: the calibration's world is not the specimen's frame, or {OTHER_SET_UP}. Check also which corner of the "
        "board has the position in board.yaml (ChArUco: the corner of the print; chessboard: the outermost inner "
        "corner), or give rafl-capture a recording at rest (--rest)"
    ]


def _lost_notes(lost: list[str], averted: dict[str, list[str]]) -> list[str]:
    """Notes on markers that were never found: those on faces that look away from all cameras, and the others."""
    notes = []
    for face, names in averted.items():
        if hidden := [name for name in names if name in lost]:
            lost = [name for name in lost if name not in hidden]
            count = f"{len(hidden)} marker{'s' if len(hidden) > 1 else ''}"
            listed = ", ".join(hidden[:NAMES_SHOWN]) + (", ..." if len(hidden) > NAMES_SHOWN else "")
            notes.append(f"{count} on the face {face} ({listed}): not in view of any camera")
    if lost:
        notes.append(f"markers {', '.join(lost)} of the specimen were never found")
    return notes


def _arrange_columns(item: PixelTracks, names: list[str | None], order: list[str]) -> CameraPixels:
    """The pixels and sigmas of one camera's dots, one column per marker in the given order; NaN where not tracked."""
    pixel = np.full((len(item.time), len(order), 2), np.nan)
    sigma = np.full_like(pixel, np.nan)
    for dot, name in enumerate(names):
        if name:
            pixel[:, order.index(name)] = item.pixel[:, dot]
            sigma[:, order.index(name)] = item.sigma[:, dot]
    return CameraPixels(pixel, sigma)


def _range_text(frames: NDArray[np.int64]) -> str:
    """Frame numbers as text: 3, 7 to 9, 12."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    parts = [str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    return ", ".join(parts[:12]) + (f" and {len(parts) - 12} more ranges" if len(parts) > 12 else "")


def _marker_names(
    item: PixelTracks, video: Video, rig: Rig, camera: str, layout: MarkerLayout | None
) -> list[str | None]:
    """The marker name of each of a camera's dots; None for a dot that is no marker of the layout."""
    if layout is not None:
        indices = name_by_layout(item.start, layout, rig.cameras[camera], str(video.path))
        return [layout.names[index] if index >= 0 else None for index in indices]
    prefix = f"{camera}-" if len(rig.cameras) > 1 else ""
    return [prefix + name for name in name_by_rows(item.start, item.late_count)]


def _ordered_names(names: dict[str, list[str | None]], layout: MarkerLayout | None) -> list[str]:
    """The names of all tracked markers, in the layout's order, or else sorted by camera, row and column."""
    found = [name for of_camera in names.values() for name in of_camera if name]
    if layout is not None:
        return [name for name in layout.names if name in found]
    return sorted(dict.fromkeys(found), key=lambda name: [int(p) if p.isdigit() else p for p in _split_name(name)])


def _split_name(name: str) -> list[str]:
    """Prefix, row and column of a name such as left-r2c5."""
    head, _, tail = name.rpartition("r")
    row, _, column = tail.partition("c")
    return [head, row, column]
