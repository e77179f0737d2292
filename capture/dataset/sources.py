"""Readers of recorded marker positions: tracks, C3D files, tables and npy files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import parse_calibration
from rafl.capture.dataset.c3d import read_c3d
from rafl.capture.dataset.marker_tables import read_marker_table
from rafl.capture.registration.recording import Recording
from rafl.common.arrays import ArrayFormat, check_shape, check_values
from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.common.names import require_names
from rafl.common.units import METRES
from rafl.data.views import View
from rafl.tracking.reconstruction.corrected_tracks import CorrectedTracks, read_corrected_tracks
from rafl.tracking.reconstruction.corrections import corrections_path
from rafl.tracking.reconstruction.filmed_markers import FilmedMarkers
from rafl.tracking.reconstruction.gap_filling import MISSING
from rafl.tracking.reconstruction.tracks import Tracks

Array = NDArray[Any]

# Ends of the names of a recording's files; an earlier one says more about it. DLTdv adds `xyzpts` to a name.
ENDS = (".h5", ".csv", ".c3d", ".trc", ".tsv", "xyzpts.csv", ".npy")
ASSUMED_SIGMA = 1e-4  # of files without uncertainties [m]
MIN_FRAMES = 2
LEAST_SIGMA = 1e-12  # [m]; nothing measures better, and the square of a much smaller one is 0 in the computer
FARTHEST = 1e3  # [m]; no camera reconstructs a marker that is farther away
MAX_SPARSENESS = 100.0  # most frames that a recording may lack for each that it has; more are damage of its times
RECORDING_FORMATS = {
    "time": ArrayFormat(("T",)),
    "position": ArrayFormat(("T", "M", 3), finite=False),
    "sigma": ArrayFormat(("T", "M", 3), finite=False),
}
MAX_COORDINATE = 10.0  # [m]; a larger coordinate shows that the file has another unit


def find_sources(folder: Path, recording: str) -> list[Path]:
    """The files of a recording; the first one says most about it.

    Raises:
        InputError: no file, or a name that leads out of the folder.
    """
    require_names([recording], "recording")
    if not folder.is_dir():
        raise InputError(f"expected a folder of tracks at {folder}, found none; check the path")
    found = [path for end in ENDS if (path := folder / f"{recording}{end}").is_file()]
    if not found:
        raise InputError(
            f"recording {recording}: expected {recording}.h5, .csv, .c3d, .trc, .tsv or .npy in {folder}, found none; "
            "correct the name in the recordings file, or track the video"
        )
    return found


def read_recording(path: Path, fps: float, unit: str | None = None) -> Recording:
    """Read a tracks file, a C3D file, a table, or a q<i>.npy file of the paper's authors.

    Tracks are read with the corrections beside them. A marker of which a coordinate is missing is missing.

    Args:
        path: of the file.
        fps: frames per second of files that do not store it.
        unit: of tables that do not name it: m, cm or mm.

    Raises:
        InputError: the file cannot be read, has another shape, or its times or numbers make no recording.
    """
    return _checked(_read(path, fps, unit), path)


def recording_of_tracks(found: CorrectedTracks, path: Path) -> Recording:
    """The recording that tracks hold, which were read from `path`.

    Raises:
        InputError: their times or numbers make no recording.
    """
    return _checked(_from_tracks(found, path), path)


def _checked(recording: Recording, path: Path) -> Recording:
    try:
        _check(recording)
    except ValueError as error:
        raise InputError(f"{path}: {error}; export it again") from None
    complete = np.isfinite(recording.position).all(axis=2, keepdims=True)
    return replace(recording, position=np.where(complete, recording.position, np.nan))


def _check(recording: Recording) -> None:
    """Raise ValueError unless the arrays of a recording fit each other and its times ascend."""
    lengths = {} if recording.names is None else {"M": len(recording.names)}
    for key, expected in RECORDING_FORMATS.items():
        check_shape(key, getattr(recording, key), expected, lengths)
        check_values(key, getattr(recording, key), expected)
    time, position = recording.time, recording.position
    step = np.diff(time)
    if len(time) < MIN_FRAMES or not position.size:
        raise ValueError(f"expected {MIN_FRAMES} frames or more, and markers, found shape {position.shape}")
    if not (step > 0.0).all():
        raise ValueError(
            f"expected times that ascend, found {time[step.argmin() + 1]:g} s after {time[step.argmin()]:g} s"
        )
    if time[-1] - time[0] > MAX_SPARSENESS * len(time) * np.median(step):
        raise ValueError(f"expected frames at an even rate, found {len(time)} of them over {time[-1] - time[0]:g} s")
    infinite_rest = recording.rest is not None and np.isinf(recording.rest).any()
    if infinite_rest or np.isinf(position).any() or not np.isfinite(position).any():
        raise ValueError("expected positions that are finite, or empty where missing, found others")
    farthest = np.nanmax(np.abs(position))
    if farthest > FARTHEST:
        raise ValueError(f"expected positions within {FARTHEST:g} m, found {farthest:.3g} m")
    if not (recording.sigma[np.isfinite(position)] >= LEAST_SIGMA).all():
        raise ValueError(f"expected a sigma of at least {LEAST_SIGMA:g} m for every position, found another")


def _from_tracks(found: CorrectedTracks, path: Path) -> Recording:
    tracks, corrections = found.tracks, ""
    if found.corrections:
        beside = corrections_path(path)
        applied = len(found.corrections) - len(found.unfit)
        corrections = f"{applied} of {beside.name} {sha256(beside)}"
    position = np.where((tracks.state == MISSING)[..., None], np.nan, tracks.position)
    unfit = "; ".join((*found.unfit, *found.doubtful))
    source = f"{path.name} {sha256(path)}"
    views = _read_views(tracks, path)
    return Recording(tracks.names, tracks.time, position, tracks.sigma, None, True, source, corrections, unfit, views)


def _read(path: Path, fps: float, unit: str | None) -> Recording:
    if path.suffix == ".h5":
        return _from_tracks(read_corrected_tracks(path), path)
    source = f"{path.name} {sha256(path)}"
    if path.suffix == ".c3d":
        return _read_c3d(path, source)
    return _read_npy(path, fps, source) if path.suffix == ".npy" else _read_table(path, fps, unit, source)


def _read_views(tracks: Tracks, path: Path) -> dict[str, View]:
    """What the cameras of tracks measured in their frames: the pixels that agree with the 3-D positions.

    The covariance contains what an orthographic camera leaves out of the perspective.
    """
    if not tracks.calibration:
        return {}
    rig, views = parse_calibration(tracks.calibration, path), {}
    if lacking := set(tracks.pixel) - set(rig.cameras):
        raise InputError(f"{path}: expected the calibration of camera {min(lacking)}, found none; track again")
    for name in tracks.pixel:
        camera, filmed = rig.cameras[name], FilmedMarkers.of(tracks, rig, name)
        by_plane = 0.0 if camera.plane is None else camera.plane.sigma
        with np.errstate(invalid="ignore"):
            error = camera.model_error(filmed.position, np.where(filmed.alone, by_plane, 0.0))
        variance = np.where(np.isfinite(filmed.sigma), filmed.sigma**2 + error**2, np.nan)
        views[name] = View(camera, filmed.pixel, variance[..., None] * np.eye(2), filmed.lag)
    return views


def _read_table(path: Path, fps: float, unit: str | None, source: str) -> Recording:
    table = read_marker_table(path)
    name = (table.unit or unit or "").lower()
    if name not in METRES:
        found = f"found {table.unit!r}" if table.unit else "found none in the file"
        raise InputError(f"{path}: expected a unit, m, cm or mm, {found}; give it with --unit")
    position = METRES[name] * table.position
    sigma = np.full_like(position, ASSUMED_SIGMA) if table.sigma is None else METRES[name] * table.sigma
    time = np.arange(len(position)) / fps if table.time is None else table.time
    return Recording(table.names, time, position, sigma, None, table.in_specimen_frame, source)


def _read_c3d(path: Path, source: str) -> Recording:
    content = read_c3d(path)
    scale = METRES.get(content.unit.lower())
    if scale is None:
        raise InputError(f"{path}: expected points in m, cm or mm, found {content.unit!r}; export in mm")
    points, residual = content.points * scale, content.residuals * scale
    missing = (residual < 0) | (points == 0).all(axis=2) | ~np.isfinite(points).all(axis=2)
    position = np.where(missing[..., None], np.nan, points)
    sigma = np.where(residual > 0, residual, ASSUMED_SIGMA)[..., None].repeat(3, axis=2)
    time = np.arange(len(points)) / content.rate
    return Recording(content.names, time, position, sigma, None, content.exported, source)


def _read_npy(path: Path, fps: float, source: str) -> Recording:
    try:
        content = np.lib.format.open_memmap(path, mode="r")  # of arrays only, not larger than the file
        check_shape("array", content, ArrayFormat(("T", "M", 3)), {})
        check_values("array", content, ArrayFormat(("T", "M", 3), finite=False))
    except Exception as error:  # NumPy's reader of headers raises many kinds; all mean the same to the user
        reason = " ".join(str(error).split())
        raise InputError(
            f"expected an array (1 + frames, markers, 3) in mm with the rest pose in row 0 in {path}, which cannot be "
            f"read: {reason:.200}; save it again"
        ) from None
    if len(content) < 1 + MIN_FRAMES or not content.size:
        raise InputError(
            f"{path}: expected an array (1 + frames, markers, 3) in mm with the rest pose in row 0, found "
            f"shape {content.shape}; save it in this shape"
        )
    position = 1e-3 * np.array(content, dtype=float)
    largest = np.abs(position[np.isfinite(position)]).max(initial=0.0)
    if largest > MAX_COORDINATE:
        raise InputError(f"{path}: expected mm, found values up to {1e3 * largest:g}; save it in mm")
    sigma = np.full_like(position[1:], ASSUMED_SIGMA)
    time = np.arange(len(position) - 1) / fps
    rest = position[0] if np.isfinite(position[0]).any() else None
    return Recording(None, time, position[1:], sigma, rest, False, source)
