"""Differentiable simulation: trajectories of implicit steps, and static equilibria."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.simulation.adjoint import SolveContext, implicit_solve
from rafl.simulation.parameters import Parameters
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS, ImplicitEuler, State, StepProblem, green_strain

ResidualForce = Callable[[Tensor, Tensor, Tensor], Tensor]


FIRST_ACCELERATION_FRACTION = 0.25  # of a step, over which the initial acceleration is averaged


@dataclass(frozen=True)
class Start:
    """Initial state and constant loads of a batch of trajectories.

    Attributes:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        force: constant nodal forces, without gravity [N], (B, N, 3).
        added_mass: attached mass that moves with the nodes [kg], (B, N); `force` must include its weight.
        names: of the trajectories, for messages, (B).
    """

    q: Tensor
    v: Tensor
    force: Tensor
    added_mass: Tensor
    names: tuple[str, ...]

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
    moduli: Tensor  # (B, 5)
    mass: Tensor  # [kg], (B, N)
    weight: Tensor  # [N], (B, N, 3)

    @classmethod
    def of(cls, simulator: Simulator, parameters: Parameters | None, added_mass: Tensor) -> "_BodyBatch":
        values = parameters or simulator.parameters()
        batch = len(added_mass)
        own_mass = values.density.expand(batch)[:, None] * torch.from_numpy(simulator.node_volume)
        weight = own_mass[..., None] * values.gravity.expand(batch, 3)[:, None]
        moduli = values.moduli(simulator.material.law, batch)
        return cls(simulator, values, moduli, own_mass + added_mass, weight)

    def damping_offsets(self, state: State, problem: StepProblem) -> tuple[Tensor, Tensor] | tuple[None, None]:
        """Velocity and strain offsets of `rafl.fem.constitutive_state.ConstitutiveState`, or None without damping."""
        if not self.parameters.damped:
            return None, None
        strain, strain_rate = self._strains(state)
        return problem.velocity_offset, problem.strain_factor * strain + problem.strain_rate_weight * strain_rate

    def _strains(self, state: State) -> tuple[Tensor, Tensor]:
        mesh, points = self.simulator.mesh, self.simulator.engine.quadrature.points
        return green_strain(state.q, state.v, torch.from_numpy(mesh.hexes), torch.from_numpy(points.gradient))

    def initial_acceleration(
        self, state: State, force: Tensor, alpha: Tensor, fixed_positions: Tensor, duration: float
    ) -> Tensor:
        """Initial acceleration of the free nodes under `force`, gravity included [m/s^2], (B, N, 3).

        It is averaged over a short duration [s] by backward differences; the fixed nodes end at `fixed_positions`
        (B, F, 3). Forces jump where a body is released, and their exact acceleration would move its stiffest modes
        farther than a whole step could correct.
        """
        problem = ImplicitEuler().problem(state, self.mass, alpha, duration)
        offsets = self.damping_offsets(state, problem)
        context = SolveContext(
            self.simulator, problem.guess, problem.velocity_factor, problem.strain_factor, "initial acceleration"
        )
        x = implicit_solve(problem.target, problem.inertia, force, fixed_positions, self.moduli, *offsets, context)
        free = torch.ones(state.q.shape[1], 1, dtype=torch.float64)
        free[torch.from_numpy(self.simulator.fixed)] = 0.0
        return free * ((x - state.q) / duration - state.v) / duration


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
    integrator = INTEGRATORS[simulator.integrator]
    body = _BodyBatch.of(simulator, parameters, start.added_mass)
    external = start.force + body.weight
    h = simulator.time_step / simulator.substeps
    alpha = body.parameters.mass_damping.expand(len(start.q))[:, None]
    factors = simulator.engine.allocate(len(start.q))
    fixed = torch.from_numpy(simulator.fixed)
    state = State(start.q, start.v, torch.zeros_like(start.q))
    positions, forces = [start.q], []
    begin = start.q[:, fixed]
    for step in range(steps):
        force = external
        if residual is not None:
            forces.append(residual(state.q, state.v, external))
            force = external + forces[-1]
        if clamp is not None:
            begin = state.q[:, fixed]
        if step == 0 and integrator.uses_acceleration:
            share = FIRST_ACCELERATION_FRACTION / simulator.substeps
            fixed_positions = begin if clamp is None else (1.0 - share) * begin + share * clamp[0]
            duration = FIRST_ACCELERATION_FRACTION * h
            acceleration = body.initial_acceleration(state, force, alpha, fixed_positions, duration)
            state = State(state.q, state.v, acceleration)
        for substep in range(simulator.substeps):
            problem = integrator.problem(state, body.mass, alpha, h)
            fixed_positions = begin
            if clamp is not None:
                share = (substep + integrator.fraction) / simulator.substeps
                fixed_positions = (1.0 - share) * begin + share * clamp[step]
            offsets = body.damping_offsets(state, problem)
            context = SolveContext(
                simulator, problem.guess, problem.velocity_factor, problem.strain_factor, f"step {step + 1}", factors
            )
            try:
                x = implicit_solve(
                    problem.target, problem.inertia, force, fixed_positions, body.moduli, *offsets, context
                )
            except SimulationError as error:
                raise SimulationError(f"{error} [trajectories: {', '.join(start.names)}]") from None
            state = integrator.advance(state, x, h)
        positions.append(state.q)
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
    target = torch.zeros_like(force)
    return implicit_solve(target, no_inertia, force + body.weight, fixed_positions, body.moduli, None, None, context)
