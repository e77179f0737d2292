"""What one camera measured of the markers in its frames, and where the markers were then."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.rig import Rig
from rafl.tracking.reconstruction.gap_filling import MEASURED
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, outlier_limit, resample_pixels, triangulate_some

Array = NDArray[Any]


@dataclass(frozen=True)
class FilmedMarkers:
    """What one camera measured in the frames that the rows of tracks show. No frame is in two rows.

    Attributes:
        pixel, sigma: [px], (T, M, 2), NaN where the camera did not see the marker, or contradicts the others.
        position: of the marker at the time of the frame [m], (T, M, 3); NaN where the cameras did not measure it.
        alone: whether this camera alone saw the marker, (T, M).
        lag: time of the frame minus that of the row [s], (T); 0 where the row shows none.
    """

    pixel: Array
    sigma: Array
    position: Array
    alone: NDArray[np.bool_]
    lag: Array

    @classmethod
    def of(cls, tracks: Tracks, rig: Rig, camera: str) -> "FilmedMarkers":
        """What a camera measured.

        Where its frames do not coincide with the rows, the positions at the times of the frames are triangulated from
        its pixels and those of the other cameras, interpolated to these times; before the first row and after the last
        one the positions are those of the row. Files of earlier programs do not hold these pixels: those interpolated
        to the times of the rows take their place, with a lag of 0.
        """
        pixel, sigma = tracks.in_frames(camera)
        frame, lag = tracks.frame[camera], tracks.lag.get(camera, np.zeros(len(tracks.time)))
        shown = _nearest_rows(frame, lag)
        position = np.where((tracks.state == MEASURED)[..., None], tracks.position, np.nan)
        alone = np.sum([np.isfinite(values[..., 0]) for values in tracks.pixel_sigma.values()], axis=0) == 1
        residual = tracks.residual[camera]
        if tracks.lacks_filmed(camera):
            shown, lag = np.ones_like(shown), np.zeros_like(lag)
        elif camera in tracks.filmed_time:
            own = tracks.filmed_time[camera][frame]
            inside = shown & (own >= tracks.time[0]) & (own <= tracks.time[-1])
            position, alone, residual = position.copy(), alone.copy(), residual.copy()
            for values, at_frames in zip((position, alone, residual), _at_frames(tracks, rig, camera), strict=True):
                values[inside] = at_frames[frame[inside]]
        with np.errstate(invalid="ignore"):
            agrees = residual <= outlier_limit(sigma, rig.cameras[camera])
        kept = (shown[:, None] & agrees & np.isfinite(sigma).all(axis=2) & np.isfinite(position).all(axis=2))[..., None]
        lag = np.where(shown, lag, 0.0)
        return cls(np.where(kept, pixel, np.nan), np.where(kept, sigma, np.nan), position, alone, lag)


def _at_frames(tracks: Tracks, rig: Rig, camera: str) -> tuple[Array, NDArray[np.bool_], Array]:
    """Positions [m], (S, M, 3), whether seen by one camera alone, (S, M), and residuals [px], (S, M), in its frames."""
    time, pixels = tracks.filmed_time[camera], {}
    for name in tracks.pixel:
        if name in tracks.filmed_time:
            own = CameraPixels(tracks.filmed_pixel[name], tracks.filmed_sigma[name])
            pixels[name] = resample_pixels(own, tracks.filmed_time[name], time)
        else:
            pixels[name] = resample_pixels(
                CameraPixels(tracks.pixel[name], tracks.pixel_sigma[name]), tracks.time, time
            )
    alone = np.sum([np.isfinite(item.sigma[..., 0]) for item in pixels.values()], axis=0) == 1
    position, _, residual = triangulate_some(rig, pixels)
    return position, alone, residual[camera]


def _nearest_rows(frame: NDArray[np.int64], lag: Array) -> NDArray[np.bool_]:
    """Whether a row shows a frame, and no other row that shows the same is nearer to it, (T)."""
    order = np.argsort(np.abs(lag), kind="stable")
    _, first = np.unique(frame[order], return_index=True)
    result = np.zeros(len(frame), bool)
    result[order[first]] = True
    return result & (frame >= 0)
