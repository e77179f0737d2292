"""Readers of recorded marker positions: tracks, C3D and npy files."""

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
from numpy.typing import NDArray

from rafl.capture.registration.recording import Recording
from rafl.common.errors import InputError
from rafl.common.files import sha256
from rafl.tracking.reconstruction.gap_filling import MISSING
from rafl.tracking.reconstruction.tracks import read_tracks

Array = NDArray[Any]

SUFFIXES = (".h5", ".c3d", ".npy")
ASSUMED_SIGMA = 1e-4  # of files without uncertainties [m]
MAX_COORDINATE = 10.0  # [m]; a larger coordinate shows that the file has another unit


def find_source(folder: Path, recording: str) -> Path:
    """The file of a recording.

    Raises:
        InputError: no file, or more than one.
    """
    if not folder.is_dir():
        raise InputError(f"expected a folder of tracks at {folder}, found none; check the path")
    found = [path for suffix in SUFFIXES if (path := folder / f"{recording}{suffix}").is_file()]
    if not found:
        raise InputError(
            f"recording {recording}: expected {recording}.h5, .c3d or .npy in {folder}, found none; correct "
            "the name in the recordings file, or track the video"
        )
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"recording {recording}: expected one file, found {names}; move one away")
    return found[0]


def read_recording(path: Path, fps: float) -> Recording:
    """Read a tracks file, a C3D file, or a q<i>.npy file of the paper's authors.

    Args:
        path: of the file.
        fps: frames per second of npy files, which do not store it.

    Raises:
        InputError: the file cannot be read, or has another shape.
    """
    source = f"{path.name} {sha256(path)}"
    if path.suffix == ".h5":
        tracks = read_tracks(path)
        position = np.where((tracks.state == MISSING)[..., None], np.nan, tracks.position)
        return Recording(tracks.names, tracks.time, position, tracks.sigma, None, True, source)
    return _read_c3d(path, source) if path.suffix == ".c3d" else _read_npy(path, fps, source)


def _read_c3d(path: Path, source: str) -> Recording:
    try:
        file = ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"expected a C3D file in {path}, which cannot be read: {error}; export it again") from None
    group = file["parameters"]["POINT"]
    names = tuple(str(name) for name in group["LABELS"]["value"])
    unit = str(group["UNITS"]["value"][0]).strip() if group["UNITS"]["value"] else "mm"
    scale = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}.get(unit)
    if scale is None:
        raise InputError(f"{path}: expected points in m, cm or mm, found {unit!r}; export in mm")
    points = np.asarray(file["data"]["points"], dtype=float)[:3, : len(names)].transpose(2, 1, 0) * scale
    residual = np.asarray(file["data"]["meta_points"]["residuals"], dtype=float)[0, : len(names)].T * scale
    missing = (residual < 0) | (points == 0).all(axis=2) | ~np.isfinite(points).all(axis=2)
    position = np.where(missing[..., None], np.nan, points)
    sigma = np.where(residual > 0, residual, ASSUMED_SIGMA)[..., None].repeat(3, axis=2)
    rate = float(group["RATE"]["value"][0])
    return Recording(names, np.arange(len(points)) / rate, position, sigma, None, False, source)


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
    return Recording(None, time, position[1:], sigma, position[0], False, source)
