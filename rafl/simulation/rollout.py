"""Differentiable simulation: trajectories of implicit steps, and static equilibria."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rafl.common.errors import SimulationError
from rafl.simulation.adjoint import Minimum, Setting
from rafl.simulation.parameters import Parameters
from rafl.simulation.simulator import Simulator
from rafl.simulation.time_integration import INTEGRATORS, ImplicitEuler, Problem, State, green_strain

ResidualForce = Callable[[Tensor, Tensor, Tensor], Tensor]


FIRST_SHARE = 0.25  # of a step, over which the first acceleration is taken


@dataclass(frozen=True)
class Start:
    """Where and under what a batch of trajectories starts.

    Attributes:
        q, v: positions [m] and velocities [m/s], (B, N, 3).
        force: constant nodal forces, gravity excepted [N], (B, N, 3).
        added_mass: hung-on mass that swings along [kg], (B, N); its weight belongs to `force`.
        names: of the trajectories, for messages, (B).
    """

    q: Tensor
    v: Tensor
    force: Tensor
    added_mass: Tensor
    names: tuple[str, ...]


@dataclass(frozen=True)
class _Body:
    """A batch's material in the form that steps want it."""

    simulator: Simulator
    parameters: Parameters
    moduli: Tensor  # (B, 5)
    mass: Tensor  # (B, N)
    weight: Tensor  # (B, N, 3)

    @classmethod
    def of(cls, simulator: Simulator, parameters: Parameters | None, added_mass: Tensor) -> "_Body":
        values = parameters or simulator.parameters()
        batch = len(added_mass)
        own = values.density.expand(batch)[:, None] * torch.from_numpy(simulator.node_volume)
        weight = own[..., None] * values.gravity.expand(batch, 3)[:, None]
        moduli = values.moduli(simulator.material.law, batch)
        return cls(simulator, values, moduli, own + added_mass, weight)

    def past(self, state: State, problem: Problem) -> tuple[Tensor, Tensor] | tuple[None, None]:
        """Drift and strain history of a step, where there is damping."""
        if not self.parameters.damped:
            return None, None
        strain, change = self._strains(state)
        return problem.drift, problem.strain_rate * strain + problem.strain_memory * change

    def _strains(self, state: State) -> tuple[Tensor, Tensor]:
        mesh, points = self.simulator.mesh, self.simulator.engine.integration.points
        return green_strain(state.q, state.v, torch.from_numpy(mesh.hexes), torch.from_numpy(points.gradient))

    def acceleration(self, state: State, force: Tensor, alpha: Tensor, held: Tensor, short: float) -> Tensor:
        """What the free nodes start with under `force`, gravity included [m/s^2], (B, N, 3).

        Taken over a short time [s] by backward differences, at whose end the held nodes are at `held` (B, F, 3): where
        a body is let go forces jump, and would throw its stiffest modes farther than a whole step could take back.
        """
        problem = ImplicitEuler().problem(state, self.mass, alpha, short)
        drift, strain = self.past(state, problem)
        setting = Setting(self.simulator, problem.guess, problem.rate, problem.strain_rate, "first acceleration")
        x = Minimum.apply(problem.target, problem.inertia, force, held, self.moduli, drift, strain, setting)
        free = torch.ones(state.q.shape[1], 1, dtype=torch.float64)
        free[torch.from_numpy(self.simulator.fixed)] = 0.0
        return free * ((x - state.q) / short - state.v) / short


def rollout(
    simulator: Simulator,
    start: Start,
    steps: int,
    residual: ResidualForce | None = None,
    parameters: Parameters | None = None,
    clamp: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Simulate a batch of trajectories (paper, eq. 1 and 2), differentiably.

    Gradients flow to the initial state, forces, added mass, every parameter, the clamp's motion and
    whatever `residual` depends on.

    Args:
        simulator: the specimen.
        start: initial state and loads.
        steps: number of time steps T.
        residual: (q, v, external force, gravity included) -> nodal force (B, N, 3) [N], applied
            explicitly: taken at the start of each time step and held through it.
        parameters: other than the simulator's own (`simulator.parameters(...)`), also by trajectory.
        clamp: where the held nodes are after each step [m], (T, B, F, 3); else they stay.

    Returns:
        Positions (T + 1, B, N, 3) [m] and residual forces (T, B, N, 3) [N] (zero-size without one).

    Raises:
        SimulationError: names trajectory, step and residual.
    """
    integrator = INTEGRATORS[simulator.integrator]
    body = _Body.of(simulator, parameters, start.added_mass)
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
            share = FIRST_SHARE / simulator.substeps
            held = begin if clamp is None else (1.0 - share) * begin + share * clamp[0]
            state = State(state.q, state.v, body.acceleration(state, force, alpha, held, FIRST_SHARE * h))
        for substep in range(simulator.substeps):
            problem = integrator.problem(state, body.mass, alpha, h)
            held = begin
            if clamp is not None:
                share = (substep + integrator.fraction) / simulator.substeps
                held = (1.0 - share) * begin + share * clamp[step]
            drift, strain = body.past(state, problem)
            setting = Setting(simulator, problem.guess, problem.rate, problem.strain_rate, f"step {step + 1}", factors)
            try:
                x = Minimum.apply(problem.target, problem.inertia, force, held, body.moduli, drift, strain, setting)
            except SimulationError as error:
                raise SimulationError(f"{error} [trajectories: {', '.join(start.names)}]") from None
            state = integrator.advance(state, x, h)
        positions.append(state.q)
    return torch.stack(positions), torch.stack(forces) if forces else start.q.new_zeros(0)


def equilibrium(
    simulator: Simulator,
    force: Tensor,
    parameters: Parameters | None = None,
    held: Tensor | None = None,
    what: str = "equilibrium",
) -> Tensor:
    """Static equilibrium [m], (B, N, 3), differentiable by forces, parameters and held positions.

    Args:
        simulator: the specimen.
        force: nodal forces, gravity excepted [N], (B, N, 3).
        parameters: other than the simulator's own.
        held: positions of the held nodes [m], (B, F, 3); else as at rest.
        what: named in errors.

    Raises:
        SimulationError: no convergence, not even with the load put on in steps.
    """
    batch, nodes = force.shape[:2]
    body = _Body.of(simulator, parameters, force.new_zeros(batch, nodes))
    if held is None:
        held = torch.from_numpy(simulator.mesh.vertices[simulator.fixed]).expand(batch, -1, 3)
    setting = Setting(simulator, None, what=what)
    none = force.new_zeros(batch, nodes)
    rest = torch.zeros_like(force)
    return Minimum.apply(rest, none, force + body.weight, held, body.moduli, None, None, setting)
