"""Implicit steps and static equilibria as differentiable functions, by the implicit function theorem."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.constitutive_state import MODULI, ConstitutiveState
from rafl.simulation.engine import Engine
from rafl.simulation.simulator import Simulator
from rafl.solvers.linear import Factors

Array = NDArray[Any]


@dataclass(frozen=True)
class SolveContext:
    """Inputs of a solve that are not differentiated.

    Attributes:
        simulator: the specimen.
        guess: first guess of the solution [m], (B, N, 3); None solves a static equilibrium from rest.
        velocity_factor, strain_factor: see `rafl.fem.constitutive_state.ConstitutiveState`.
        label: name of the solve in error messages.
        factors: factors of the previous step, to be reused.
    """

    simulator: Simulator
    guess: Tensor | None
    velocity_factor: float = 1.0
    strain_factor: float = 1.0
    label: str = "step"
    factors: Factors | None = None


class ImplicitSolve(torch.autograd.Function):
    """Positions x (B, N, 3) with inertia (x - target) + internal force(x) = force on the free nodes.

    Inputs: target (B, N, 3) [m], inertia (B, N) [kg/s^2], force (B, N, 3) [N], positions of the fixed nodes (B, F, 3)
    [m], moduli (B, 5), and, for damping, velocity_offset (B, N, 3) and strain_offset (B, E, P, 6), or None.

    At the solution (inertia + K) dx = inertia dtarget + dforce - ..., with K the exact tangent. So one adjoint solve
    gives all derivatives.
    """

    @staticmethod
    def forward(
        ctx: Any,
        target: Tensor,
        inertia: Tensor,
        force: Tensor,
        fixed_positions: Tensor,
        moduli: Tensor,
        velocity_offset: Tensor | None,
        strain_offset: Tensor | None,
        context: SolveContext,
    ) -> Tensor:
        """Solve for x."""
        simulator = context.simulator
        state = _constitutive_state(moduli, velocity_offset, strain_offset, context)
        arrays = [_array(tensor) for tensor in (target, inertia, force, fixed_positions)]
        if context.guess is None:
            start = np.broadcast_to(simulator.mesh.vertices, arrays[2].shape).copy()
            start[:, simulator.fixed] = arrays[3]
            x = simulator.equilibrium(arrays[2], start, context.label, state)
        else:
            start = context.guess.numpy().copy()
            start[:, simulator.fixed] = arrays[3]
            x = simulator.minimise(start, arrays[1], arrays[0], arrays[2], state, context.label, context.factors)
        result = torch.from_numpy(x)
        ctx.context = context
        ctx.save_for_backward(result, target, inertia, moduli, velocity_offset, strain_offset)
        return result

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives with respect to each input."""
        x, target, inertia, moduli, velocity_offset, strain_offset = ctx.saved_tensors
        simulator, engine = ctx.context.simulator, ctx.context.simulator.engine
        state = _constitutive_state(moduli, velocity_offset, strain_offset, ctx.context)
        q = _array(x)
        batch, nodes = q.shape[:2]
        free = engine.free_index
        weight = _array(inertia)
        diagonal = np.repeat(weight, 3, axis=1)[:, free]
        right = np.ascontiguousarray(_array(grad).reshape(batch, -1)[:, free])
        adjoint = np.zeros((batch, 3 * nodes))
        needs = ctx.needs_input_grad
        by_fixed = by_moduli = by_velocity_offset = by_strain_offset = None
        with engine.thread_limit(batch):
            tangents = engine.evaluate(q, state, tangent=True)[2]
            adjoint[:, free] = engine.solve_once(tangents, diagonal, right[:, None])[:, 0]
            adjoint = adjoint.reshape(batch, nodes, 3)
            if needs[3]:
                by_fixed = torch.from_numpy(grad.numpy()[:, simulator.fixed] - engine.reactions(tangents, adjoint))
            if needs[4]:
                by_moduli = torch.from_numpy(_by_moduli(engine, q, state, adjoint))
        by_force = torch.from_numpy(adjoint)
        if state.damped and (needs[5] or needs[6]):
            by_velocity_offset, by_strain_offset = _by_offsets(engine, q, state, adjoint)
        return (
            inertia[..., None] * by_force if needs[0] else None,
            -(by_force * (x - target)).sum(-1) if needs[1] else None,
            by_force,
            by_fixed,
            by_moduli,
            by_velocity_offset,
            by_strain_offset,
            None,
        )


# Arguments as of `ImplicitSolve.forward`, without ctx.
implicit_solve: Callable[..., Tensor] = ImplicitSolve.apply


def _array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().numpy())


def _constitutive_state(
    moduli: Tensor, velocity_offset: Tensor | None, strain_offset: Tensor | None, context: SolveContext
) -> ConstitutiveState:
    velocity, strain = (None if tensor is None else _array(tensor) for tensor in (velocity_offset, strain_offset))
    return ConstitutiveState(_array(moduli), velocity, context.velocity_factor, strain, context.strain_factor)


def _by_moduli(engine: Engine, q: Array, state: ConstitutiveState, adjoint: Array) -> Array:
    """Minus adjoint . d(internal force) / d(moduli), (B, 5); the internal force is linear in each modulus."""
    out = np.zeros_like(state.moduli)
    for k in range(len(MODULI) if state.damped else 2):
        unit = np.zeros_like(state.moduli)
        unit[:, k] = 1.0
        single = ConstitutiveState(
            unit, state.velocity_offset, state.velocity_factor, state.strain_offset, state.strain_factor
        )
        out[:, k] = -(adjoint * engine.evaluate(q, single, tangent=False)[1]).sum(axis=(1, 2))
    return out


def _by_offsets(engine: Engine, q: Array, state: ConstitutiveState, adjoint: Array) -> tuple[Tensor, Tensor]:
    """Derivatives of minus adjoint . internal force with respect to velocity_offset and strain_offset."""
    points, shares, hexes = engine.quadrature.points, engine.quadrature.point_shares, engine.mesh.hexes
    eta, mu, lam = (state.moduli[:, k, None, None] * shares[:, share] for k, share in ((2, 0), (3, 0), (4, 1)))
    slope = np.einsum("beni,epnj->bepij", adjoint[:, hexes], points.gradient)
    trace = np.trace(slope, axis1=-2, axis2=-1)
    stress = mu[..., None, None] * (slope + slope.swapaxes(-1, -2)) + (lam * trace)[..., None, None] * np.eye(3)
    force = np.einsum("ep,bepij,epnj->beni", points.volume, stress, points.gradient)
    by_velocity_offset = torch.zeros(q.shape, dtype=torch.float64)
    by_velocity_offset.index_add_(1, torch.from_numpy(hexes.ravel()), torch.from_numpy(force.reshape(len(q), -1, 3)))
    F = np.einsum("beni,epnj->bepij", q[:, hexes], points.gradient)
    strain = F.swapaxes(-1, -2) @ slope
    strain = 0.5 * (strain + strain.swapaxes(-1, -2))
    components = strain[..., [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]] * np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    return by_velocity_offset, torch.from_numpy(2.0 * (eta * points.volume)[..., None] * components)
