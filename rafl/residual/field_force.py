"""Nodal forces of the residual field as one differentiable function: compiled features, network, compiled sums."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from rafl.residual.features import FEATURES
from rafl.residual.field_adjoint import acceleration_adjoint, state_adjoint
from rafl.residual.field_kernels import SAVED_ROWS, local_features, nodal_forces
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]


@dataclass(frozen=True)
class FieldPoints:
    """Specimen data for the kernels.

    Attributes:
        hexes: (E, 8).
        gradients: shape function gradients [1/m], (E, 8 nodes * 3 * 8 points).
        shape: shape functions, (8 points, 8 nodes).
        mass: true mass of each point, rho V_e [kg], (E, 8).
        gravity: [m/s^2], (3).
    """

    hexes: NDArray[np.int64]
    gradients: Array
    shape: Array
    mass: Array
    gravity: Array

    @classmethod
    def of(cls, simulator: Simulator) -> "FieldPoints":
        """Data of a specimen."""
        rule, hexes = simulator.mesh.quadrature, np.ascontiguousarray(simulator.mesh.hexes)
        gradients = np.ascontiguousarray(rule.gradient.transpose(0, 2, 3, 1)).reshape(len(hexes), -1)
        mass = np.ascontiguousarray(simulator.material.density * rule.volume)
        return cls(hexes, gradients, np.ascontiguousarray(rule.shape), mass, np.array(simulator.gravity))

    def features(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Features of B states (34, B E 8), and the values saved for their derivatives (B, E, SAVED_ROWS, 8)."""
        saved = np.empty((len(q), len(self.hexes), SAVED_ROWS, 8))
        inputs = np.empty((FEATURES, len(q) * len(self.hexes) * 8))
        local_features(q, v, self.hexes, self.gradients, self.gravity, saved, inputs)
        return inputs, saved


def layer_outputs(inputs: Tensor, weights: Sequence[Tensor]) -> list[Tensor]:
    """Inputs (34, P) and the output of each layer; the last are the co-rotated accelerations [m/s^2], (3, P)."""
    layers = [inputs]
    for weight in weights[:-1]:
        layers.append(torch.nn.functional.elu(weight @ layers[-1], inplace=True))
    return [*layers, weights[-1] @ layers[-1]]


@njit(cache=True, error_model="numpy")
def multiply_by_elu_slope(derivatives: Array, values: Array) -> None:
    """Multiply `derivatives` (W, P) in place by the derivative of ELU at its outputs `values`: min(value, 0) + 1."""
    by, value = derivatives.ravel(), values.ravel()
    zero, one = by.dtype.type(0.0), by.dtype.type(1.0)
    for k in range(len(by)):
        by[k] *= min(value[k], zero) + one


class FieldForce(torch.autograd.Function):
    """Nodal forces [N], (B, N, 3), from states q, v (B, N, 3) and the effective weights of a network.

    The network runs in the precision of the weights, everything else in double precision.
    """

    @staticmethod
    def forward(ctx: Any, q: Tensor, v: Tensor, points: FieldPoints, *weights: Tensor) -> Tensor:
        """Evaluate the forces."""
        inputs, saved = points.features(*(np.ascontiguousarray(x.detach().numpy()) for x in (q, v)))
        *layers, last = layer_outputs(torch.from_numpy(inputs).to(weights[0].dtype), weights)
        acceleration = last.double().numpy()
        force = np.empty(q.shape)
        nodal_forces(acceleration, saved, points.mass, points.shape, points.hexes, force)
        ctx.points, ctx.saved, ctx.acceleration, ctx.layers = points, saved, acceleration, layers
        ctx.save_for_backward(*weights)
        return torch.from_numpy(force)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives with respect to state and weights."""
        weights, points, saved, layers = ctx.saved_tensors, ctx.points, ctx.saved, ctx.layers
        by_accelerations = np.empty((6, ctx.acceleration.shape[1]))
        by_force = np.ascontiguousarray(grad.numpy())
        acceleration_adjoint(by_force, saved, points.mass, points.shape, points.hexes, by_accelerations)
        by_layer = torch.from_numpy(by_accelerations[3:]).to(weights[0].dtype)
        by_weights: list[Tensor] = []
        for k in reversed(range(len(weights))):
            by_weights.insert(0, by_layer @ layers[k].T)
            by_layer = weights[k].T @ by_layer
            if k > 0:
                multiply_by_elu_slope(by_layer.numpy(), layers[k].numpy())
        by_q, by_v = np.empty(grad.shape), np.empty(grad.shape)
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            by_inputs = np.ascontiguousarray(by_layer.double().numpy())
            state_adjoint(
                by_inputs,
                by_accelerations[:3],
                ctx.acceleration,
                saved,
                points.hexes,
                points.gradients,
                points.gravity,
                by_q,
                by_v,
            )
        return torch.from_numpy(by_q), torch.from_numpy(by_v), None, *by_weights


# Arguments as of `FieldForce.forward`, without ctx.
field_force: Callable[..., Tensor] = FieldForce.apply
