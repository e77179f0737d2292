"""Readers of recorded marker positions: tracks, C3D files, tables and npy files."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.dataset.c3d import read_c3d
from rafl.capture.dataset.marker_tables import METRES, read_marker_table
from rafl.capture.registration.recording import Recording
from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.common.names import require_names
from rafl.tracking.reconstruction.gap_filling import MISSING
from rafl.tracking.reconstruction.tracks import read_tracks

Array = NDArray[Any]

# Ends of the names of a recording's files; an earlier one says more about it. DLTdv adds `xyzpts` to a name.
ENDS = (".h5", ".csv", ".c3d", ".trc", ".tsv", "xyzpts.csv", ".npy")
ASSUMED_SIGMA = 1e-4  # of files without uncertainties [m]
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

    Args:
        path: of the file.
        fps: frames per second of files that do not store it.
        unit: of tables that do not name it: m, cm or mm.

    Raises:
        InputError: the file cannot be read, or has another shape.
    """
    source = f"{path.name} {sha256(path)}"
    if path.suffix == ".h5":
        tracks = read_tracks(path)
        position = np.where((tracks.state == MISSING)[..., None], np.nan, tracks.position)
        return Recording(tracks.names, tracks.time, position, tracks.sigma, None, True, source)
    if path.suffix == ".c3d":
        return _read_c3d(path, source)
    return _read_npy(path, fps, source) if path.suffix == ".npy" else _read_table(path, fps, unit, source)


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
        content = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"expected an array in {path}, which cannot be read: {error}; save it again") from None
    if content.ndim != 3 or content.shape[2] != 3 or len(content) < 3:
        raise InputError(
            f"{path}: expected an array (1 + frames, markers, 3) in mm with the rest pose in row 0, found "
            f"shape {content.shape}; save it in this shape"
        )
    position = 1e-3 * content.astype(float)
    if np.nanmax(np.abs(position)) > MAX_COORDINATE:
        raise InputError(f"{path}: expected mm, found values up to {np.nanmax(np.abs(content)):g}; save it in mm")
    sigma = np.full_like(position[1:], ASSUMED_SIGMA)
    time = np.arange(len(position) - 1) / fps
    rest = position[0] if np.isfinite(position[0]).any() else None
    return Recording(None, time, position[1:], sigma, rest, False, source)
