"""Tracks of markers whose motion is known, without videos: from the pixels of cameras, or from positions alone."""

import numpy as np

from rafl.calibration.rig import Rig, rig_text
from rafl.tracking.reconstruction.gap_filling import MEASURED, MISSING
from rafl.tracking.reconstruction.tracks import Tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, triangulate


def tracks_of_pixels(
    names: tuple[str, ...],
    rig: Rig,
    pixels: dict[str, CameraPixels],
    fps: float = 100.0,
    longest_gap: int | None = None,
) -> Tracks:
    """The tracks that the cameras of a rig give of markers, of which every frame was decoded and nothing was filled.

    Args:
        names: of the markers, (M).
        rig: the cameras as they are calibrated.
        pixels: of the markers, by camera.
        fps: frames per second.
        longest_gap: that the tracks say was filled [frames].
    """
    position, sigma, residual = triangulate(rig, pixels)
    frames = len(position)
    return Tracks(
        names=names,
        time=np.arange(frames) / fps,
        position=position,
        sigma=sigma,
        state=np.where(np.isfinite(position[..., 0]), MEASURED, MISSING).astype(np.uint8),
        pixel={camera: item.pixel for camera, item in pixels.items()},
        residual=residual,
        pixel_sigma={camera: item.sigma for camera, item in pixels.items()},
        damaged={camera: np.zeros(frames, bool) for camera in pixels},
        frame={camera: np.arange(frames) for camera in pixels},
        images={camera: {} for camera in pixels},
        fps=fps,
        calibration=rig_text(rig),
        sources={},
        settings="",
        longest_gap=longest_gap,
    )


def tracks_of_positions(
    names: tuple[str, ...], position: np.ndarray, sigma: np.ndarray | float, fps: float = 100.0
) -> Tracks:
    """Tracks of another program, without pixels, of markers that are measured in every frame.

    Args:
        names: of the markers, (M).
        position: [m], (T, M, 3).
        sigma: of the position [m], (T, M, 3) or one for all.
        fps: frames per second.
    """
    return Tracks(
        names=names,
        time=np.arange(len(position)) / fps,
        position=position,
        sigma=np.broadcast_to(sigma, position.shape),
        state=np.full(position.shape[:2], MEASURED, np.uint8),
        pixel={},
        residual={},
        pixel_sigma={},
        damaged={},
        frame={},
        images={},
        fps=fps,
        calibration="",
        sources={},
        settings="",
    )
