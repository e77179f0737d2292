"""The training loss and the reported error between simulations and recordings."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.data.dataset import Dataset
from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import ResidualForce, rollout
from rafl.simulation.simulator import Simulator

LOSS_SCALE = 1e3
MIN_RELATIVE_SIGMA = 0.2  # of the median sigma: limits a weight to 25 times the usual one


@dataclass(frozen=True)
class Recordings:
    """Recordings of one dataset, padded to the longest, that simulations are compared with.

    Attributes:
        dataset: source of the recordings.
        names: of the recordings, (B).
        markers: positions [m], (T, B, M, 3), zero where not valid.
        valid: 1 where a marker was observed, else 0, (T, B, M).
        weight: of each coordinate in the loss, `valid` or by sigma, (T, B, M, 3).
    """

    dataset: Dataset
    names: list[str]
    markers: Tensor
    valid: Tensor
    weight: Tensor

    @classmethod
    def of(cls, dataset: Dataset, names: list[str], by_sigma: bool = False) -> "Recordings":
        """Stack the named recordings. `by_sigma` weights coordinates by 1 / sigma^2, relative to the median sigma."""
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
        return cls(dataset, names, *(torch.from_numpy(array) for array in (markers, valid, weight)))

    def in_simulator(self, simulator: Simulator) -> "Recordings":
        """The same recordings with another simulator."""
        same = simulator is self.dataset.simulator
        return self if same else replace(self, dataset=replace(self.dataset, simulator=simulator))

    def select(self, chosen: list[int]) -> "Recordings":
        """The recordings of the given indices."""
        arrays = {key: getattr(self, key)[:, chosen] for key in ("markers", "valid", "weight")}
        return replace(self, names=[self.names[k] for k in chosen], **arrays)

    def select_markers(self, chosen: NDArray[np.int64]) -> "Recordings":
        """The same recordings with only the given rows of markers."""
        dataset = replace(self.dataset, markers=self.dataset.markers.select(chosen))
        arrays = (array[:, :, chosen] for array in (self.markers, self.valid, self.weight))
        return Recordings(dataset, self.names, *arrays)

    def first_frames(self, frames: int) -> "Recordings":
        """The leading `frames` frames of the same recordings."""
        return replace(self, **{key: getattr(self, key)[:frames] for key in ("markers", "valid", "weight")})

    @property
    def square_motion(self) -> NDArray[np.float64]:
        """Mean squared distance of the markers from their first positions [m^2], by recording (B)."""
        seen = self.valid * self.valid[0]
        square = (self.markers - self.markers[0]).square().sum(-1) * seen
        mean: NDArray[np.float64] = (square.sum((0, 2)) / seen.sum((0, 2)).clamp_min(1.0)).numpy()
        return mean

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


def _median_sigma(dataset: Dataset) -> float:
    """Median over all observed coordinates of a dataset [m]."""
    sigma = np.concatenate([item.sigma[item.valid].ravel() for item in dataset.trajectories.values()])
    return float(np.median(sigma[np.isfinite(sigma)]))


def training_loss(recordings: Recordings, simulated: Tensor, forces: Tensor, force_penalty: float = 0.0) -> Tensor:
    """The paper's objective: 1e3 times the mean over steps of sum |x - x_bar|^2 + force_penalty sum f^2.

    It is averaged over the recordings. Unobserved markers do not count.
    """
    losses = recording_losses(recordings, simulated)
    if forces.numel():
        losses = losses + LOSS_SCALE * force_penalty * (forces**2).sum((0, 2, 3)) / _observed_steps(recordings)
    return losses.mean()


def recording_losses(recordings: Recordings, simulated: Tensor) -> Tensor:
    """`training_loss` of every recording without the forces, (B)."""
    gap = (simulated - recordings.markers)[1:] ** 2 * recordings.weight[1:]
    return LOSS_SCALE * gap.sum((0, 2, 3)) / _observed_steps(recordings)


def _observed_steps(recordings: Recordings) -> Tensor:
    """Number of steps of every recording with an observed marker, at least 1, (B)."""
    return recordings.valid[1:].amax(-1).sum(0).clamp_min(1.0)


def loss_curvature(recordings: Recordings, slope: Tensor) -> Tensor:
    """Gauss-Newton matrix (n, n) of `training_loss` without a penalty; slope of the markers (T, n, B, M, 3) [m]."""
    steps = _observed_steps(recordings)
    weight = recordings.weight[1:] / steps[:, None, None]
    products = torch.einsum("tkbmi,tlbmi,tbmi->kl", slope[1:], slope[1:], weight)
    return 2.0 * LOSS_SCALE * products / len(steps)


def frame_errors(recordings: Recordings, simulated: Tensor) -> list[NDArray[np.float64]]:
    """For each recording, the mean distance of the observed markers in every frame with any [m], (T_r).

    Its average over frames and recordings is the paper's error (eq. sim2real_evaluation).
    """
    valid = recordings.valid
    distance = torch.linalg.norm(simulated - recordings.markers, dim=-1) * valid
    observed = valid.sum(-1)
    mean = (distance.sum(-1) / observed.clamp_min(1.0)).detach().numpy()
    counts = [observed[:, b] for b in range(observed.shape[1])]
    return [mean[: int(count.nonzero().max()) + 1, b][_observed_rows(count)] for b, count in enumerate(counts)]


def _observed_rows(observed: Tensor) -> NDArray[np.bool_]:
    """Whether each frame up to the last observed one has an observed marker, from the counts (T)."""
    frames = int(observed.nonzero().max()) + 1
    return (observed[:frames] > 0).numpy()
