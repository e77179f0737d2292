"""Arrays for the page: rows of tracks for drawing, and one marker's values over time, as little-endian float32."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import Rig
from rafl.common.errors import InputError
from rafl.review.tracks.recording import OpenRecording
from rafl.tracking.reconstruction.gap_filling import FILLED

Array = NDArray[Any]

MAX_ROWS = 1024  # of one block
ELSEWHERE, MEASURED_HERE, FILLED_HERE, LOST_HERE = 0, 1, 2, 3  # of a marker in a camera's frame


def block(recording: OpenRecording, rig: Rig | None, first: int, count: int) -> bytes:
    """Rows of tracks (R = `count`).

    In order: time [s] (R); state, whether changed (R, M); position, sigma [mm] (R, M, 3); and for each camera:
    frame, whether damaged (R); kind (R, M): 0 not in this camera, 1 measured, 2 filled, 3 missing; pixel in the frame,
    its sigma [px] (R, M, 2), of a missing marker between where it was seen last and next; residual [px] (R, M), NaN
    where no other camera sees the marker.

    Raises:
        InputError: there are no such rows.
    """
    tracks = recording.tracks
    if not (0 <= first < len(tracks.time) and 0 < count <= MAX_ROWS):
        raise InputError("expected rows of the recording, found others; load the page again")
    rows = slice(first, first + count)
    parts = [tracks.time[rows], tracks.state[rows], recording.found.changed[rows]]
    parts += [1e3 * tracks.position[rows], 1e3 * tracks.sigma[rows]]
    views = np.sum([np.isfinite(sigma[rows, :, 0]) for sigma in tracks.pixel_sigma.values()], axis=0)
    for camera in tracks.pixel:
        path, path_sigma = tracks.in_frames(camera)
        seen = np.isfinite(path[..., 0])
        known = seen.any(axis=0)
        pixel, sigma = path[rows].copy(), path_sigma[rows].copy()
        kind = np.where(seen[rows], MEASURED_HERE, np.where(known, LOST_HERE, ELSEWHERE))
        filled = (tracks.state[rows] == FILLED) & ~seen[rows] & known
        if rig is not None and filled.any():
            model = rig.cameras[camera]
            position, spread = tracks.position[rows][filled], tracks.sigma[rows][filled]
            pixel[filled] = model.project(position)
            sigma[filled] = np.sqrt(((model.projection_jacobian(position) * spread[:, None]) ** 2).sum(axis=-1))
            kind[filled] = FILLED_HERE
        lost = kind == LOST_HERE
        for marker in np.flatnonzero(lost.any(axis=0)):
            frames, here = np.flatnonzero(seen[:, marker]), np.flatnonzero(lost[:, marker])
            for axis in range(2):
                pixel[here, marker, axis] = np.interp(first + here, frames, path[frames, marker, axis])
        residual = np.where(views > 1, tracks.residual[camera][rows], np.nan)
        parts += [tracks.frame[camera][rows], tracks.damaged[camera][rows], kind, pixel, sigma, residual]
    return b"".join(np.ascontiguousarray(part, dtype="<f4").tobytes() for part in parts)


def series(recording: OpenRecording, marker: int, camera: str) -> bytes:
    """One marker over time, (T) each: x, y, z, sigma [mm]; pixel x, y, its sigma, residual [px] of a camera; state.

    The pixels are those in the camera's frames.

    Raises:
        InputError: there is no such marker or camera.
    """
    tracks = recording.tracks
    if not 0 <= marker < len(tracks.names) or camera not in tracks.pixel:
        raise InputError("expected a marker and a camera of the recording, found others; load the page again")
    views = np.sum([np.isfinite(sigma[:, marker, 0]) for sigma in tracks.pixel_sigma.values()], axis=0)
    path, path_sigma = tracks.in_frames(camera)
    parts = [
        *(1e3 * tracks.position[:, marker].T),
        1e3 * np.linalg.norm(tracks.sigma[:, marker], axis=1),
        *path[:, marker].T,
        path_sigma[:, marker].max(axis=1),
        np.where(views > 1, tracks.residual[camera][:, marker], np.nan),
        tracks.state[:, marker],
    ]
    return b"".join(np.ascontiguousarray(part, dtype="<f4").tobytes() for part in parts)
