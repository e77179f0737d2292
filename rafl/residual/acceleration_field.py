"""The residual acceleration field: a small network on local features (paper, RAFL section)."""

import itertools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from rafl.residual.features import FEATURES, GaussPoints, features, mirrored_features
from rafl.residual.field_force import FieldForce, FieldPoints
from rafl.simulation.rollout import ResidualForce
from rafl.simulation.simulator import Simulator

KINDS = (slice(0, 13), slice(13, 31), slice(31, 34))  # strains, rates, accelerations by external forces
SMALLEST = 1e-3  # size of a feature that counts, of its kind's
NOTHING = 1e-6  # [1, 1/s, m/s^2]; a kind below it was not seen

MIRROR = 1.0 - 2.0 * torch.eye(3, dtype=torch.float64)  # signs of a vector's components, a row for each axis


class ResidualField(nn.Module):
    """MLP without biases from 34 features to an acceleration in the co-rotated frame [m/s^2].

    Zero features give zero acceleration, and the answer turns with the body. `scale` multiplies the
    features before the first layer; it changes how fast training goes, not what can be expressed.

    Where `mirrors` (3) is true for an axis, the mirror image across that axis gives the mirror image of the
    acceleration, as it must in any isotropic material: a field that only learned it from a beam's motion turns a
    thinner body's swing into a growing twist. In such a mirror every hidden unit changes places with another; weights
    act by their mean with their own mirror images, which costs no time.

    Args:
        width: units of each hidden layer, a multiple of 8.
        layers: how many of them.

    Raises:
        ValueError: another width, whose units cannot change places in every mirror.
    """

    scale: Tensor
    mirrors: Tensor

    def __init__(self, width: int = 64, layers: int = 4) -> None:
        if width % 8:
            raise ValueError(f"expected a width that is a multiple of 8, got {width}")
        super().__init__()
        sizes = [FEATURES, *[width] * layers]
        stack: list[nn.Module] = []
        for before, after in itertools.pairwise(sizes):
            stack += [nn.Linear(before, after, bias=False), nn.ELU()]
        stack.append(nn.Linear(width, 3, bias=False))
        self.network = nn.Sequential(*stack).to(torch.float64)
        self.register_buffer("scale", torch.ones(FEATURES, dtype=torch.float64))
        self.register_buffer("mirrors", torch.zeros(3, dtype=torch.bool))

    def mirror(self, across: Tensor) -> None:
        """Give a new field the symmetry of what it will be trained on: `mirrors` becomes `across`, (3).

        Means of two random weights are smaller than each; the weights grow by as much, so that training starts alike.
        """
        self.mirrors.copy_(across)
        with torch.no_grad():
            for weight in self.parameters():
                weight.mul_(2.0 ** (0.5 * float(across.sum())))

    def forward(self, inputs: Tensor) -> Tensor:
        """Co-rotated accelerations (..., 3) of features (..., 34)."""
        *hidden, last = self.weights()
        for matrix in hidden:
            inputs = nn.functional.elu(inputs @ matrix.T)
        return inputs @ last.T

    def weights(self, precision: torch.dtype = torch.float64) -> list[Tensor]:
        """The matrices that act, the features' scale in the first; gradients flow back to the parameters."""
        first, *middle, last = (layer.weight for layer in self.network if isinstance(layer, nn.Linear))
        first = first * self.scale
        for axis in self.mirrors.nonzero()[:, 0].tolist():
            sign = MIRROR[axis]
            swap = torch.arange(len(first)) ^ (1 << axis)
            first = 0.5 * (first + first[swap] * mirrored_features(sign))
            middle = [0.5 * (matrix + matrix[swap][:, swap]) for matrix in middle]
            last = 0.5 * (last + sign[:, None] * last[:, swap])
        return [matrix.to(precision) for matrix in (first, *middle, last)]

    def restore(self, state: Mapping[str, Any]) -> None:
        """Become the field whose `state_dict` this is; one that was saved without mirrors has none."""
        self.load_state_dict({"mirrors": torch.zeros_like(self.mirrors), **state})

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
