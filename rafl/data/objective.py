"""How far a simulation is from a recording: the training loss and the reported error."""

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
LEAST_SIGMA = 0.2  # of the median: nothing counts more than 25 times the usual


@dataclass(frozen=True)
class Recordings:
    """Recordings of one dataset, padded to the longest: what simulations are compared with.

    Attributes:
        dataset: where they are from.
        names: of the recordings, (B).
        markers: [m], (T, B, M, 3), zero where not valid.
        valid: 1 where a marker was seen, (T, B, M).
        weight: of each coordinate in the loss: `valid`, or by sigma, (T, B, M, 3).
    """

    dataset: Dataset
    names: list[str]
    markers: Tensor
    valid: Tensor
    weight: Tensor

    @classmethod
    def of(cls, dataset: Dataset, names: list[str], by_sigma: bool = False) -> "Recordings":
        """Stack the named recordings; `by_sigma` weighs coordinates by their variance, one in the median."""
        items = [dataset.trajectories[name] for name in names]
        frames = max(len(item.time) for item in items)
        count = len(dataset.markers.names)
        markers = np.zeros((frames, len(items), count, 3))
        valid = np.zeros((frames, len(items), count))
        weight = np.zeros((frames, len(items), count, 3))
        usual = _usual_sigma(dataset) if by_sigma else 0.0
        for b, item in enumerate(items):
            markers[: len(item.time), b] = np.where(item.valid[..., None], item.markers, 0.0)
            valid[: len(item.time), b] = item.valid
            own = (usual / np.maximum(item.sigma, LEAST_SIGMA * usual)) ** 2 if by_sigma else 1.0
            weight[: len(item.time), b] = item.valid[..., None] * own
        return cls(dataset, names, *(torch.from_numpy(array) for array in (markers, valid, weight)))

    def in_simulator(self, simulator: Simulator) -> "Recordings":
        """The same recordings, to be simulated in another way."""
        same = simulator is self.dataset.simulator
        return self if same else replace(self, dataset=replace(self.dataset, simulator=simulator))

    def of_markers(self, chosen: NDArray[np.int64]) -> "Recordings":
        """The same recordings with some of the markers only."""
        dataset = replace(self.dataset, markers=self.dataset.markers.some(chosen))
        rest = (array[:, :, chosen] for array in (self.markers, self.valid, self.weight))
        return Recordings(dataset, self.names, *rest)

    def first(self, frames: int) -> "Recordings":
        """The same recordings up to a frame."""
        return replace(self, **{key: getattr(self, key)[:frames] for key in ("markers", "valid", "weight")})

    def simulate(
        self, residual: ResidualForce | None = None, parameters: Parameters | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated markers (T, B, M, 3) [m] and residual forces (T - 1, B, N, 3) [N]."""
        positions, forces = self.motion(residual, parameters)
        return self.dataset.markers.positions(positions), forces

    def motion(
        self, residual: ResidualForce | None = None, parameters: Parameters | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated vertices (T, B, N, 3) [m] and residual forces (T - 1, B, N, 3) [N]."""
        steps = len(self.markers) - 1
        return rollout(self.dataset.simulator, self.dataset.start(self.names), steps, residual, parameters)


def _usual_sigma(dataset: Dataset) -> float:
    sigma = np.concatenate([item.sigma[item.valid].ravel() for item in dataset.trajectories.values()])
    return float(np.median(sigma[np.isfinite(sigma)]))


def training_loss(recordings: Recordings, simulated: Tensor, forces: Tensor, force_penalty: float = 0.0) -> Tensor:
    """Per recording 1e3 times the mean over steps of sum |x - x_bar|^2 + force_penalty sum f^2, averaged.

    The paper's objective; frames where a marker was not seen do not count.
    """
    steps = recordings.valid[1:].amax(-1).sum(0).clamp_min(1.0)  # (B)
    gap = (simulated - recordings.markers)[1:] ** 2 * recordings.weight[1:]
    total = gap.sum((0, 2, 3))
    if forces.numel():
        total = total + force_penalty * (forces**2).sum((0, 2, 3))
    return LOSS_SCALE * (total / steps).mean()


def frame_errors(recordings: Recordings, simulated: Tensor) -> list[NDArray[np.float64]]:
    """Per recording the mean marker distance of every frame [m], (T_r), over the markers seen in it.

    Averaged over frames and recordings this is the paper's error (eq. sim2real_evaluation).
    """
    valid = recordings.valid
    distance = torch.linalg.norm(simulated - recordings.markers, dim=-1) * valid
    seen = valid.sum(-1)
    mean = (distance.sum(-1) / seen.clamp_min(1.0)).detach().numpy()
    return [mean[: int(seen[:, b].nonzero().max()) + 1, b][_rows(seen[:, b])] for b in range(seen.shape[1])]


def _rows(seen: Tensor) -> NDArray[np.bool_]:
    last = int(seen.nonzero().max()) + 1
    return (seen[:last] > 0).numpy()
