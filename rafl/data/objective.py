"""The training loss and the reported error between simulations and recordings.

A recording that holds what the cameras measured is compared in the image plane, at the times of the cameras: there
nothing need be assumed about the depth of a marker that one camera saw. Others are compared in space, as in the paper.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.common.errors import InputError
from rafl.data.camera_terms import (
    MIN_RELATIVE_SIGMA,
    CameraTerm,
    camera_terms,
    reference_sigma,
    without_pose_errors,
)
from rafl.data.dataset import Dataset
from rafl.data.views import MIN_ANGLE, at_lags
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import ResidualForce, rollout
from rafl.simulation.simulator import Simulator

LOSS_SCALE = 1e3
# In the image plane a residual beyond this share of the recording's motion (root mean square) counts linearly, no
# longer squared (Huber's loss): a marker that took its neighbour's dot does not decide the fit.
HUBER_SHARE = 0.5
MIN_HUBER_SIGMAS = 10.0  # the same limit is at least so many reference sigmas, for bodies that hardly move

Objective = Literal["", "image", "3d"]  # empty: in the image plane where a dataset has views


@dataclass(frozen=True)
class Recordings:
    """Recordings of one dataset, padded to the longest, that simulations are compared with.

    Attributes:
        dataset: source of the recordings.
        names: of the recordings, (B).
        markers: positions [m], (T, B, M, 3), zero where not valid.
        valid: 1 where a marker was observed, else 0, (T, B, M).
        weight: of each coordinate in the loss, `valid` or by sigma, (T, B, M, 3).
        terms: what the cameras measured, by camera; empty if positions are compared.
        limit: squared difference from which on it counts linearly in the loss [m^2], (B); infinite if positions are
            compared.
    """

    dataset: Dataset
    names: list[str]
    markers: Tensor
    valid: Tensor
    weight: Tensor
    terms: dict[str, CameraTerm]
    limit: Tensor

    @classmethod
    def of(cls, dataset: Dataset, names: list[str], by_sigma: bool = False, objective: Objective = "") -> "Recordings":
        """Stack the named recordings.

        Args:
            dataset: that holds them.
            names: of the recordings.
            by_sigma: weight positions by 1 / sigma^2, relative to the median sigma. Pixels always are.
            objective: what the loss compares. Errors are those of what was seen in any case.

        Raises:
            InputError: pixels shall be compared, and a recording has none.
        """
        items = [dataset.trajectories[name] for name in names]
        frames = max(len(item.time) for item in items)
        count = len(dataset.markers.names)
        markers = np.zeros((frames, len(items), count, 3))
        valid = np.zeros((frames, len(items), count))
        weight = np.zeros((frames, len(items), count, 3))
        median = _median_sigma(dataset) if by_sigma else 0.0
        for b, item in enumerate(items):
            markers[: len(item.time), b] = np.where(item.valid[..., None], item.markers, 0.0)
            valid[: len(item.time), b] = item.valid
            own = (median / np.maximum(item.sigma, MIN_RELATIVE_SIGMA * median)) ** 2 if by_sigma else 1.0
            weight[: len(item.time), b] = item.valid[..., None] * own
        with_pixels = all(item.has_pixels for item in items)
        if objective == "image" and not with_pixels:
            lacking = next(name for name, item in zip(names, items, strict=True) if not item.has_pixels)
            raise InputError(
                f"{dataset.name}, recording {lacking}: expected the pixels that its cameras measured, found positions "
                "only; build the dataset again from tracks, or compare positions with --objective 3d"
            )
        stacked = [torch.from_numpy(array) for array in (markers, valid, weight)]
        infinite = torch.full((len(names),), torch.inf, dtype=torch.float64)
        found = cls(dataset, names, stacked[0], stacked[1], stacked[2], {}, infinite)
        if not with_pixels:
            return found
        reference = reference_sigma(dataset)
        least = torch.tensor((MIN_HUBER_SIGMAS * reference) ** 2, dtype=torch.float64)
        limit = torch.maximum(HUBER_SHARE**2 * torch.from_numpy(found.square_motion), least)
        return replace(
            found,
            terms=camera_terms(dataset, items, frames, reference),
            limit=infinite if objective == "3d" else limit,
        )

    def in_simulator(self, simulator: Simulator) -> "Recordings":
        """The same recordings with another simulator."""
        same = simulator is self.dataset.simulator
        return self if same else replace(self, dataset=replace(self.dataset, simulator=simulator))

    def select(self, chosen: list[int]) -> "Recordings":
        """The recordings of the given indices."""
        part = self._index(slice(None), chosen, slice(None))
        return replace(part, names=[self.names[k] for k in chosen], limit=self.limit[chosen])

    def select_markers(self, chosen: NDArray[np.int64]) -> "Recordings":
        """The same recordings with only the given rows of markers."""
        part = self._index(slice(None), slice(None), chosen)
        return replace(part, dataset=replace(self.dataset, markers=self.dataset.markers.select(chosen)))

    def first_frames(self, frames: int) -> "Recordings":
        """The leading `frames` frames of the same recordings."""
        part = self._index(slice(frames), slice(None), slice(None))
        ends = np.full(len(self.names), len(part.markers))
        return replace(part, terms={name: term.up_to(ends) for name, term in part.terms.items()})

    def _index(self, frames: slice, recordings: list[int] | slice, markers: NDArray[np.int64] | slice) -> "Recordings":
        arrays = {
            key: getattr(self, key)[frames][:, recordings][:, :, markers] for key in ("markers", "valid", "weight")
        }
        terms = {name: term.index(frames, recordings, markers) for name, term in self.terms.items()}
        return replace(self, **arrays, terms=terms)

    @property
    def in_image(self) -> bool:
        """Whether the loss compares pixels, not positions."""
        return bool(self.limit.isfinite().all())

    @property
    def square_motion(self) -> NDArray[np.float64]:
        """Mean squared distance of the markers from their first positions [m^2], by recording (B)."""
        seen = self.valid * self.valid[0]
        square = (self.markers - self.markers[0]).square().sum(-1) * seen
        mean: NDArray[np.float64] = (square.sum((0, 2)) / seen.sum((0, 2)).clamp_min(1.0)).numpy()
        return mean

    @property
    def observed(self) -> Tensor:
        """1 where a marker was observed, else 0, (T, B, M)."""
        if not self.terms:
            return self.valid
        return torch.stack([term.seen for term in self.terms.values()]).amax(0)

    @property
    def located(self) -> Tensor:
        """1 where the position of a marker was measured, if there are pixels by several cameras, else 0, (T, B, M)."""
        if not self.terms:
            return self.valid
        several = torch.stack([term.seen for term in self.terms.values()]).sum(0) > 1
        return self.valid * several

    @property
    def compared_coordinates(self) -> Tensor:
        """Number of coordinates after the first frame that the loss compares, by recording (B)."""
        if self.in_image:
            return 2.0 * torch.stack([term.seen for term in self.terms.values()])[:, 1:].sum((0, 1, 3))
        return (self.weight[1:] > 0).sum((0, 2, 3)).to(self.weight.dtype)

    def require_measurements(self) -> None:
        """Check that a simulation of every recording can be compared with something: it begins in the first frame.

        Raises:
            InputError: nothing was measured of a recording after its first frame.
        """
        if not (lacking := [b for b, count in enumerate(self.compared_coordinates.tolist()) if not count]):
            return
        kind, late = "a marker's position", ""
        advice = "track these recordings again, or leave them out of recordings.csv, and run rafl-capture again"
        if self.in_image:
            kind, late = "a pixel", ", or only later than the last frame by the camera's clock"
        elif bool(self.valid[1:, lacking].any()):
            kind, advice = "a position of finite sigma", "fit without --by-sigma"
        raise InputError(
            f"{self.dataset.name}, recordings {', '.join(self.names[b] for b in lacking)}: expected {kind} after the "
            f"first frame to compare the simulation with, found none in {len(self.markers)} frames{late}; {advice}"
        )

    def simulate(
        self, residual: ResidualForce | None = None, parameters: Parameters | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated markers (T, B, M, 3) [m] and residual forces (T - 1, B, N, 3) [N]."""
        positions, forces = self.simulate_vertices(residual, parameters)
        return self.dataset.markers.positions(positions), forces

    def simulate_vertices(
        self, residual: ResidualForce | None = None, parameters: Parameters | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated vertices (T, B, N, 3) [m] and residual forces (T - 1, B, N, 3) [N]."""
        steps = len(self.markers) - 1
        return rollout(self.dataset.simulator, self.dataset.start(self.names), steps, residual, parameters)

    def gaps(self, simulated: Tensor) -> list[Tensor]:
        """Weighted differences of simulated markers (T, B, M, 3) from what was measured [m], (T, B, M, D) each.

        One of three coordinates, or for every camera one of two.
        """
        if not self.in_image:
            return [(simulated - self.markers) * self.weight.sqrt()]
        terms = list(self.terms.values())
        return without_pose_errors(terms, [(term.root @ term.gap(simulated)[..., None])[..., 0] for term in terms])

    def gap_slopes(self, simulated: Tensor, slope: Tensor) -> list[Tensor]:
        """Derivatives of `gaps` in some directions, (T, n, B, M, D) each; slope of the markers (T, n, B, M, 3)."""
        if not self.in_image:
            return [slope * self.weight.sqrt()[:, None]]
        result = []
        for term in self.terms.values():
            own = torch.stack([at_lags(slope[:, k], term.lag) for k in range(slope.shape[1])], dim=1)
            change = term.slope(at_lags(simulated, term.lag))[:, None] @ own[..., None]
            result.append((term.root[:, None] @ change)[..., 0])
        return without_pose_errors(list(self.terms.values()), result)

    def seen_directions(self, frame: int) -> Tensor:
        """Projections (B, M, 3, 3) onto the directions in which a frame's markers were measured; zero if in none."""
        if not self.in_image:
            return self.valid[frame][..., None, None] * torch.eye(3, dtype=torch.float64)
        information = torch.zeros((*self.valid[frame].shape, 3, 3), dtype=torch.float64)
        one = slice(frame, frame + 1)
        for term in (term.index(one, slice(None), slice(None)) for term in self.terms.values()):
            slope = (term.slope(self.markers[one]) / term.scale[..., None, None])[0]
            information += (term.seen[0] * self.valid[frame])[..., None, None] * (slope.mT @ slope)
        values, vectors = torch.linalg.eigh(information)
        known = (values > MIN_ANGLE**2 * values[..., 1:2]) & (values[..., 1:2] > 0.0)
        projection: Tensor = vectors @ (known[..., None] * vectors.mT)
        return projection


def _median_sigma(dataset: Dataset) -> float:
    """Median over all observed coordinates of a dataset [m]."""
    sigma = np.concatenate([item.sigma[item.valid].ravel() for item in dataset.trajectories.values()])
    known = sigma[np.isfinite(sigma)]
    return float(np.median(known)) if known.size else 1.0  # any: an infinite sigma gives no weight


def training_loss(recordings: Recordings, simulated: Tensor, forces: Tensor, force_penalty: float = 0.0) -> Tensor:
    """The paper's objective: 1e3 times the mean over steps of sum |x - x_bar|^2 + force_penalty sum f^2.

    It is averaged over the recordings. Unobserved markers do not count.
    """
    losses = recording_losses(recordings, simulated)
    if forces.numel():
        losses = losses + LOSS_SCALE * force_penalty * (forces**2).sum((0, 2, 3)) / _observed_steps(recordings)
    return losses.mean()


def recording_losses(recordings: Recordings, simulated: Tensor) -> Tensor:
    """`training_loss` of every recording without the forces, (B).

    In the image plane |x - x_bar|^2 becomes, for every camera, the squared difference of the pixels by their inverse
    covariance, times the squared reference sigma, under Huber's loss (P. J. Huber, Robust Statistics, 1981).
    """
    limit = recordings.limit[None, :, None]
    finite = torch.where(limit.isfinite(), limit, 0.0)  # the slope of the branch that is not taken must be finite too
    total = torch.zeros(len(recordings.names), dtype=torch.float64)
    for gap in recordings.gaps(simulated):
        square = gap[1:].square().sum(-1)
        far = square > limit
        beyond = 2.0 * torch.where(far, finite * square, 1.0).sqrt() - finite
        total = total + torch.where(far, beyond, square).sum((0, 2))
    return LOSS_SCALE * total / _observed_steps(recordings)


def _observed_steps(recordings: Recordings) -> Tensor:
    """Number of steps of every recording with an observed marker, at least 1, (B)."""
    return recordings.observed[1:].amax(-1).sum(0).clamp_min(1.0)


def loss_curvature(recordings: Recordings, simulated: Tensor, slope: Tensor) -> Tensor:
    """Gauss-Newton matrix (n, n) of `training_loss` without a penalty.

    Args:
        recordings: that are compared.
        simulated: markers [m], (T, B, M, 3).
        slope: their derivatives in n directions [m], (T, n, B, M, 3).
    """
    steps = _observed_steps(recordings)
    limit = recordings.limit[None, :, None]
    products = torch.zeros((slope.shape[1],) * 2, dtype=torch.float64)
    slopes = recordings.gap_slopes(simulated, slope)
    for gap, own in zip(recordings.gaps(simulated), slopes, strict=True):
        square = gap[1:].square().sum(-1)
        far = square > limit
        share = torch.where(far, torch.where(far, limit, 1.0) / square.clamp_min(1e-300), 1.0).sqrt()
        products += torch.einsum("tkbmi,tlbmi,tbm->kl", own[1:], own[1:], share / steps[:, None])
    return 2.0 * LOSS_SCALE * products / len(steps)


def marker_distances(recordings: Recordings, simulated: Tensor) -> Tensor:
    """Distances of simulated markers from what was seen of them [m], (T, B, M), NaN where nothing was.

    Of a marker that several cameras saw it is the distance in space; of one that a single camera saw, the distance in
    the image divided by the scale there; in recordings of positions, the distance in space.
    """
    distance = torch.linalg.norm(simulated - recordings.markers, dim=-1)
    if recordings.terms:
        count = torch.stack([term.seen for term in recordings.terms.values()]).sum(0)
        in_image = torch.zeros_like(distance)
        for term in recordings.terms.values():
            in_image += term.seen * torch.linalg.norm(term.gap(simulated), dim=-1) / term.scale
        distance = torch.where(recordings.located > 0, distance, in_image / count.clamp_min(1.0))
    return torch.where(recordings.observed > 0, distance, torch.nan)


def frame_errors(recordings: Recordings, simulated: Tensor) -> list[NDArray[np.float64]]:
    """For each recording, the mean distance of the observed markers in every frame with any [m], (T_r).

    Its average over frames and recordings is the paper's error (eq. sim2real_evaluation).
    """
    distance = marker_distances(recordings, simulated)
    mean, seen = distance.nanmean(-1).detach().numpy(), ~distance.isnan().all(-1).numpy()
    return [mean[seen[:, b], b] for b in range(mean.shape[1])]
