"""The residual acceleration field: a small network on local features (paper, RAFL section)."""

import itertools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from rafl.residual.features import FEATURES, GaussPoints, features, mirror_signs
from rafl.residual.field_force import FieldPoints, field_force
from rafl.simulation.rollout import ResidualForce
from rafl.simulation.simulator import Simulator

FEATURE_GROUPS = (slice(0, 13), slice(13, 31), slice(31, 34))  # strains, rates, accelerations by external forces
MIN_RELATIVE_SIZE = 1e-3  # smallest feature size used for scaling, relative to the RMS of its group
MIN_GROUP_SIZE = 1e-6  # [1, 1/s, m/s^2]; a group with a smaller RMS is not scaled

MIRROR_SIGNS = 1.0 - 2.0 * torch.eye(3, dtype=torch.float64)  # signs of vector components, one row per mirror axis


class ResidualField(nn.Module):
    """MLP without biases from 34 features to an acceleration in the co-rotated frame [m/s^2].

    Zero features give zero acceleration, and the output rotates with the body. `scale` multiplies the features before
    the first layer. It changes the speed of training, not what the network can express.

    `mirrors` (3) holds, for each axis, whether a mirrored motion gives the mirrored acceleration, as in any isotropic
    material. A field that only learns this symmetry from the motion of a beam turns the swing of a thinner body into a
    growing twist. The symmetry is exact: a mirror permutes the hidden units in pairs, and each weight matrix is
    averaged with its mirror image, at no extra cost per evaluation.

    Args:
        width: units of each hidden layer, a multiple of 8.
        layers: number of hidden layers.

    Raises:
        ValueError: the width is no multiple of 8, so the units cannot be paired in all three mirrors.
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

    def impose_symmetry(self, planes: Tensor) -> None:
        """Set `mirrors` of a new field to `planes` (3), the symmetry planes of all specimens that it is trained on.

        The mean of two random weights is smaller than each of them. The weights are scaled up to compensate, so that
        training starts with outputs of the same size.
        """
        self.mirrors.copy_(planes)
        with torch.no_grad():
            for weight in self.parameters():
                weight.mul_(2.0 ** (0.5 * float(planes.sum())))

    def forward(self, inputs: Tensor) -> Tensor:
        """Co-rotated accelerations (..., 3) from features (..., 34)."""
        return _outputs(inputs, self.weights())

    def weights(self, precision: torch.dtype = torch.float64) -> list[Tensor]:
        """Effective weight matrices: mirrored, with the feature scale in the first; differentiable."""
        first, *middle, last = (layer.weight for layer in self.network if isinstance(layer, nn.Linear))
        first = first * self.scale
        for axis in self.mirrors.nonzero()[:, 0].tolist():
            sign = MIRROR_SIGNS[axis]
            swap = torch.arange(len(first)) ^ (1 << axis)
            first = 0.5 * (first + first[swap] * mirror_signs(sign))
            middle = [0.5 * (matrix + matrix[swap][:, swap]) for matrix in middle]
            last = 0.5 * (last + sign[:, None] * last[:, swap])
        return [matrix.to(precision) for matrix in (first, *middle, last)]

    def restore(self, state: Mapping[str, Any]) -> None:
        """Load a `state_dict`; one saved by an earlier version, without `mirrors`, has no mirror symmetry."""
        self.load_state_dict({"mirrors": torch.zeros_like(self.mirrors), **state})

    def on(self, simulator: Simulator, precision: torch.dtype = torch.float64) -> ResidualForce:
        """The force of this field on a specimen: (q, v, external force) -> nodal forces [N], all (B, N, 3).

        `precision` is that of the network. Training uses `torch.float32`, which takes three fifths of the time.
        """
        weights = self.weights(precision)
        if simulator.arithmetic == "torch":
            return _tensor_force(simulator, weights)
        points = FieldPoints.of(simulator)
        return lambda q, v, external: field_force(q, v, points, *weights)

    def set_scale(self, size: Tensor) -> None:
        """Set `scale` from the root mean square of each feature over training states, `size` (34).

        Each feature is divided by the geometric mean of its own size and the RMS of its group. With its own size alone,
        features that the recordings hardly excite, such as shear across a beam that bends in its plane, dominate on
        other shapes. With the RMS of the group alone, errors on beams of another thickness are larger.
        """
        self.scale.fill_(1.0)
        for group in FEATURE_GROUPS:
            group_size = size[group].square().mean().sqrt()
            if group_size > MIN_GROUP_SIZE:
                self.scale[group] = (size[group].clamp_min(MIN_RELATIVE_SIZE * group_size) * group_size).rsqrt()


def _outputs(inputs: Tensor, weights: list[Tensor]) -> Tensor:
    """Outputs (..., 3) of the network from features (..., 34)."""
    *hidden, last = weights
    for matrix in hidden:
        inputs = nn.functional.elu(inputs @ matrix.T)
    return inputs @ last.T


def _tensor_force(simulator: Simulator, weights: list[Tensor]) -> ResidualForce:
    """The force of a field in tensors, on the device of a simulator: the specification of the kernels."""
    points = GaussPoints.of(simulator.mesh, simulator.material.density, simulator.device)
    gravity = torch.tensor(simulator.gravity, dtype=torch.float64, device=simulator.device)
    placed = [matrix.to(simulator.device) for matrix in weights]

    def force(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        inputs, rotation = features(q.to(simulator.device), v.to(simulator.device), points, gravity)
        local = _outputs(inputs.to(placed[0].dtype), placed).double()
        acceleration = (rotation @ local[..., None])[..., 0]
        return points.accumulate(acceleration, q.shape[1]).to(q.device)

    return force
