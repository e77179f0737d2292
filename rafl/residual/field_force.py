"""The residual field's nodal force as one differentiable step: compiled features, the network, compiled sums."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from rafl.residual.features import FEATURES
from rafl.residual.field_kernels import KEPT, by_acceleration, by_state, local_features, nodal_forces
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]


@dataclass(frozen=True)
class FieldPoints:
    """What the kernels need of a specimen.

    Attributes:
        hexes: (E, 8).
        slopes: shape function gradients [1/m], (E, 8 nodes * 3 * 8 points).
        shape: (8 points, 8 nodes).
        mass: true mass of each point, rho V_e [kg], (E, 8).
        gravity: [m/s^2], (3).
    """

    hexes: NDArray[np.int64]
    slopes: Array
    shape: Array
    mass: Array
    gravity: Array

    @classmethod
    def of(cls, simulator: Simulator) -> "FieldPoints":
        """Those of a specimen."""
        rule, hexes = simulator.mesh.quadrature, np.ascontiguousarray(simulator.mesh.hexes)
        slopes = np.ascontiguousarray(rule.gradient.transpose(0, 2, 3, 1)).reshape(len(hexes), -1)
        mass = np.ascontiguousarray(simulator.material.density * rule.volume)
        return cls(hexes, slopes, np.ascontiguousarray(rule.shape), mass, np.array(simulator.gravity))

    def features(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The 34 features of B states (34, B E 8), and what their derivatives need again (B, E, KEPT, 8)."""
        kept = np.empty((len(q), len(self.hexes), KEPT, 8))
        inputs = np.empty((FEATURES, len(q) * len(self.hexes) * 8))
        local_features(q, v, self.hexes, self.slopes, self.gravity, kept, inputs)
        return inputs, kept


def accelerations(inputs: Tensor, weights: Sequence[Tensor]) -> list[Tensor]:
    """Inputs (34, P) and what each layer makes of them; the last are co-rotated accelerations (3, P) [m/s^2]."""
    layers = [inputs]
    for weight in weights[:-1]:
        layers.append(torch.nn.functional.elu(weight @ layers[-1], inplace=True))
    return [*layers, weights[-1] @ layers[-1]]


@njit(cache=True, error_model="numpy")
def by_elu(derivatives, values):
    """Multiply derivatives by ELU's values (W, P) with its slopes: one where a value is positive, else value + 1."""
    by, value = derivatives.ravel(), values.ravel()
    none, one = by.dtype.type(0.0), by.dtype.type(1.0)
    for k in range(len(by)):
        by[k] *= min(value[k], none) + one


class FieldForce(torch.autograd.Function):
    """Nodal forces (B, N, 3) [N] of states q, v (B, N, 3) under a network's weights, the features' scale in the first.

    The network runs in the weights' precision; all else in double.
    """

    @staticmethod
    def forward(ctx: Any, q: Tensor, v: Tensor, points: FieldPoints, *weights: Tensor) -> Tensor:
        """Evaluate."""
        inputs, kept = points.features(*(np.ascontiguousarray(x.detach().numpy()) for x in (q, v)))
        *layers, last = accelerations(torch.from_numpy(inputs).to(weights[0].dtype), weights)
        acceleration = last.double().numpy()
        force = np.empty(q.shape)
        nodal_forces(acceleration, kept, points.mass, points.shape, points.hexes, force)
        ctx.points, ctx.kept, ctx.acceleration, ctx.layers = points, kept, acceleration, layers
        ctx.save_for_backward(*weights)
        return torch.from_numpy(force)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives by state and weights."""
        weights, points, kept, layers = ctx.saved_tensors, ctx.points, ctx.kept, ctx.layers
        by_points = np.empty((6, ctx.acceleration.shape[1]))
        by_force = np.ascontiguousarray(grad.numpy())
        by_acceleration(by_force, kept, points.mass, points.shape, points.hexes, by_points)
        by_layer = torch.from_numpy(by_points[3:]).to(weights[0].dtype)
        by_weights: list[Tensor] = []
        for k in reversed(range(len(weights))):
            by_weights.insert(0, by_layer @ layers[k].T)
            by_layer = weights[k].T @ by_layer
            if k > 0:
                by_elu(by_layer.numpy(), layers[k].numpy())
        by_q, by_v = np.empty(grad.shape), np.empty(grad.shape)
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            by_inputs = np.ascontiguousarray(by_layer.double().numpy())
            by_state(
                by_inputs,
                by_points[:3],
                ctx.acceleration,
                kept,
                points.hexes,
                points.slopes,
                points.gravity,
                by_q,
                by_v,
            )
        return torch.from_numpy(by_q), torch.from_numpy(by_v), None, *by_weights
