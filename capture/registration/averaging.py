"""Means over frames in which nothing moves: of marker positions, and of what the cameras measured."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.capture.registration.camera_change import without_lag
from rafl.capture.registration.recording import Recording
from rafl.data.views import View, seen_axes

Array = NDArray[Any]

UNOBSERVED_SIGMA = 1.0  # [m], assumed for a coordinate that was not observed


def average_frames(position: Array, sigma: Array) -> tuple[Array, Array]:
    """Weighted mean over frames and its sigma [m], (M, 3).

    Averaging reduces only the part of the variance that is seen as scatter between the frames; the rest of sigma is
    systematic and stays.

    Args:
        position, sigma: [m], (T, M, 3), NaN where missing.

    Returns:
        Mean, NaN for markers that are missing in all frames, and sigma, infinite for these.
    """
    sigma = np.where(np.isfinite(sigma), sigma, UNOBSERVED_SIGMA)
    measured = np.isfinite(position[..., :1])
    weight = np.where(measured, 1.0 / np.where(measured, sigma, 1.0) ** 2, 0.0)
    total, count = weight.sum(axis=0), measured.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (weight * np.where(measured, position, 0.0)).sum(axis=0) / total
        variance = count / total  # of one frame
        scatter = np.where(measured, (position - mean) ** 2, 0.0).sum(axis=0) / np.maximum(count - 1, 1)
        white = np.minimum(scatter, variance)
        return mean, np.where(total > 0, np.sqrt(variance - white + white / count), np.inf)


def average_views(views: dict[str, View], near: Array) -> tuple[Array, Array, Array]:
    """Positions that the cameras measured on average over some frames, and in which directions.

    Args:
        views: by camera.
        near: positions about which the projection is linearised [m], (M, 3), NaN where not known.

    Returns:
        Positions [m], (M, 3), NaN where no camera saw the marker, and its measured directions as in
        `rafl.data.views.seen_axes`. In directions that were not measured a position stays near the given one.
    """
    means = {}
    for name, view in ((name, view.without_motion(near)) for name, view in views.items()):
        known = np.isfinite(near[:, :1])
        pixel, sigma = average_frames(view.pixel, np.sqrt(np.diagonal(view.covariance, axis1=-2, axis2=-1)))
        seen = known & np.isfinite(sigma)
        pixel, sigma = np.where(seen, pixel, np.nan), np.where(seen, sigma, np.nan)
        means[name] = replace(
            view, pixel=pixel[None], covariance=(sigma**2)[None, ..., None] * np.eye(2), lag=np.zeros(1)
        )
    axes, sigma = seen_axes(means, near)
    target = np.where(np.isfinite(sigma[:, :1]), near, np.nan)
    # One Gauss-Newton step towards the mean pixels, in the measured directions.
    step = np.zeros_like(target)
    for view in means.values():
        seen = view.seen[0]
        slope = view.jacobian(near[seen])[0]
        gap = view.pixel[0, seen] - view.project(near[seen])[0]
        step[seen] += (slope.swapaxes(1, 2) @ np.linalg.solve(view.covariance[0, seen], gap[..., None]))[..., 0]
    along = np.where(np.isfinite(sigma), sigma, 0.0) ** 2 * (axes @ step[..., None])[..., 0]
    return target + (axes.swapaxes(1, 2) @ along[..., None])[..., 0], axes, sigma


def average_recording(recording: Recording, chosen: slice | NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Mean positions of a recording's markers over some frames, by what the cameras measured where that is known.

    Returns:
        Positions [m], (M, 3), NaN where missing, the directions in which they were measured as rows, (M, 3, 3), and the
        sigmas along these [m], (M, 3), infinite where not measured. Without views they are x, y and z.
    """
    position, sigma = average_frames(recording.position[chosen], recording.sigma[chosen])
    if recording.views:
        return average_views({name: view.select_frames(chosen) for name, view in recording.views.items()}, position)
    return position, np.broadcast_to(np.eye(3), (len(position), 3, 3)), sigma


def measured_directions(recording: Recording, markers: slice) -> tuple[Array, Array, Array]:
    """As `average_recording`, but of some markers at the time of every frame: (T, M, 3), (T, M, 3, 3), (T, M, 3)."""
    position = recording.position[:, markers]
    shape = position.shape
    if not recording.views:
        return position, np.broadcast_to(np.eye(3), (*shape, 3)), recording.sigma[:, markers]
    # The cameras are at rest, so that the markers of all frames can be those of one.
    views = {
        name: replace(
            view,
            pixel=view.pixel[:, markers].reshape(1, -1, 2),
            covariance=view.covariance[:, markers].reshape(1, -1, 2, 2),
            lag=np.zeros(1),
        )
        for name, view in ((name, without_lag(view, recording.time)) for name, view in recording.views.items())
    }
    found, axes, sigma = average_views(views, position.reshape(-1, 3))
    return found.reshape(shape), axes.reshape(*shape, 3), sigma.reshape(shape)
