"""A camera that moved, or whose clock is off, since its calibration, and what it measured as seen with that known."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import Camera
from rafl.calibration.rig import Rig
from rafl.data.views import View
from rafl.tracking.reconstruction.triangulation import CameraPixels, resample_pixels, triangulate_some

Array = NDArray[Any]

CLOCK = 6  # index of the time offset among the values


@dataclass(frozen=True)
class CameraChange:
    """How a camera differs from its calibration.

    Attributes:
        value: rotation vector [rad] of a turn about `centre`, after a shift [m], in the specimen frame; what is to be
            added to its time offset [s]; (7).
        centre: [m], (3).
        covariance: of the value, (7, 7); zero unless it was found.
    """

    value: Array
    centre: Array
    covariance: Array = field(default_factory=lambda: np.zeros((7, 7)))

    def moved(self, camera: Camera) -> Camera:
        """The camera where it is now; the plane of the markers stays."""
        turn, shift = self.turn, self.value[3:6]
        return replace(camera.in_frame(turn, turn @ (shift - self.centre) + self.centre), plane=camera.plane)

    @property
    def turn(self) -> Array:
        """Rotation, (3, 3)."""
        matrix: Array = Rotation.from_rotvec(self.value[:3]).as_matrix()
        return matrix

    def pose_slope(self, camera: Camera, points: Array) -> Array:
        """Derivatives of the pixels of points (..., 3) [m] in the moved camera by its turn and shift, (..., 2, 6).

        A camera that turns sees the points turned the other way.
        """
        slope = camera.jacobian(points)
        turned = np.cross((points - self.centre)[..., None, :], np.eye(3)).swapaxes(-1, -2)
        result: Array = np.concatenate([slope @ turned, -slope @ self.turn], axis=-1)
        return result

    def applied(self, view: View) -> View:
        """What the camera measured, as seen from where it is now and at its own times."""
        return replace(view, camera=self.moved(view.camera), lag=view.lag - self.value[CLOCK])


def positions_at(views: Mapping[str, View], time: Array) -> tuple[Array, Array]:
    """Positions [m] of the markers at the times of the frames, and their standard deviations, (T, M, 3) each.

    NaN where no camera measured a marker, or two disagree. Before its first time, and after its last, a camera shows
    what it showed there.

    time: of the frames [s], (T).
    """
    pixels = {name: _at_row_times(view, time, clip=True) for name, view in views.items()}
    rig = Rig({name: view.camera for name, view in views.items()})
    position, sigma, _ = triangulate_some(rig, pixels)
    return position, sigma


def without_lag(view: View, time: Array) -> View:
    """A view with its pixels interpolated to the times of the frames [s], (T); NaN where it filmed none around."""
    if not view.lag.any():
        return view
    found = _at_row_times(view, time, clip=False)
    covariance = (found.sigma**2)[..., None] * np.eye(2)
    return replace(view, pixel=found.pixel, covariance=covariance, lag=np.zeros_like(view.lag))


def _at_row_times(view: View, time: Array, clip: bool) -> CameraPixels:
    """Pixels interpolated to the times of the frames (T); with `clip`, at the ends those of the first and last time."""
    own = time + view.lag
    sigma = np.sqrt(np.diagonal(view.covariance, axis1=-2, axis2=-1))
    return resample_pixels(CameraPixels(view.pixel, sigma), own, np.clip(time, own[0], own[-1]) if clip else time)
