"""A limit on the energy that a residual field may add to a body, so that no motion can grow without end.

A field that was learned on some motions may feed energy into others, which then flutter. Here the field's work, the sum
of f . dq over the frames, may never exceed a fraction of the energy scale of the motion: the fraction that it reached
in training, with a margin. Where the next frame would exceed it, the force is scaled down; a force that takes energy
out always acts in full. The body's energy is therefore at most the initial one and this limit.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rafl.simulation.parameters import Parameters
from rafl.simulation.rollout import ResidualForce, equilibrium
from rafl.simulation.simulator import Simulator

MARGIN = 2.0  # times the largest fraction in training; other loads and shapes differ by tens of per cent
MIN_FRACTION = 0.01  # for fields that only take energy out in training


@dataclass(frozen=True)
class LimitedForce:
    """A residual force whose work is limited in every rollout. Called on its own, it is the force without a limit.

    Attributes:
        force: the residual force without a limit.
        simulator, parameters: of the rollouts.
        fraction: largest work of the force, relative to `energy_scale`.
    """

    force: ResidualForce
    simulator: Simulator
    parameters: Parameters
    fraction: float

    def __call__(self, q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        """The force without a limit [N], (B, N, 3)."""
        return self.force(q, v, external)

    def for_rollout(self) -> ResidualForce:
        """The limited force for one rollout."""
        return _LimitInRollout(self)


class _LimitInRollout:
    """A limited force and its work so far in one rollout of a batch."""

    def __init__(self, limited: LimitedForce) -> None:
        self.limited = limited
        self._limit: Tensor | None = None  # [J], (B)
        self._work = torch.zeros(0)  # done so far [J], (B)
        self._latest: tuple[Tensor, Tensor] | None = None  # positions and force at the start of the latest frame

    def __call__(self, q: Tensor, v: Tensor, external: Tensor) -> Tensor:
        """The force at the start of a frame [N], (B, N, 3)."""
        own = self.limited
        if self._limit is None:
            self._limit = own.fraction * energy_scale(own.simulator, own.parameters, q, v, external)
            self._work = torch.zeros(len(q), dtype=torch.float64)
        if self._latest is not None:
            before, force = self._latest
            self._work = self._work + (force * (q - before)).sum((1, 2)).detach()
        force = own.force(q, v, external)
        expected = own.simulator.time_step * (force * v).sum((1, 2)).detach()
        left = (self._limit - self._work).clamp_min(0.0)
        share = torch.where(expected > left, left / expected.clamp_min(1e-300), torch.ones_like(left))
        # No force that still does work is left where the limit is reached, whatever the body does within the frame.
        share = torch.where((self._work >= self._limit) & (expected >= 0.0), torch.zeros_like(share), share)
        force = share[:, None, None] * force
        self._latest = q.detach(), force.detach()
        return force


def energy_scale(simulator: Simulator, parameters: Parameters, q: Tensor, v: Tensor, external: Tensor) -> Tensor:
    """Energy scale of motions that start at q, v (B, N, 3) under constant forces [N], gravity included; [J], (B).

    It is the sum of the kinetic energy, of the potential energy above static equilibrium, and of the elastic energy
    at equilibrium.
    """
    with torch.no_grad():
        weight = torch.from_numpy(simulator.weight)
        fixed = torch.from_numpy(simulator.fixed)
        settled = equilibrium(simulator, external - weight, fixed_positions=q[:, fixed])
        own, at_rest = (
            torch.from_numpy(
                simulator.engine.evaluate(x.numpy(), simulator.constitutive_state(len(x)), tangent=False)[0]
            )
            for x in (q.contiguous(), settled)
        )
        factor = parameters.youngs_modulus.detach() / simulator.material.youngs_modulus
        above = factor * (own - at_rest) - (external * (q - settled)).sum((1, 2))
        kinetic = 0.5 * (torch.from_numpy(simulator.node_mass)[:, None] * v**2).sum((1, 2))
    return kinetic + above.abs() + factor * at_rest


def largest_work(positions: Tensor, forces: Tensor) -> Tensor:
    """Largest work that forces (T, B, N, 3) [N] have done up to any frame, at positions (T + 1, B, N, 3); [J], (B)."""
    steps = (forces * torch.diff(positions, dim=0)).sum((2, 3))
    return torch.cumsum(steps, dim=0).amax(0).clamp_min(0.0)
