"""How far a simulation is from a recording: the training loss and the reported error."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.dataset import Dataset
from rafl.parameters import Parameters
from rafl.rollout import ResidualForce, rollout

LOSS_SCALE = 1e3
FORCE_PENALTY = 1e-4  # lambda_1 of the paper's objective


@dataclass(frozen=True)
class Recordings:
    """Recordings of one dataset, padded to the longest: what simulations are compared with.

    Attributes:
        dataset: where they are from.
        names: of the recordings, (B).
        markers: [m], (T, B, M, 3), zero where not valid.
        valid: 1 where a marker was seen, (T, B, M).
    """

    dataset: Dataset
    names: list[str]
    markers: Tensor
    valid: Tensor

    @classmethod
    def of(cls, dataset: Dataset, names: list[str]) -> "Recordings":
        """Stack the named recordings."""
        items = [dataset.trajectories[name] for name in names]
        frames = max(len(item.time) for item in items)
        count = len(dataset.markers.names)
        markers = np.zeros((frames, len(items), count, 3))
        valid = np.zeros((frames, len(items), count))
        for b, item in enumerate(items):
            markers[: len(item.time), b] = np.where(item.valid[..., None], item.markers, 0.0)
            valid[: len(item.time), b] = item.valid
        return cls(dataset, names, torch.from_numpy(markers), torch.from_numpy(valid))

    def simulate(
        self, residual: ResidualForce | None = None, parameters: Parameters | None = None
    ) -> tuple[Tensor, Tensor]:
        """Simulated markers (T, B, M, 3) [m] and residual forces (T - 1, B, N, 3) [N]."""
        positions, forces = rollout(
            self.dataset.simulator,
            self.dataset.start(self.names),
            len(self.markers) - 1,
            residual,
            parameters,
        )
        return self.dataset.markers.positions(positions), forces


def training_loss(recordings: Recordings, simulated: Tensor, forces: Tensor) -> Tensor:
    """Per recording 1e3 times the mean over steps of sum |x - x_bar|^2 + 1e-4 sum f^2, averaged.

    The paper's objective; frames where a marker was not seen do not count.
    """
    steps = recordings.valid[1:].amax(-1).sum(0).clamp_min(1.0)  # (B)
    gap = ((simulated - recordings.markers)[1:] ** 2).sum(-1) * recordings.valid[1:]
    total = gap.sum((0, 2))
    if forces.numel():
        total = total + FORCE_PENALTY * (forces**2).sum((0, 2, 3))
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
