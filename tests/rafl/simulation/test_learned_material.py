"""The learned strain energy and viscosity: against the tensors, finite differences, and energy without load."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rafl.fem.learned.energy import UNITS as ENERGY_UNITS
from rafl.fem.learned.energy import shared_weights
from rafl.fem.learned.viscosity import UNITS as VISCOSITY_UNITS
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.rollout import Start, equilibrium, rollout, simulate_steps
from rafl.simulation.simulator import Simulator

SCHEMES = pytest.mark.parametrize("integration", ["full", "selective", "enhanced"])
SEEDS = pytest.mark.parametrize("seed", range(4))


def learned_material(seed: int, integration: str = "enhanced", **values: Any) -> Material:
    """A material with random weights, about as large as the law's own stiffness."""
    random = np.random.default_rng(seed)
    return Material(
        1e5,
        0.45,
        law="corotated",
        integration=integration,
        mass="lumped",
        energy_weights=tuple(random.exponential(0.5, ENERGY_UNITS)),
        dissipation_weights=tuple(random.exponential(0.02, VISCOSITY_UNITS)),
        **values,
    )


def beam(material: Material, **values: Any) -> Simulator:
    mesh = HexMesh.box((4, 2, 2), (0.08, 0.02, 0.02))
    return Simulator(mesh, material, mesh.face_nodes("x-min"), **values)


def deformed(simulator: Simulator, seed: int, size: float = 3e-3) -> np.ndarray:
    q: np.ndarray = simulator.mesh.vertices + np.random.default_rng(seed).normal(
        0, size, (2, *simulator.mesh.vertices.shape)
    )
    return q


def test_weights_are_as_the_kernels_take_them() -> None:
    """For an array of another layout all kernels would be compiled again."""
    weights = beam(learned_material(0)).constitutive_state(3).energy_weights
    assert weights is not None
    assert weights.flags.c_contiguous


@SCHEMES
@SEEDS
def test_engines_agree(integration: str, seed: int) -> None:
    simulator = beam(learned_material(seed, integration))
    tensors = replace(simulator, arithmetic="torch")
    q, direction = deformed(simulator, seed), deformed(simulator, seed + 100) - simulator.mesh.vertices
    results = []
    for each in (simulator, tensors):
        state = each.constitutive_state(2)
        energy, gradient, tangents = each.engine.evaluate(q, state, tangent=True)
        results.append((energy, gradient, each.engine.multiply(tangents, direction)))
    for ours, theirs in zip(*results, strict=True):
        assert np.abs(ours - theirs).max() <= 1e-9 * np.abs(theirs).max()


@SEEDS
def test_gradient_and_tangent_are_derivatives(seed: int) -> None:
    simulator = beam(learned_material(seed))
    q, direction, h = deformed(simulator, seed), deformed(simulator, seed + 100) - simulator.mesh.vertices, 1e-6

    def at(step: float, tangent: bool = False) -> Any:
        return simulator.engine.evaluate(q + step * direction, simulator.constitutive_state(2), tangent=tangent)

    (high, high_gradient, _), (low, low_gradient, _) = at(h), at(-h)
    _, gradient, tangents = at(0.0, True)
    slope = (gradient * direction).sum((1, 2))
    assert (high - low) / (2 * h) == pytest.approx(slope, rel=1e-7)
    product = simulator.engine.multiply(tangents, direction)
    assert np.abs((high_gradient - low_gradient) / (2 * h) - product).max() < 1e-6 * np.abs(product).max()


@SEEDS
def test_energy_is_never_negative_and_has_no_slope_at_rest(seed: int) -> None:
    simulator = beam(learned_material(seed))
    moved = np.concatenate(
        [
            simulator.mesh.vertices + size * (deformed(simulator, seed) - simulator.mesh.vertices)
            for size in (0.01, 0.3, 1.0, 10.0)
        ]
    )
    assert (simulator.engine.evaluate(moved, simulator.constitutive_state(len(moved)), tangent=False)[0] > 0.0).all()
    rest = simulator.mesh.vertices[None]
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    for q in (rest, rest @ (turn * np.linalg.det(turn))):
        energy, gradient, _ = simulator.engine.evaluate(q, simulator.constitutive_state(1), tangent=False)
        assert abs(energy[0]) < 1e-15
        assert np.abs(gradient).max() < 1e-12 * 1e5 * 0.02


@SEEDS
def test_small_strains_keep_the_moduli(seed: int) -> None:
    """E and nu are those at rest, whatever the weights."""
    learned = beam(learned_material(seed))
    law_alone = beam(replace(learned.material, energy_weights=(), dissipation_weights=()))
    q = learned.mesh.vertices + 1e-4 * (deformed(learned, seed) - learned.mesh.vertices)
    forces = [each.elastic_gradient(q) for each in (learned, law_alone)]
    assert np.abs(forces[0] - forces[1]).max() < 1e-3 * np.abs(forces[1]).max()
    _, law = shared_weights(torch.tensor(learned.material.energy_weights))
    assert law < 0.5


@SCHEMES
def test_gradients_by_weights(integration: str) -> None:
    """Those of a rollout with history-dependent stress, against central differences."""
    material = learned_material(1, integration, branch_shares=(0.1,), branch_times=(0.05,))
    simulator = beam(material, integrator="generalised-alpha", substeps=2)
    start = Start.at_rest(equilibrium(simulator, pull(simulator, 1)))
    probe = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 1, *simulator.mesh.vertices.shape)))
    weights = {
        key: torch.tensor(getattr(material, key), dtype=torch.float64, requires_grad=True)
        for key in ("energy_weights", "dissipation_weights")
    }

    def value(**replaced: Any) -> torch.Tensor:
        return (probe * rollout(simulator, start, 5, parameters=simulator.parameters(**replaced))[0]).sum()

    torch.autograd.backward(value(**weights))
    for key, tensor in weights.items():
        assert tensor.grad is not None
        direction = torch.from_numpy(np.random.default_rng(2).normal(size=len(tensor)))
        h = 1e-4
        with torch.no_grad():
            ends = [value(**(weights | {key: tensor + sign * h * direction})) for sign in (1.0, -1.0)]
        difference = float(ends[0] - ends[1]) / (2 * h)
        assert difference == pytest.approx(float(tensor.grad @ direction), rel=2e-5)


def total_energy(simulator: Simulator, q: torch.Tensor, v: torch.Tensor) -> float:
    own = simulator.engine.evaluate(q.numpy(), simulator.constitutive_state(1), tangent=False)[0][0]
    kinetic = 0.5 * (torch.from_numpy(simulator.node_mass)[:, None] * v[0] ** 2).sum()
    return float(own + kinetic)


@pytest.mark.parametrize(
    ("seed", "steps"),
    [(0, 300), (1, 300), (2, 300), *(pytest.param(k, 10_000, marks=pytest.mark.slow) for k in range(3, 11))],
)
def test_energy_never_rises_without_load(seed: int, steps: int) -> None:
    """Random weights, a large first deformation, no load and no motion of the clamp; implicit Euler."""
    simulator = beam(learned_material(seed), gravity=(0.0, 0.0, 0.0))
    bent = equilibrium(simulator, pull(simulator, seed))
    before = total_energy(simulator, bent, torch.zeros_like(bent))
    first = before
    for step in simulate_steps(simulator, Start.at_rest(bent), steps):
        now = total_energy(simulator, step.state.q, step.state.v)
        assert now <= before + 1e-12 * first
        before = now
    assert before < 0.5 * first


def pull(simulator: Simulator, seed: int) -> torch.Tensor:
    """A force at the free end that bends, twists and stretches the beam strongly."""
    force = torch.zeros(1, *simulator.mesh.vertices.shape, dtype=torch.float64)
    end = simulator.mesh.face_nodes("x-max")
    force[0, end] = 0.02 * torch.from_numpy(np.random.default_rng(seed).normal(size=(len(end), 3)))
    force[0, end, 2] += 0.03
    return force
