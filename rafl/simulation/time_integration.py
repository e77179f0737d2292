"""Time integration: the equation of each step, and the state after it."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True)
class State:
    """Positions [m], velocities [m/s] and accelerations [m/s^2] of a batch, all (B, N, 3)."""

    q: Tensor
    v: Tensor
    a: Tensor


@dataclass(frozen=True)
class StepProblem:
    """Equation of a step from state q to its solution x: inertia (x - target) + internal force(x) = external force.

    Attributes:
        target: [m], (B, N, 3).
        inertia: [kg/s^2], (B, N).
        velocity_offset, velocity_factor: velocities at x are velocity_factor * x - velocity_offset, (B, N, 3) [m/s],
            [1/s].
        guess: first guess of x [m], (B, N, 3), detached.
    """

    target: Tensor
    inertia: Tensor
    velocity_offset: Tensor
    velocity_factor: float
    guess: Tensor


class Integrator(Protocol):
    """A time integration method."""

    fraction: float  # of the step, at which its equation holds: 0 at the start, 1 at the end
    uses_acceleration: bool  # whether the result depends on the initial acceleration

    def problem(self, state: State, mass: Tensor, mass_damping: Tensor, h: float) -> StepProblem:
        """Equation of a step of h [s]; mass (B, N) [kg], mass_damping (B, 1) [1/s]."""

    def advance(self, state: State, x: Tensor, h: float) -> State:
        """The state after the step whose solution is x (B, N, 3)."""


class ImplicitEuler:
    """Backward differences (paper, eq. 1), first order.

    The numerical damping ratio of a mode of angular frequency w [rad/s] is about w h / 2.
    """

    fraction = 1.0
    uses_acceleration = False

    def problem(self, state: State, mass: Tensor, mass_damping: Tensor, h: float) -> StepProblem:
        """Equation of a step of h [s]."""
        damping = mass_damping * h
        inertia = mass * (1.0 + damping) / h**2
        target = state.q + h * state.v / (1.0 + damping)[..., None]
        guess = (state.q + h * state.v + h**2 * state.a).detach()
        return StepProblem(target, inertia, state.q / h, 1.0 / h, guess)

    def advance(self, state: State, x: Tensor, h: float) -> State:
        """The state after the step; its acceleration is only used for the next guess."""
        v = (x - state.q) / h
        return State(x, v, ((v - state.v) / h).detach())


class GeneralisedAlpha:
    """Chung and Hulbert's generalised-alpha method (J. Appl. Mech. 60, 1993): second order.

    Args:
        rho_infinity: spectral radius at infinite frequency, the factor by which a step scales the highest frequencies:
            1 keeps them, 0 removes them. Low frequencies are hardly damped.
    """

    uses_acceleration = True

    def __init__(self, rho_infinity: float) -> None:
        self.alpha_m = (2.0 * rho_infinity - 1.0) / (rho_infinity + 1.0)
        self.alpha_f = rho_infinity / (rho_infinity + 1.0)
        self.gamma = 0.5 - self.alpha_m + self.alpha_f
        self.beta = 0.25 * (1.0 - self.alpha_m + self.alpha_f) ** 2
        self.fraction = 1.0 - self.alpha_f

    def problem(self, state: State, mass: Tensor, mass_damping: Tensor, h: float) -> StepProblem:
        """Equation of a step of h [s]."""
        q, v, a = state.q, state.v, state.a
        theta = self.fraction
        predicted = h * v + h**2 * (0.5 - self.beta) * a  # Newmark displacement without the new acceleration
        inertia_factor = (1.0 - self.alpha_m) / (self.beta * h**2 * theta)
        inertia_target = q + theta * predicted - (self.alpha_m / inertia_factor) * a
        velocity_factor = self.gamma / (self.beta * h)
        velocity_offset = velocity_factor * (q + theta * predicted) - v - theta * h * (1.0 - self.gamma) * a
        damping_factor = mass_damping * velocity_factor
        inertia = mass * (inertia_factor + damping_factor)
        weight = (damping_factor / (inertia_factor + damping_factor))[..., None]
        target = (1.0 - weight) * inertia_target + weight * velocity_offset / velocity_factor
        guess = (q + theta * (h * v + 0.5 * h**2 * a)).detach()
        return StepProblem(target, inertia, velocity_offset, velocity_factor, guess)

    def advance(self, state: State, x: Tensor, h: float) -> State:
        """The state after the step."""
        q, v, a = state.q, state.v, state.a
        displacement = (x - q) / self.fraction
        after = (displacement - h * v - h**2 * (0.5 - self.beta) * a) / (self.beta * h**2)
        return State(q + displacement, v + h * ((1.0 - self.gamma) * a + self.gamma * after), after)


INTEGRATORS: dict[str, Integrator] = {
    "implicit-euler": ImplicitEuler(),
    "generalised-alpha": GeneralisedAlpha(0.5),
}
