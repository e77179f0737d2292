"""Implicit steps and static equilibria as differentiable functions, by the implicit function theorem."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.fem.constitutive_state import DAMPING, ConstitutiveState, HourglassStiffness
from rafl.fem.enhanced.hourglass import MODES
from rafl.fem.learned.energy import force_derivatives
from rafl.fem.strain import MULTIPLICITY, scatter
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
        velocity_factor: see `rafl.fem.constitutive_state.ConstitutiveState`.
        label: name of the solve in error messages.
        factors: factors of the previous step, to be reused.
    """

    simulator: Simulator
    guess: Tensor | None
    velocity_factor: float = 1.0
    label: str = "step"
    factors: Factors | None = None


class ImplicitSolve(torch.autograd.Function):
    """Positions x (B, N, 3) with inertia (x - target) + internal force(x) = force on the free nodes.

    Inputs: target (B, N, 3) [m], inertia (B, N) [kg/s^2], force (B, N, 3) [N], positions of the fixed nodes (B, F, 3)
    [m], moduli (B, 4), the weights of the learned energy (B, K) [Pa], the stiffness of the hourglass modes
    (3, B, U, 12, 12) for `enhanced` integration, the modulus (B, E, P) [Pa] and the memory (B, E, Z) of the viscous
    stress, and the velocity offset (B, N, 3) of stiffness damping; each after the moduli may be None.

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
        energy: Tensor | None,
        hourglass: Tensor | None,
        viscous_modulus: Tensor | None,
        memory: Tensor | None,
        velocity_offset: Tensor | None,
        context: SolveContext,
    ) -> Tensor:
        """Solve for x."""
        simulator = context.simulator
        history = (energy, hourglass, viscous_modulus, memory, velocity_offset)
        state = _constitutive_state(moduli, *history, context)
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
        ctx.save_for_backward(result, target, inertia, moduli, *history)
        return result

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives with respect to each input."""
        x, target, inertia, moduli, energy, hourglass, viscous_modulus, memory, velocity_offset = ctx.saved_tensors
        history = (energy, hourglass, viscous_modulus, memory, velocity_offset)
        simulator, engine = ctx.context.simulator, ctx.context.simulator.engine
        state = _constitutive_state(moduli, *history, ctx.context)
        q = _array(x)
        batch, nodes = q.shape[:2]
        free = engine.free_index
        weight = _array(inertia)
        diagonal = np.repeat(weight, 3, axis=1)[:, free]
        right = np.ascontiguousarray(_array(grad).reshape(batch, -1)[:, free])
        adjoint = np.zeros((batch, 3 * nodes))
        needs = ctx.needs_input_grad
        by_fixed = by_moduli = by_energy = by_hourglass = by_viscous_modulus = by_memory = by_velocity_offset = None
        with engine.thread_limit(batch):
            tangents = engine.evaluate(q, state, tangent=True)[2]
            adjoint[:, free] = engine.solve_once(tangents, diagonal, right[:, None])[:, 0]
            adjoint = adjoint.reshape(batch, nodes, 3)
            if needs[3]:
                by_fixed = torch.from_numpy(grad.numpy()[:, simulator.fixed] - engine.reactions(tangents, adjoint))
            if needs[4]:
                by_moduli = torch.from_numpy(_by_moduli(engine, q, state, adjoint))
            if needs[5]:
                shares = engine.quadrature.point_shares[:, 0]
                slopes = force_derivatives(engine.mesh, engine.quadrature.points, shares, q, adjoint)
                by_energy = -torch.from_numpy(slopes)
            if any(needs[6:9]):
                strain, change = engine.strains(q, adjoint)
                if needs[6]:
                    by_hourglass = torch.from_numpy(_by_hourglass(engine, q, state, adjoint, strain, change))
                if needs[7] or needs[8]:
                    dual = _dual_of_viscous_strain(engine, state, change)
                    by_memory = torch.from_numpy(dual)
                    by_viscous_modulus = -torch.from_numpy(_over_points(dual * strain, state))
        by_force = torch.from_numpy(adjoint)
        if needs[9]:
            by_velocity_offset = torch.from_numpy(_by_velocity_offset(engine, state, adjoint))
        return (
            inertia[..., None] * by_force if needs[0] else None,
            -(by_force * (x - target)).sum(-1) if needs[1] else None,
            by_force,
            by_fixed,
            by_moduli,
            by_energy,
            by_hourglass,
            by_viscous_modulus,
            by_memory,
            by_velocity_offset,
            None,
        )


class Strains(torch.autograd.Function):
    """Strains (B, E, Z) of `rafl.simulation.engine.Engine.strains` at positions q (B, N, 3) [m]."""

    @staticmethod
    def forward(ctx: Any, q: Tensor, engine: Engine) -> Tensor:
        """Evaluate them."""
        ctx.engine = engine
        ctx.save_for_backward(q)
        array = _array(q)
        return torch.from_numpy(engine.strains(array, np.zeros_like(array))[0])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Derivative by q."""
        (q,) = ctx.saved_tensors
        return torch.from_numpy(ctx.engine.strains_adjoint(_array(q), _array(grad))), None


# Arguments as of the forward methods, without ctx.
implicit_solve: Callable[..., Tensor] = ImplicitSolve.apply
strains: Callable[..., Tensor] = Strains.apply


def _array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().numpy())


def _constitutive_state(
    moduli: Tensor,
    energy: Tensor | None,
    hourglass: Tensor | None,
    viscous_modulus: Tensor | None,
    memory: Tensor | None,
    velocity_offset: Tensor | None,
    context: SolveContext,
) -> ConstitutiveState:
    points = len(context.simulator.engine.quadrature.points.shape)
    memories: list[Array | None] = [None, None]
    if memory is not None:
        whole = _array(memory)
        own = np.ascontiguousarray(whole[..., : 6 * points]).reshape(*whole.shape[:2], points, 6)
        memories = [own, np.ascontiguousarray(whole[..., 6 * points :])]
    return ConstitutiveState(
        _array(moduli),
        None if viscous_modulus is None else _array(viscous_modulus),
        memories[0],
        None if velocity_offset is None else _array(velocity_offset),
        context.velocity_factor,
        None if hourglass is None else HourglassStiffness(*_array(hourglass)),
        memories[1] if hourglass is not None else None,
        None if energy is None else _array(energy),
    )


def _by_moduli(engine: Engine, q: Array, state: ConstitutiveState, adjoint: Array) -> Array:
    """Minus adjoint . d(internal force) / d(moduli), (B, 4).

    The internal force at the integration points is linear in each modulus.
    """
    out: Array = np.zeros_like(state.moduli)
    hourglass = state.hourglass
    if hourglass is not None:
        none = np.zeros_like(hourglass.elastic)
        hourglass = HourglassStiffness(none, none, none)
    for k in (0, 1, *(DAMPING if state.velocity_offset is not None else ())):
        unit = np.zeros_like(state.moduli)
        unit[:, k] = 1.0
        single = ConstitutiveState(
            unit,
            velocity_offset=state.velocity_offset if k in DAMPING else None,
            velocity_factor=state.velocity_factor,
            hourglass=hourglass,
        )
        out[:, k] = -(adjoint * engine.evaluate(q, single, tangent=False)[1]).sum(axis=(1, 2))
    return out


def _over_points(values: Array, state: ConstitutiveState) -> Array:
    """Sums of values per strain (B, E, Z) over the strains that share a viscous modulus, (B, E, P)."""
    assert state.viscous_modulus is not None
    batch, cells, points = state.viscous_modulus.shape
    out: Array = values[..., : 6 * points].reshape(batch, cells, points, 6).sum(-1)
    out[..., 0] += values[..., 6 * points :].sum(-1)
    return out


def _viscous_weights(engine: Engine) -> Array:
    """Twice the volume of every integration point times the multiplicity of its strains, (E, 6 P)."""
    points, shares = engine.quadrature.points, engine.quadrature.point_shares[:, 0]
    weights: Array = 2.0 * (points.volume * shares)[..., None] * MULTIPLICITY
    return weights.reshape(len(weights), -1)


def _dual_of_viscous_strain(engine: Engine, state: ConstitutiveState, change: Array) -> Array:
    """Derivative of adjoint . viscous force by the viscous strain g E - memory, (B, E, Z); `change`: along adjoint."""
    weights = _viscous_weights(engine)
    dual = np.empty_like(change)
    dual[..., : weights.shape[1]] = weights * change[..., : weights.shape[1]]
    if state.hourglass is not None:
        matrix = state.hourglass.viscous[:, engine.hourglass_modes.shape_index]
        dual[..., weights.shape[1] :] = np.einsum("becd,bed->bec", matrix, change[..., weights.shape[1] :])
    return dual


def _by_hourglass(
    engine: Engine, q: Array, state: ConstitutiveState, adjoint: Array, strain: Array, change: Array
) -> Array:
    """Minus adjoint . d(internal force) / d(stiffness of the hourglass modes), (3, B, U, 12, 12)."""
    assert state.hourglass is not None
    own, along = strain[..., -MODES:], change[..., -MODES:]
    parts = [
        _by_shape(engine, along, own),
        np.zeros_like(state.hourglass.elastic),
        np.zeros_like(state.hourglass.elastic),
    ]
    if state.hourglass_memory is not None:
        assert state.viscous_modulus is not None
        viscous_strain = state.viscous_modulus * own - state.hourglass_memory
        parts[1] = _by_shape(engine, along, viscous_strain)
    if state.velocity_offset is not None:
        velocity = state.velocity_factor * q - state.velocity_offset
        parts[2] = _by_shape(engine, engine.hourglass_modes.vectors(adjoint), engine.hourglass_modes.vectors(velocity))
    return -np.stack(parts)


def _by_shape(engine: Engine, left: Array, right: Array) -> Array:
    """Outer products of left and right (B, E, 12), summed over the cells of each shape, (B, U, 12, 12)."""
    index = engine.hourglass_modes.shape_index
    out = np.zeros((len(left), int(index.max()) + 1, MODES, MODES))
    for shape in range(out.shape[1]):
        out[:, shape] = np.einsum("bec,bed->bcd", left[:, index == shape], right[:, index == shape])
    return out


def _by_velocity_offset(engine: Engine, state: ConstitutiveState, adjoint: Array) -> Array:
    """Derivative of minus adjoint . internal force by the velocity offset, (B, N, 3)."""
    points, shares, hexes = engine.quadrature.points, engine.quadrature.point_shares, engine.mesh.hexes
    mu, lam = (state.moduli[:, k, None, None] * shares[:, share] for k, share in zip(DAMPING, (0, 1), strict=True))
    slope = np.einsum("beni,epnj->bepij", adjoint[:, hexes], points.gradient)
    trace = np.trace(slope, axis1=-2, axis2=-1)
    stress = mu[..., None, None] * (slope + slope.swapaxes(-1, -2)) + (lam * trace)[..., None, None] * np.eye(3)
    force = np.einsum("ep,bepij,epnj->beni", points.volume, stress, points.gradient)
    if state.hourglass is not None:
        matrix = state.hourglass.damping[:, engine.hourglass_modes.shape_index]
        along = np.einsum("becd,bed->bec", matrix, engine.hourglass_modes.vectors(adjoint))
        force += np.einsum("beki,ekn->beni", along.reshape(*along.shape[:2], 4, 3), engine.hourglass_modes.gamma)
    return scatter(force, hexes, adjoint.shape[1])
