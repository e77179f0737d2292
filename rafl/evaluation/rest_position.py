"""Errors of the positions in which the markers come to rest."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.data.objective import Recordings
from rafl.evaluation.oscillation import REST_SHARE


def rest_distances(recordings: Recordings, simulated: Tensor) -> NDArray[np.float64]:
    """Distances between simulated and recorded rest positions [m], (B, M), NaN for markers not seen at the end.

    A rest position is the mean over the last tenth of the recording. Of a marker that only single cameras saw there,
    the distance is that in the image, as in `rafl.data.objective.marker_distances`.

    Args:
        recordings: that are compared.
        simulated: markers [m], (T, B, M, 3).
    """
    lengths = torch.tensor([len(recordings.dataset.trajectories[name].time) for name in recordings.names])
    frame = torch.arange(len(simulated))[:, None]
    count = (REST_SHARE * lengths).long().clamp_min(1)
    last = ((frame >= lengths - count) & (frame < lengths)).to(simulated.dtype)[..., None]
    located = last * recordings.located
    distance = _distance(simulated - recordings.markers, located)
    if recordings.terms:
        alone = last * (1.0 - recordings.located)
        images = [
            _distance(term.gap(simulated) / term.scale[..., None], alone * term.seen)
            for term in recordings.terms.values()
        ]
        distance = torch.where(distance.isnan(), torch.stack(images).nanmean(0), distance)
    found: NDArray[np.float64] = distance.numpy()
    return found


def _distance(offset: Tensor, weight: Tensor) -> Tensor:
    """Length of the weighted mean over frames of offsets (T, B, M, D), (B, M); NaN where no weight is above 0."""
    mean = (offset * weight[..., None]).sum(0) / weight.sum(0)[..., None]
    length: Tensor = torch.linalg.norm(mean, dim=-1)
    return length
