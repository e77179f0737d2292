"""Time stepping: each step as a minimisation, and the state after it."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


@dataclass(frozen=True)
class State:
    """Positions [m], velocities [m/s] and accelerations [m/s^2] of a batch, all (B, N, 3)."""

    q: Tensor
    v: Tensor
    a: Tensor


@dataclass(frozen=True)
class Problem:
    """The step's solution x solves inertia (x - target) + internal force(x) = external force.

    Attributes:
        target: [m], (B, N, 3).
        inertia: [kg/s^2], (B, N).
        drift, rate: velocities at x are rate * x - drift, (B, N, 3) [m/s], [1/s].
        strain_rate, strain_memory: Green strain rates at x are
            strain_rate * (E(x) - E(q)) - strain_memory * dE(q)/dt, [1/s], [].
        guess: of x [m], (B, N, 3), without gradient.
    """

    target: Tensor
    inertia: Tensor
    drift: Tensor
    rate: float
    strain_rate: float
    strain_memory: float
    guess: Tensor


class Integrator(Protocol):
    """One way to step."""

    fraction: float  # where in the step x stands: 1 at its end
    uses_acceleration: bool  # whether the initial acceleration matters

    def problem(self, state: State, mass: Tensor, mass_damping: Tensor, h: float) -> Problem:
        """What to solve for a step of h [s]; mass (B, N) [kg], mass_damping (B, 1) [1/s]."""

    def advance(self, state: State, x: Tensor, h: float) -> State:
        """The state after the step whose solution is x (B, N, 3)."""


class ImplicitEuler:
    """Backward differences (paper, eq. 1): first order, damps a mode of w rad/s by about w h / 2 of critical."""

    fraction = 1.0
    uses_acceleration = False

    def problem(self, state: State, mass: Tensor, mass_damping: Tensor, h: float) -> Problem:
        """What to solve for a step of h [s]."""
        damping = mass_damping * h
        inertia = mass * (1.0 + damping) / h**2
        target = state.q + h * state.v / (1.0 + damping)[..., None]
        guess = (state.q + h * state.v + h**2 * state.a).detach()
        return Problem(target, inertia, state.q / h, 1.0 / h, 1.0 / h, 0.0, guess)

    def advance(self, state: State, x: Tensor, h: float) -> State:
        """The state after the step; the acceleration only serves the next guess."""
        v = (x - state.q) / h
        return State(x, v, ((v - state.v) / h).detach())


class GeneralisedAlpha:
    """Chung and Hulbert's generalised-alpha method (J. Appl. Mech. 60, 1993): second order.

    `infinity` is the factor by which a step shrinks the highest frequencies: 1 keeps them, 0 removes
    them. Low ones are hardly damped. A viscosity's strain rate is that of the trapezoidal rule.
    """

    uses_acceleration = True

    def __init__(self, infinity: float) -> None:
        self.alpha_m = (2.0 * infinity - 1.0) / (infinity + 1.0)
        self.alpha_f = infinity / (infinity + 1.0)
        self.gamma = 0.5 - self.alpha_m + self.alpha_f
        self.beta = 0.25 * (1.0 - self.alpha_m + self.alpha_f) ** 2
        self.fraction = 1.0 - self.alpha_f

    def problem(self, state: State, mass: Tensor, mass_damping: Tensor, h: float) -> Problem:
        """What to solve for a step of h [s]."""
        q, v, a = state.q, state.v, state.a
        theta = self.fraction
        coasting = h * v + h**2 * (0.5 - self.beta) * a  # Newmark's end of the step without the new acceleration
        by_inertia = (1.0 - self.alpha_m) / (self.beta * h**2 * theta)
        coast = q + theta * coasting - (self.alpha_m / by_inertia) * a
        rate = self.gamma / (self.beta * h)
        drift = rate * (q + theta * coasting) - v - theta * h * (1.0 - self.gamma) * a
        by_damping = mass_damping * rate
        inertia = mass * (by_inertia + by_damping)
        weight = (by_damping / (by_inertia + by_damping))[..., None]
        target = (1.0 - weight) * coast + weight * drift / rate
        guess = (q + theta * (h * v + 0.5 * h**2 * a)).detach()
        return Problem(target, inertia, drift, rate, 2.0 / (theta * h), 1.0, guess)

    def advance(self, state: State, x: Tensor, h: float) -> State:
        """The state after the step."""
        q, v, a = state.q, state.v, state.a
        move = (x - q) / self.fraction
        after = (move - h * v - h**2 * (0.5 - self.beta) * a) / (self.beta * h**2)
        return State(q + move, v + h * ((1.0 - self.gamma) * a + self.gamma * after), after)


INTEGRATORS: dict[str, Integrator] = {
    "implicit-euler": ImplicitEuler(),
    "generalised-alpha": GeneralisedAlpha(0.5),
}


def green_strain(q: Tensor, v: Tensor, hexes: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Green strain E and its rate at integration points, components 00 11 22 01 12 02, (B, E, P, 6).

    q, v (B, N, 3); hexes (E, 8); gradient (E, P, 8, 3).
    """
    F, rate = (torch.einsum("beni,egnj->begij", x[:, hexes], gradient) for x in (q, v))
    identity = torch.eye(3, dtype=q.dtype)
    strain = 0.5 * (F.mT @ F - identity)
    change = 0.5 * (F.mT @ rate + rate.mT @ F)
    first, second = [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]
    return strain[..., first, second], change[..., first, second]
