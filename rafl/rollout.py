"""Differentiable simulation: one implicit Euler step as an autograd node, and trajectories of steps."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rafl.material import lame
from rafl.simulator import SimulationError, Simulator

ResidualForce = Callable[[Tensor, Tensor], Tensor]


class _Step(torch.autograd.Function):
    """Next positions; gradients by the implicit-function theorem, one tangent solve a step.

    The step minimises m / (2 dt^2) |q' - y|^2 + elastic energy with y = q + dt v + dt^2 f / m, so at
    its solution (m / dt^2 + K) dq' = m / dt^2 dy - d(elastic gradient).
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx, q: Tensor, v: Tensor, force: Tensor, mu: Tensor, lam: Tensor, simulator: Simulator,
        mass: np.ndarray, what: str,
    ) -> Tensor:  # fmt: skip
        arrays = (q.detach().numpy(), v.detach().numpy(), force.detach().numpy())
        stiffness = (mu.detach().numpy(), lam.detach().numpy())
        after = simulator.step(*arrays, *stiffness, mass, what)
        ctx.simulator, ctx.mass = simulator, mass
        result = torch.from_numpy(after)
        ctx.save_for_backward(result, mu, lam)
        return result

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        after, mu, lam = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        simulator, dt = ctx.simulator, ctx.simulator.time_step
        inertia = ctx.mass / dt**2
        tangent = simulator.tangent(after, mu, lam)
        adjoint = simulator.tangent_solve(tangent, inertia, grad.numpy())
        by_target = inertia[:, :, None] * adjoint
        by_q = by_target.copy()
        held = simulator.fixed
        by_q[:, held] += (grad.numpy() - simulator.tangent_product(tangent, adjoint))[:, held]
        by_mu = by_lam = None
        if ctx.needs_input_grad[3] or ctx.needs_input_grad[4]:
            one, zero = np.ones(len(after)), np.zeros(len(after))
            by_mu, by_lam = (
                torch.from_numpy(-(adjoint * simulator.elastic_gradient(after, *pair)).sum(axis=(1, 2)))
                for pair in ((one, zero), (zero, one))
            )
        return (
            torch.from_numpy(by_q), torch.from_numpy(dt * by_target), torch.from_numpy(adjoint),
            by_mu, by_lam, None, None, None,
        )  # fmt: skip


@dataclass(frozen=True)
class Start:
    """Where and under what a batch of trajectories starts.

    Attributes:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        force: constant nodal forces, gravity included [N], (B, N, 3).
        mass: nodal masses, hung-on loads included [kg], (B, N).
        names: of the trajectories, for messages, (B).
    """

    q: Tensor
    v: Tensor
    force: Tensor
    mass: np.ndarray
    names: tuple[str, ...]


def rollout(
    simulator: Simulator,
    start: Start,
    steps: int,
    residual: ResidualForce | None = None,
    material: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Simulate a batch of trajectories (paper, eq. 1 and 2), differentiably.

    Args:
        simulator: the specimen.
        start: initial state and loads.
        steps: number of time steps T.
        residual: (q, v) -> nodal force (B, N, 3) [N], applied explicitly at the start of each step.
        material: Young's modulus [Pa] and Poisson's ratio, scalars or (B,) tensors; else the simulator's.

    Returns:
        Positions (T + 1, B, N, 3) [m] and residual forces (T, B, N, 3) [N] (zero-size without one).

    Raises:
        SimulationError: names recording and step.
    """
    batch = len(start.q)
    modulus = (simulator.material.youngs_modulus, simulator.material.poissons_ratio)
    e, nu = (torch.as_tensor(value, dtype=torch.float64) for value in material or modulus)
    mu, lam = lame(e.expand(batch), nu.expand(batch))
    q, v = start.q, start.v
    positions, forces = [q], []
    for step in range(steps):
        force = start.force
        if residual is not None:
            extra = residual(q, v)
            forces.append(extra)
            force = force + extra
        try:
            after = _Step.apply(q, v, force, mu, lam, simulator, start.mass, f"step {step + 1}")
        except SimulationError as error:
            raise SimulationError(f"{error} [recordings: {', '.join(start.names)}]") from None
        v = (after - q) / simulator.time_step
        q = after
        positions.append(q)
    return torch.stack(positions), torch.stack(forces) if forces else q.new_zeros(0)
