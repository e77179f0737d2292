"""Steps and equilibria as differentiable functions, by the implicit-function theorem."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rafl.fem.constitutive_state import MODULI, Resistance
from rafl.simulation.engine import Engine
from rafl.simulation.simulator import Simulator
from rafl.solvers.linear import Factors


@dataclass(frozen=True)
class Setting:
    """What a solve needs and is not differentiated by.

    Attributes:
        simulator: the specimen.
        guess: of the solution [m], (B, N, 3); None solves a static equilibrium from rest.
        rate, strain_rate: see `rafl.fem.constitutive_state.Resistance`.
        what: named in errors.
        factors: of the step before.
    """

    simulator: Simulator
    guess: Tensor | None
    rate: float = 1.0
    strain_rate: float = 1.0
    what: str = "step"
    factors: Factors | None = None


class Minimum(torch.autograd.Function):
    """Positions x with inertia (x - target) + internal force(x) = force on the free nodes.

    Inputs: target (B, N, 3) [m], inertia (B, N) [kg/s^2], force (B, N, 3) [N], held positions (B, F, 3)
    [m], moduli (B, 5), and, for damping, drift (B, N, 3) and strain (B, E, P, 6), or None. At the
    solution (inertia + K) dx = inertia dtarget + dforce - ..., so one solve with the exact tangent K
    gives every derivative.
    """

    @staticmethod
    def forward(
        ctx: Any,
        target: Tensor,
        inertia: Tensor,
        force: Tensor,
        held: Tensor,
        moduli: Tensor,
        drift: Tensor | None,
        strain: Tensor | None,
        setting: Setting,
    ) -> Tensor:
        """Solve."""
        simulator = setting.simulator
        resistance = _resistance(moduli, drift, strain, setting)
        arrays = [_array(tensor) for tensor in (target, inertia, force, held)]
        if setting.guess is None:
            start = np.broadcast_to(simulator.mesh.vertices, arrays[2].shape).copy()
            start[:, simulator.fixed] = arrays[3]
            x = simulator.equilibrium(arrays[2], start, setting.what, resistance)
        else:
            start = setting.guess.numpy().copy()
            start[:, simulator.fixed] = arrays[3]
            x = simulator.minimise(start, arrays[1], arrays[0], arrays[2], resistance, setting.what, setting.factors)
        result = torch.from_numpy(x)
        ctx.setting = setting
        ctx.save_for_backward(result, target, inertia, moduli, drift, strain)
        return result

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives by each input."""
        x, target, inertia, moduli, drift, strain = ctx.saved_tensors
        simulator, engine = ctx.setting.simulator, ctx.setting.simulator.engine
        resistance = _resistance(moduli, drift, strain, ctx.setting)
        q = _array(x)
        batch, nodes = q.shape[:2]
        free = engine.free_index
        weight = _array(inertia)
        diagonal = np.repeat(weight, 3, axis=1)[:, free]
        right = np.ascontiguousarray(_array(grad).reshape(batch, -1)[:, free])
        adjoint = np.zeros((batch, 3 * nodes))
        needs = ctx.needs_input_grad
        by_held = by_moduli = by_drift = by_strain = None
        with engine.threads(batch):
            tangents = engine.terms(q, resistance, tangent=True)[2]
            adjoint[:, free] = engine.solve_once(tangents, diagonal, right[:, None])[:, 0]
            adjoint = adjoint.reshape(batch, nodes, 3)
            if needs[3]:
                by_held = torch.from_numpy(grad.numpy()[:, simulator.fixed] - engine.reactions(tangents, adjoint))
            if needs[4]:
                by_moduli = torch.from_numpy(_by_moduli(engine, q, resistance, adjoint))
        by = torch.from_numpy(adjoint)
        if resistance.damped and (needs[5] or needs[6]):
            by_drift, by_strain = _by_past(engine, q, resistance, adjoint)
        return (
            inertia[..., None] * by if needs[0] else None,
            -(by * (x - target)).sum(-1) if needs[1] else None,
            by,
            by_held,
            by_moduli,
            by_drift,
            by_strain,
            None,
        )


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy())


def _resistance(moduli: Tensor, drift: Tensor | None, strain: Tensor | None, setting: Setting) -> Resistance:
    past, memory = (None if tensor is None else _array(tensor) for tensor in (drift, strain))
    return Resistance(_array(moduli), past, setting.rate, memory, setting.strain_rate)


def _by_moduli(engine: Engine, q: np.ndarray, resistance: Resistance, adjoint: np.ndarray) -> np.ndarray:
    """Minus adjoint . d(internal force) / d moduli; internal force is linear in each."""
    out = np.zeros_like(resistance.moduli)
    for k in range(len(MODULI) if resistance.damped else 2):
        unit = np.zeros_like(resistance.moduli)
        unit[:, k] = 1.0
        alone = Resistance(unit, resistance.drift, resistance.rate, resistance.strain, resistance.strain_rate)
        out[:, k] = -(adjoint * engine.terms(q, alone, tangent=False)[1]).sum(axis=(1, 2))
    return out


def _by_past(engine: Engine, q: np.ndarray, resistance: Resistance, adjoint: np.ndarray) -> tuple[Tensor, Tensor]:
    """Derivatives by drift and by strain of minus adjoint . internal force."""
    rule, shares, hexes = engine.integration.points, engine.integration.point_shares, engine.mesh.hexes
    eta, mu, lam = (resistance.moduli[:, k, None, None] * shares[:, share] for k, share in ((2, 0), (3, 0), (4, 1)))
    slope = np.einsum("beni,epnj->bepij", adjoint[:, hexes], rule.gradient)
    trace = np.trace(slope, axis1=-2, axis2=-1)
    stress = mu[..., None, None] * (slope + slope.swapaxes(-1, -2)) + (lam * trace)[..., None, None] * np.eye(3)
    force = np.einsum("ep,bepij,epnj->beni", rule.volume, stress, rule.gradient)
    by_drift = torch.zeros(q.shape, dtype=torch.float64)
    by_drift.index_add_(1, torch.from_numpy(hexes.ravel()), torch.from_numpy(force.reshape(len(q), -1, 3)))
    F = np.einsum("beni,epnj->bepij", q[:, hexes], rule.gradient)
    change = F.swapaxes(-1, -2) @ slope
    change = 0.5 * (change + change.swapaxes(-1, -2))
    six = change[..., [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]] * np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    return by_drift, torch.from_numpy(2.0 * (eta * rule.volume)[..., None] * six)
