"""The residual acceleration field: a small network on local features (paper, RAFL section)."""

import itertools

import torch
from torch import Tensor, nn

from rafl.features import FEATURES, GaussPoints, features
from rafl.field_force import FieldForce, FieldPoints
from rafl.rollout import ResidualForce
from rafl.simulator import Simulator

KINDS = (slice(0, 13), slice(13, 31), slice(31, 34))  # strains, rates, accelerations by external forces
SMALLEST = 1e-3  # size of a feature that counts, of its kind's
NOTHING = 1e-6  # [1, 1/s, m/s^2]; a kind below it was not seen


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

    def scale_to(self, size: Tensor) -> None:
        """Set `scale` from each feature's root mean square over some states, (34).

        A feature is divided by the geometric mean of its own size and of its kind's. By its own alone, components that
        the recordings hardly excite, as shear across a beam that bends in its plane, become the loudest on other
        shapes; by its kind's alone, beams of another thickness come out worse.
        """
        self.scale.fill_(1.0)
        for kind in KINDS:
            together = size[kind].square().mean().sqrt()
            if together > NOTHING:
                self.scale[kind] = (size[kind].clamp_min(SMALLEST * together) * together).rsqrt()
