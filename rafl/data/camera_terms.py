"""What the cameras measured of several recordings, as the loss compares it with simulated markers."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.calibration.camera import Camera
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.views import View, at_lags, leave_moving_frame, project, project_slope

MIN_RELATIVE_SIGMA = 0.2  # of the median sigma: limits a weight to 25 times the usual one
SAME_INSTANT = 1e-6  # of times that rounding explains [frames]
BY_MARKER = ("pixel", "root", "scale", "by_pose")  # arrays of a term with an axis of markers


@dataclass(frozen=True)
class CameraTerm:
    """What one camera measured of B recordings, padded to the longest.

    Attributes:
        cameras: of each recording, (B), as in `View`.
        pixel: (T, B, M, 2) [px], zero where not seen.
        root: inverse square root of the pixels' covariances times the dataset's reference sigma [m/px], (T, B, M, 2,
            2), zero where not seen. It turns a difference of pixels into a distance in the body.
        lag: of the measurements [time steps], (T, B).
        scale: of the image at the markers [px/m], (T, B, M); 1 where not seen.
        rotation, translation: of the specimen frame, as in `View`, (T, B, 3, 3) and [m], (T, B, 3); those of the
            identity where it is at rest.
        by_pose: what six independent errors of this frame's pose, each of unit variance, make of the differences of
            pixels, in units of their standard deviations, (T, B, M, 2, 6); zero where it is exactly known.
    """

    cameras: list[Camera]
    pixel: Tensor
    root: Tensor
    lag: Tensor
    scale: Tensor
    rotation: Tensor
    translation: Tensor
    by_pose: Tensor

    @property
    def seen(self) -> Tensor:
        """1 where the camera saw a marker, else 0, (T, B, M)."""
        return (self.root[..., 0, 0] != 0.0).to(self.pixel.dtype)

    def index(self, frames: slice, recordings: list[int] | slice, markers: NDArray[np.int64] | slice) -> "CameraTerm":
        """The measurements of some frames, recordings and markers."""
        by_frame = {key: getattr(self, key)[frames][:, recordings] for key in ("lag", "rotation", "translation")}
        chosen = {key: getattr(self, key)[frames][:, recordings][:, :, markers] for key in BY_MARKER}
        cameras = self.cameras[recordings] if isinstance(recordings, slice) else [self.cameras[b] for b in recordings]
        return CameraTerm(cameras, **by_frame, **chosen)

    def up_to(self, frames: NDArray[np.int64]) -> "CameraTerm":
        """Without measurements later than the last of some leading frames of each recording, (B).

        A simulation that ends there does not show them.
        """
        time = torch.arange(len(self.lag), dtype=self.lag.dtype)[:, None] + self.lag
        within = (time <= torch.from_numpy(frames - 1.0 + SAME_INSTANT))[..., None, None, None]
        root, by_pose = (torch.where(within, array, 0.0) for array in (self.root, self.by_pose))
        return replace(self, root=root, by_pose=by_pose)

    def gap(self, markers: Tensor) -> Tensor:
        """Simulated minus measured pixels, (T, B, M, 2), of simulated markers (T, B, M, 3) [m]."""
        measured = at_lags(markers, self.lag)
        return project(leave_moving_frame(measured, self.rotation, self.translation), self.cameras) - self.pixel

    def slope(self, markers: Tensor) -> Tensor:
        """Derivatives of the pixels by the markers when the camera measured [px/m], (T, B, M, 2, 3)."""
        at_rest = leave_moving_frame(markers, self.rotation, self.translation)
        return project_slope(at_rest, self.cameras) @ self.rotation.mT[:, :, None]


def without_pose_errors(terms: list[CameraTerm], weighted: list[Tensor]) -> list[Tensor]:
    """Weighted differences of pixels, less what is as likely an error of the frame's pose.

    With independent errors of the pixels the weighted differences of one frame, of all markers and cameras, have the
    covariance 1 + A A^T, where A is `CameraTerm.by_pose`. They are multiplied by its inverse square root, which is
    1 - A V diag((1 - (1 + s)^-1/2) / s) V^T A^T with the eigenvalues s and the eigenvectors V of A^T A.

    Args:
        terms: of all cameras.
        weighted: differences, or their derivatives in n directions, (T, B, M, 2) or (T, n, B, M, 2) of each camera.
    """
    if not any(bool(term.by_pose.any()) for term in terms):
        return weighted
    values, vectors = torch.linalg.eigh(sum(torch.einsum("tbmik,tbmil->tbkl", *[term.by_pose] * 2) for term in terms))
    values = values.clamp_min(0.0)
    share = 1.0 / (1.0 + values + (1.0 + values).sqrt())  # as (1 - (1 + s)^-1/2) / s, also for s = 0
    inner = (vectors * share[..., None, :]) @ vectors.mT
    amplitude = sum(
        torch.einsum("tbmik,t...bmi->t...bk", term.by_pose, own) for term, own in zip(terms, weighted, strict=True)
    )
    amplitude = torch.einsum("tbkl,t...bl->t...bk", inner, amplitude)
    return [
        own - torch.einsum("tbmik,t...bk->t...bmi", term.by_pose, amplitude)
        for term, own in zip(terms, weighted, strict=True)
    ]


def _image_sigma(view: View) -> NDArray[np.float64]:
    """Standard deviation of a pixel, the geometric mean of both directions [px], (T, M); NaN where not seen."""
    with np.errstate(invalid="ignore"):
        sigma: NDArray[np.float64] = np.linalg.det(view.covariance) ** 0.25
    return sigma


def reference_sigma(dataset: Dataset) -> float:
    """Median over a dataset of the pixels' sigmas, as distances in the body [m]."""
    sigmas = [
        (_image_sigma(view) / view.scale(_known(item)))[view.seen]
        for item in dataset.trajectories.values()
        for view in item.views.values()
    ]
    return float(np.median(np.concatenate(sigmas)))


def camera_terms(dataset: Dataset, items: list[Trajectory], frames: int, reference: float) -> dict[str, CameraTerm]:
    """What the cameras measured of some recordings, by camera; `reference` as `_reference_sigma`.

    A camera that did not film a recording saw nothing of it. A sigma of less than a fifth of the reference counts as
    that.
    """
    count = len(dataset.markers.names)
    result = {}
    for name in dict.fromkeys(name for item in items for name in item.views):
        pixel, root = np.zeros((frames, len(items), count, 2)), np.zeros((frames, len(items), count, 2, 2))
        lag, scale = np.zeros((frames, len(items))), np.ones((frames, len(items), count))
        rotation = np.broadcast_to(np.eye(3), (frames, len(items), 3, 3)).copy()
        translation, cameras = np.zeros((frames, len(items), 3)), []
        by_pose = np.zeros((frames, len(items), count, 2, 6))
        for b, item in enumerate(items):
            view = item.views.get(name)
            cameras.append(next(iter(item.views.values())).camera if view is None else view.camera)
            if view is None:
                continue
            length, seen = len(item.time), view.seen
            own = view.scale(_known(item))
            least = (MIN_RELATIVE_SIGMA * reference * own) ** 2
            values, vectors = np.linalg.eigh(np.where(seen[..., None, None], view.covariance, np.eye(2)))
            inverse = reference / np.sqrt(np.maximum(values, least[..., None]))
            whitening = (vectors * inverse[..., None, :]) @ vectors.swapaxes(-1, -2)
            root[:length, b] = np.where(seen[..., None, None], whitening, 0.0)
            pixel[:length, b] = np.where(seen[..., None], view.pixel, 0.0)
            lag[:length, b] = view.lag / dataset.simulator.time_step
            scale[:length, b] = own
            if view.rotation is not None:
                rotation[:length, b], translation[:length, b] = view.rotation, view.translation
            if view.pose_covariance is not None:
                values, vectors = np.linalg.eigh(view.pose_covariance)
                errors = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
                by_pose[:length, b] = root[:length, b] / reference @ view.pose_slope(_known(item)) @ errors[:, None]
        arrays = pixel, root, lag, scale, rotation, translation, by_pose
        term = CameraTerm(cameras, *(torch.from_numpy(array) for array in arrays))
        result[name] = term.up_to(np.array([len(item.time) for item in items]))
    return result


def _known(item: Trajectory) -> NDArray[np.float64]:
    """Positions (T, M, 3) [m]; the mean of the known ones where one is not known."""
    middle = item.markers[item.valid].mean(axis=0)
    return np.where(item.valid[..., None], item.markers, middle)
