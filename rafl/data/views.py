"""What the cameras measured of one recording: pixels with their covariances, and the cameras themselves."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.calibration.camera import Camera
from rafl.common.arrays import ArrayFormat

Array = NDArray[Any]

# Cameras whose lines of sight differ by less than this [rad] do not show a marker's position along them.
MIN_ANGLE = 0.1
NEAR_FRAMES = 6  # that positions are interpolated through
MAX_PIXEL = 1e6  # no image is larger [px]
VIEW_ARRAYS = {
    "pixel": ArrayFormat(("T", "M", 2), finite=False, low=-MAX_PIXEL, high=MAX_PIXEL),
    "covariance": ArrayFormat(("T", "M", 2, 2), finite=False),
    "lag": ArrayFormat(("T",)),
    "rotation": ArrayFormat(("T", 3, 3), optional=True),
    "translation": ArrayFormat(("T", 3), optional=True),
    "pose_covariance": ArrayFormat(("T", 6, 6), optional=True),
}
MAX_ROTATION_ERROR = 1e-6  # of the elements of R^T R - 1
# What measurements of a camera can be; others are damage.
MIN_SIGMA, MAX_SIGMA = 1e-6, 1e6  # of a pixel [px]
MIN_SCALE, MAX_SCALE = 1.0, 1e9  # of an image at a marker [px/m]
MAX_GAP = 0.25  # between a pixel and the projection of the marker's position, as a share of the image's diagonal


@dataclass(frozen=True)
class View:
    """What one camera measured of the markers of one recording.

    Attributes:
        camera: in the specimen frame, or, if the clamp moves and the specimen frame with it, in a frame at rest.
        pixel: (T, M, 2), NaN where not seen.
        covariance: of the pixels [px^2], (T, M, 2, 2), NaN where not seen.
        lag: time at which this camera measured minus that of the recording's frame [s], (T).
        rotation, translation: of a moving specimen frame when this camera measured: a point X in the frame at rest has
            the coordinates R X + t in it, (T, 3, 3) and [m], (T, 3); None if the specimen frame is at rest.
        pose_covariance: of a rotation vector and a translation applied after R and t [rad, m], (T, 6, 6), whose errors
            differ from frame to frame and are those of all cameras; None if they are exactly known.
    """

    camera: Camera
    pixel: Array
    covariance: Array
    lag: Array
    rotation: Array | None = None
    translation: Array | None = None
    pose_covariance: Array | None = None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which markers the camera saw, (T, M)."""
        seen: NDArray[np.bool_] = np.isfinite(self.pixel[..., 0])
        return seen

    @property
    def viewing_directions(self) -> Array:
        """Lines of sight at the image centre: unit vectors away from the camera in the specimen frame, (T or 1, 3)."""
        direction = self.camera.viewing_direction[None]
        return direction if self.rotation is None else np.asarray((self.rotation @ direction[..., None])[..., 0])

    def select_markers(self, chosen: NDArray[np.int64]) -> "View":
        """The measurements of the given markers; NaN for the index -1."""
        gone = chosen < 0
        pixel, covariance = self.pixel[:, chosen].copy(), self.covariance[:, chosen].copy()
        pixel[:, gone], covariance[:, gone] = np.nan, np.nan
        return replace(self, pixel=pixel, covariance=covariance)

    def select_frames(self, chosen: slice | NDArray[np.bool_]) -> "View":
        """The measurements in some frames."""
        arrays: dict[str, Any] = {key: getattr(self, key) for key in VIEW_ARRAYS if getattr(self, key) is not None}
        return replace(self, **{key: array[chosen] for key, array in arrays.items()})

    def project(self, points: Array) -> Array:
        """Pixels (T, M, 2) of points (T, M, 3) [m] in the specimen frame, or (M, 3) for all frames."""
        return self.camera.project(self._at_rest(points))

    def jacobian(self, points: Array) -> Array:
        """Derivatives of `project` by the points [px/m], (T, M, 2, 3)."""
        slope = self.camera.jacobian(self._at_rest(points))
        return slope if self.rotation is None else slope @ self.rotation.swapaxes(1, 2)[:, None]

    def pose_slope(self, points: Array) -> Array:
        """Derivatives of `project` by a turn and a shift of the specimen frame [px/rad, px/m], (T, M, 2, 6)."""
        slope: Array = -self.jacobian(points) @ pose_jacobian(points)
        return slope

    def _at_rest(self, points: Array) -> Array:
        """Points (T, M, 3) in the camera's frame."""
        if self.rotation is None or self.translation is None:
            return np.broadcast_to(points, (len(self.pixel), *points.shape[-2:]))
        at_rest: Array = leave_moving_frame(points, self.rotation, self.translation)
        return at_rest

    def without_motion(self, near: Array) -> "View":
        """The view as if the specimen frame had stayed where it was in the first frame.

        The errors of its pose become errors of the pixels.

        near: positions [m], (M, 3), for which the pixels are exact; elsewhere to first order.
        """
        if self.rotation is None or self.translation is None:
            return self
        camera = self.camera.in_frame(self.rotation[0], self.translation[0])
        pixel, covariance = self.pixel + (camera.project(near) - self.project(near)), self.covariance
        if self.pose_covariance is not None:
            slope = self.pose_slope(near)
            covariance = covariance + slope @ self.pose_covariance[:, None] @ slope.swapaxes(-1, -2)
        still = replace(self, rotation=None, translation=None, pose_covariance=None)
        return replace(still, camera=camera, pixel=pixel, covariance=covariance)

    def scale(self, points: Array) -> Array:
        """Scale of the image at points (T, M, 3) [px/m], the geometric mean of both directions, (T, M)."""
        slope = self.jacobian(points)
        scale: Array = np.linalg.det(slope @ slope.swapaxes(-1, -2)) ** 0.25
        return scale

    def check(self, label: str, positions: Array) -> None:
        """Check that the values are such as a camera measures.

        Args:
            label: begins the messages.
            positions: of the markers [m], (T, M, 3), NaN where not known.

        Raises:
            ValueError: a pixel has no covariance, a rotation does not only turn, or the camera shows the markers
                elsewhere.
        """
        if not (np.isfinite(self.pixel) == self.seen[..., None]).all() or np.isinf(self.pixel).any():
            raise ValueError(f"{label}/pixel: expected two finite numbers, or two NaN where a marker is not seen")
        own = self.covariance[self.seen]
        symmetric = np.isfinite(own).all() and np.allclose(own, own.swapaxes(1, 2), rtol=1e-6)
        variances = np.linalg.eigvalsh(own) if symmetric else np.zeros(1)
        if not ((variances >= MIN_SIGMA**2) & (variances <= MAX_SIGMA**2)).all():
            raise ValueError(
                f"{label}/covariance: expected a positive definite matrix for every pixel, with standard deviations "
                f"from {MIN_SIGMA:g} to {MAX_SIGMA:g} px"
            )
        if (self.rotation is None) != (self.translation is None):
            raise ValueError(f"{label}: expected both rotation and translation of a moving frame, found one of them")
        if self.rotation is not None:
            error = np.abs(self.rotation.swapaxes(1, 2) @ self.rotation - np.eye(3)).max(initial=0.0)
            if error > MAX_ROTATION_ERROR or (np.linalg.det(self.rotation) < 0.0).any():
                raise ValueError(f"{label}/rotation: expected rotation matrices")
        if self.pose_covariance is not None:
            own = self.pose_covariance
            if self.rotation is None or not np.allclose(own, own.swapaxes(1, 2), rtol=1e-6, atol=0.0):
                raise ValueError(f"{label}/pose_covariance: expected symmetric matrices of a moving frame's poses")
            if not (np.linalg.eigvalsh(own) >= 0.0).all():
                raise ValueError(f"{label}/pose_covariance: expected positive definite matrices")
        self._check_camera(label, positions)

    def _check_camera(self, label: str, positions: Array) -> None:
        """Raise ValueError unless the camera shows the positions of seen markers near their pixels."""
        compared = self.seen & np.isfinite(positions).all(axis=2)
        with np.errstate(all="ignore"):
            gap = np.linalg.norm(self.project(positions) - self.pixel, axis=2)[compared]
            scale = self.scale(positions)[compared]
        largest = MAX_GAP * float(np.linalg.norm(self.camera.image_size))
        if not (gap <= largest).all():
            raise ValueError(
                f"{label}: expected pixels within {largest:.0f} px of where the calibrated camera shows the markers, "
                f"found some {gap.max():.3g} px off"
            )
        if not ((scale >= MIN_SCALE) & (scale <= MAX_SCALE)).all():
            raise ValueError(
                f"{label}: expected a camera that shows the markers with {MIN_SCALE:g} to {MAX_SCALE:g} px/m"
            )


def pose_jacobian(points: Array) -> Array:
    """Derivatives of transformed points (..., 3) by a rotation vector and a translation afterwards, (..., 3, 6)."""
    rotation = np.cross(np.eye(3), points[..., None, :]).swapaxes(-1, -2)
    return np.concatenate([rotation, np.broadcast_to(np.eye(3), rotation.shape)], axis=-1)


def leave_moving_frame(points: Any, rotation: Any, translation: Any) -> Any:
    """Points (.., M, 3) of a moving frame in the frame at rest, from which R X + t leads to it. Arrays or tensors.

    rotation, translation: R, (.., 3, 3), and t, (.., 3).
    """
    return (points - translation[..., None, :]) @ rotation


def seen_axes(views: Mapping[str, View], position: Array) -> tuple[Array, Array]:
    """Directions in which the cameras measured markers, and the standard deviations along them.

    Args:
        views: of one frame each, (1, M, 2).
        position: about which the projection is linearised [m], (M, 3).

    Returns:
        Orthonormal rows for every marker, (M, 3, 3), and the sigma along each [m], (M, 3), largest last; infinite where
        no camera measured. The last row points away from the cameras.
    """
    information, away = np.zeros((len(position), 3, 3)), np.zeros_like(position)
    for view in views.values():
        seen = view.seen[0]
        slope = view.jacobian(position[seen])[0]
        information[seen] += slope.swapaxes(1, 2) @ np.linalg.solve(view.covariance[0, seen], slope)
        away[seen] += view.viewing_directions[0]
    values, vectors = np.linalg.eigh(information)
    values, axes = values[:, ::-1], vectors[:, :, ::-1].swapaxes(1, 2).copy()
    axes[:, 2] *= np.where((axes[:, 2] * away).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    known = values > MIN_ANGLE**2 * np.maximum(values[:, 1:2], 1e-300)
    sigma = np.full(values.shape, np.inf)
    sigma[known] = values[known] ** -0.5
    return axes, sigma


class _Projection(torch.autograd.Function):
    """Pixels (..., 2) of points (..., 3) [m] by a camera; differentiable."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, camera: Camera) -> Tensor:
        own = points.detach().numpy()
        ctx.save_for_backward(torch.from_numpy(camera.jacobian(own)))
        return torch.from_numpy(camera.project(own))

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        (slope,) = ctx.saved_tensors
        return (gradients[0][..., None, :] @ slope)[..., 0, :], None


def project(points: Tensor, cameras: list[Camera]) -> Tensor:
    """Pixels (T, B, M, 2) of points (T, B, M, 3) [m] of B recordings, each by its own camera; differentiable."""
    parts = [_Projection.apply(points[:, b], camera) for b, camera in enumerate(cameras)]  # type: ignore[no-untyped-call]
    return torch.stack(parts, dim=1)


def at_lags(markers: Tensor, lag: Tensor) -> Tensor:
    """Markers (T, B, ..) at times that differ from those of the frames, by polynomials through the six frames around.

    Of an oscillation of 14 frames its error is 4e-5 of the amplitude; through four frames it would be 1e-3.

    lag: difference of the times [time steps], (T, B).
    """
    count = len(markers)
    if not bool((lag != 0.0).any()):
        return markers
    near = min(count, NEAR_FRAMES)
    time = torch.arange(count, dtype=lag.dtype)[:, None] + lag
    first = (time.floor().long() - (near // 2 - 1)).clamp(0, count - near)
    x = time - first
    batch = torch.arange(lag.shape[1])
    result = torch.zeros_like(markers)
    for k in range(near):
        weight = torch.ones_like(x)
        for other in range(near):
            if other != k:
                weight = weight * (x - other) / (k - other)
        result = result + weight.reshape(*weight.shape, *[1] * (markers.ndim - 2)) * markers[first + k, batch]
    return result


def project_slope(points: Tensor, cameras: list[Camera]) -> Tensor:
    """Derivatives of `project` by the points [px/m], (T, B, M, 2, 3)."""
    parts = [torch.from_numpy(camera.jacobian(points[:, b].detach().numpy())) for b, camera in enumerate(cameras)]
    return torch.stack(parts, dim=1)
