"""Differentiable simulation: trajectories of implicit steps, and static equilibria."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.simulation.adjoint import SolveContext, implicit_solve, strains
from rafl.simulation.parameters import Parameters
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS, ImplicitEuler, State, StepProblem
from rafl.simulation.viscous_memory import ViscousMemory
from rafl.solvers.linear import Factors

ResidualForce = Callable[[Tensor, Tensor, Tensor], Tensor]


@runtime_checkable
class RolloutResidual(Protocol):
    """A residual force that acts otherwise in a rollout, where it remembers the frames before."""

    def for_rollout(self) -> ResidualForce:
        """The force for one rollout, called once per frame in order."""


FIRST_ACCELERATION_FRACTION = 0.25  # of a step, over which the initial acceleration is averaged


@dataclass(frozen=True)
class Start:
    """Initial state and constant loads of a batch of trajectories.

    Attributes:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        force: constant nodal forces, without gravity [N], (B, N, 3).
        added_mass: attached mass that moves with the nodes [kg], (B, N); `force` must include its weight.
        names: of the trajectories, for messages, (B).
        history: positions in the frames before q, oldest first [m], (H, B, N, 3), for the memory of viscous
            materials. The bodies were long at rest at the oldest; without history, at q.
    """

    q: Tensor
    v: Tensor
    force: Tensor
    added_mass: Tensor
    names: tuple[str, ...]
    history: Tensor | None = None

    @classmethod
    def at_rest(cls, q: Tensor, force: Tensor | None = None, names: tuple[str, ...] | None = None) -> "Start":
        """Trajectories that start at rest at positions q (B, N, 3) [m], under constant forces (B, N, 3) [N] or none."""
        none = torch.zeros_like(q)
        labels = names or tuple(f"trajectory {number}" for number in range(len(q)))
        return cls(q, none, none if force is None else force, none[..., 0], labels)


@dataclass(frozen=True)
class _BodyBatch:
    """Material of a batch, as the steps need it."""

    simulator: Simulator
    parameters: Parameters
    moduli: Tensor  # (B, 4)
    energy: Tensor | None  # weights of the learned energy [Pa], (B, K)
    hourglass: Tensor | None  # (3, B, U, 12, 12), for `enhanced` integration
    mass: Tensor  # [kg], (B, N)
    weight: Tensor  # [N], (B, N, 3)

    @classmethod
    def of(cls, simulator: Simulator, parameters: Parameters | None, added_mass: Tensor) -> "_BodyBatch":
        values = parameters or simulator.parameters()
        batch = len(added_mass)
        own_mass = values.density.expand(batch)[:, None] * torch.from_numpy(simulator.node_volume)
        weight = own_mass[..., None] * values.gravity.expand(batch, 3)[:, None]
        moduli = values.moduli(simulator.material.law, batch)
        hourglass = simulator.hourglass_stiffness(values, batch)
        return cls(simulator, values, moduli, values.energy(batch), hourglass, own_mass + added_mass, weight)

    def initial_memory(self, start: Start) -> ViscousMemory | None:
        """Memory of the history of bodies, or None without viscosity."""
        if not self.parameters.viscous:
            return None
        batch = len(start.q)
        viscosity = self.parameters.viscosity.expand(batch)
        path = [start.q] if start.history is None else [*start.history, start.q]
        law, engine = self.simulator.material.law, self.simulator.engine
        branches = self.parameters.branches(law, batch)
        points = len(engine.quadrature.points.shape)
        dissipation = self.parameters.dissipation(law, batch)
        memory = ViscousMemory(viscosity, points, *branches, strains(path[0], engine), dissipation=dissipation)
        for q in path[1:]:
            memory = memory.after(strains(q, engine), self.simulator.time_step)
        return memory

    def solve(
        self,
        problem: StepProblem,
        force: Tensor,
        fixed_positions: Tensor,
        memory: ViscousMemory | None,
        duration: float,
        label: str,
        factors: Factors | None = None,
    ) -> tuple[Tensor, ViscousMemory | None]:
        """Solution of a step's equation, `duration` [s] after the latest one, and the memory after it."""
        simulator = self.simulator
        viscous_terms = (None, None) if memory is None else memory.stress_terms(duration)
        offset = problem.velocity_offset if self.parameters.stiffness_damped else None
        context = SolveContext(simulator, problem.guess, problem.velocity_factor, label, factors)
        loads = (problem.target, problem.inertia, force, fixed_positions)
        x = implicit_solve(*loads, self.moduli, self.energy, self.hourglass, *viscous_terms, offset, context)
        return x, None if memory is None else memory.after(strains(x, simulator.engine), duration)

    def initial_acceleration(
        self,
        state: State,
        force: Tensor,
        alpha: Tensor,
        fixed_positions: Tensor,
        memory: ViscousMemory | None,
        duration: float,
    ) -> Tensor:
        """Initial acceleration of the free nodes under `force`, gravity included [m/s^2], (B, N, 3).

        It is averaged over a short duration [s] by backward differences; the fixed nodes end at `fixed_positions`
        (B, F, 3). Forces jump where a body is released, and their exact acceleration would move its stiffest modes
        farther than a whole step could correct.
        """
        problem = ImplicitEuler().problem(state, self.mass, alpha, duration)
        x, _ = self.solve(problem, force, fixed_positions, memory, duration, "initial acceleration")
        free = torch.ones(state.q.shape[1], 1, dtype=torch.float64)
        free[torch.from_numpy(self.simulator.fixed)] = 0.0
        return free * ((x - state.q) / duration - state.v) / duration


@dataclass(frozen=True)
class Step:
    """The end of one time step.

    Attributes:
        state: positions, velocities and accelerations.
        residual_force: of the residual model during the step [N], (B, N, 3), or None without one.
        memory: of the viscous stress, or None without viscosity.
    """

    state: State
    residual_force: Tensor | None
    memory: ViscousMemory | None


def simulate_steps(
    simulator: Simulator,
    start: Start,
    steps: int,
    residual: ResidualForce | None = None,
    parameters: Parameters | None = None,
    clamp: Tensor | None = None,
) -> Iterator[Step]:
    """The time steps of `rollout`, with the same arguments, one after the other.

    Raises:
        SimulationError: a step failed; names trajectory, step and residual.
    """
    if isinstance(residual, RolloutResidual):
        residual = residual.for_rollout()
    integrator = INTEGRATORS[simulator.integrator]
    body = _BodyBatch.of(simulator, parameters, start.added_mass)
    external = start.force + body.weight
    h = simulator.time_step / simulator.substeps
    alpha = body.parameters.mass_damping.expand(len(start.q))[:, None]
    factors = simulator.engine.allocate(len(start.q))
    fixed = torch.from_numpy(simulator.fixed)
    state = State(start.q, start.v, torch.zeros_like(start.q))
    memory = body.initial_memory(start)
    duration = integrator.fraction * h  # from the latest solution to the next
    begin = start.q[:, fixed]
    for step in range(steps):
        residual_force = None if residual is None else residual(state.q, state.v, external)
        force = external if residual_force is None else external + residual_force
        if clamp is not None:
            begin = state.q[:, fixed]
        if step == 0 and integrator.uses_acceleration:
            share = FIRST_ACCELERATION_FRACTION / simulator.substeps
            fixed_positions = begin if clamp is None else (1.0 - share) * begin + share * clamp[0]
            short = FIRST_ACCELERATION_FRACTION * h
            acceleration = body.initial_acceleration(state, force, alpha, fixed_positions, memory, short)
            state = State(state.q, state.v, acceleration)
        for substep in range(simulator.substeps):
            problem = integrator.problem(state, body.mass, alpha, h)
            fixed_positions = begin
            if clamp is not None:
                share = (substep + integrator.fraction) / simulator.substeps
                fixed_positions = (1.0 - share) * begin + share * clamp[step]
            try:
                x, memory = body.solve(problem, force, fixed_positions, memory, duration, f"step {step + 1}", factors)
            except SimulationError as error:
                raise SimulationError(f"{error} [trajectories: {', '.join(start.names)}]") from None
            state, duration = integrator.advance(state, x, h), h
        yield Step(state, residual_force, memory)


def rollout(
    simulator: Simulator,
    start: Start,
    steps: int,
    residual: ResidualForce | None = None,
    parameters: Parameters | None = None,
    clamp: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Simulate a batch of trajectories (paper, eq. 1 and 2), differentiably.

    Gradients flow to the initial state, forces, added mass, every parameter, the clamp's motion and everything that
    `residual` depends on.

    Args:
        simulator: the specimen.
        start: initial state and loads. Its positions of the fixed nodes are those of the clamp.
        steps: number of time steps T, one per frame.
        residual: (q, v, external force with gravity) -> nodal force (B, N, 3) [N]. It is applied explicitly: evaluated
            once per frame, at its start, and constant during the frame, also with substeps.
        parameters: replace those of the simulator, see `simulator.parameters(...)`; may differ by trajectory.
        clamp: positions of the fixed nodes after each step [m], (T, B, F, 3); without it they do not move.

    Returns:
        Positions (T + 1, B, N, 3) [m] and residual forces (T, B, N, 3) [N], or an empty tensor without `residual`.

    Raises:
        SimulationError: a step failed; names trajectory, step and residual.
    """
    positions, forces = [start.q], []
    for step in simulate_steps(simulator, start, steps, residual, parameters, clamp):
        positions.append(step.state.q)
        if step.residual_force is not None:
            forces.append(step.residual_force)
    return torch.stack(positions), torch.stack(forces) if forces else start.q.new_zeros(0)


def equilibrium(
    simulator: Simulator,
    force: Tensor,
    parameters: Parameters | None = None,
    fixed_positions: Tensor | None = None,
    label: str = "equilibrium",
) -> Tensor:
    """Static equilibrium [m], (B, N, 3), differentiable with respect to forces, parameters and fixed positions.

    Args:
        simulator: the specimen.
        force: nodal forces, without gravity [N], (B, N, 3).
        parameters: replace those of the simulator.
        fixed_positions: positions of the fixed nodes [m], (B, F, 3); without them the nodes stay at rest.
        label: name of the solve in error messages.

    Raises:
        SimulationError: no convergence, even with the load applied in steps.
    """
    batch, nodes = force.shape[:2]
    body = _BodyBatch.of(simulator, parameters, force.new_zeros(batch, nodes))
    if fixed_positions is None:
        fixed_positions = torch.from_numpy(simulator.mesh.vertices[simulator.fixed]).expand(batch, -1, 3)
    context = SolveContext(simulator, None, label=label)
    no_inertia = force.new_zeros(batch, nodes)
    loads = (torch.zeros_like(force), no_inertia, force + body.weight, fixed_positions)
    return implicit_solve(*loads, body.moduli, body.energy, body.hourglass, None, None, None, context)
