"""The residual acceleration field: a small network on local features (paper, RAFL section)."""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rafl.features import FEATURES, GaussPoints, features
from rafl.field_force import FieldForce, FieldPoints
from rafl.rollout import ResidualForce
from rafl.simulator import Simulator


class ResidualField(nn.Module):
    """MLP without biases from 34 features to an acceleration in the co-rotated frame [m/s^2].

    Zero features give zero acceleration, and the answer turns with the body. `scale` multiplies the
    features before the first layer; it changes how fast training goes, not what can be expressed.
    """

    scale: Tensor

    def __init__(self, width: int = 64, layers: int = 4) -> None:
        super().__init__()
        sizes = [FEATURES, *[width] * layers]
        stack: list[nn.Module] = []
        for before, after in itertools.pairwise(sizes):
            stack += [nn.Linear(before, after, bias=False), nn.ELU()]
        stack.append(nn.Linear(width, 3, bias=False))
        self.network = nn.Sequential(*stack).to(torch.float64)
        self.register_buffer("scale", torch.ones(FEATURES, dtype=torch.float64))

    def forward(self, inputs: Tensor) -> Tensor:
        """Co-rotated accelerations (..., 3) of features (..., 34)."""
        return self.network(inputs * self.scale)

    def weights(self, precision: torch.dtype = torch.float64) -> list[Tensor]:
        """The layers' matrices, the features' scale in the first; gradients flow back to the parameters."""
        matrices = [layer.weight for layer in self.network if isinstance(layer, nn.Linear)]
        return [matrix.to(precision) for matrix in (matrices[0] * self.scale, *matrices[1:])]

    def on(self, simulator: Simulator, precision: torch.dtype = torch.float64) -> ResidualForce:
        """This field on a specimen: (q, v, external force) -> nodal forces [N], all (B, N, 3).

        `precision` is the network's; training does with `torch.float32`, in three fifths of the time.
        """
        if simulator.arithmetic == "plain":
            return self.plainly_on(simulator)
        points, weights = FieldPoints.of(simulator), self.weights(precision)
        return lambda q, v, external: FieldForce.apply(q, v, points, *weights)

    def plainly_on(self, simulator: Simulator) -> ResidualForce:
        """The same in tensors, which is the specification."""
        points = GaussPoints.of(simulator.mesh, simulator.material.density)
        gravity = torch.tensor(simulator.gravity, dtype=torch.float64)

        def force(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
            inputs, rotation = features(q, v, points, gravity)
            acceleration = (rotation @ self(inputs)[..., None])[..., 0]
            return points.accumulate(acceleration, q.shape[1])

        return force

    def scale_to(self, samples: Sequence[Tensor]) -> None:
        """Set `scale` to one over each feature's root mean square over samples (..., 34)."""
        stacked = torch.cat([sample.reshape(-1, FEATURES) for sample in samples])
        size = stacked.square().mean(0).sqrt()
        self.scale.copy_(1.0 / size.clamp_min(1e-3 * size.max()))
