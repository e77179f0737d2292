"""Comparison of the compiled kernels with the tensors, which are their specification."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from devices import ON_DEVICES
from scipy.spatial.transform import Rotation

from rafl.fem.constitutive_state import ConstitutiveState, HourglassStiffness
from rafl.fem.laws import LAWS
from rafl.fem.learned.energy import UNITS as ENERGY_UNITS
from rafl.fem.learned.viscosity import UNITS as VISCOSITY_UNITS
from rafl.fem.material import INTEGRATION_SCHEMES, Material
from rafl.fem.mesh import HexMesh
from rafl.simulation import torch_engine
from rafl.simulation.compiled_engine import CompiledEngine
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator
from rafl.simulation.torch_engine import TorchEngine

CELLS = np.ones((4, 2, 2), dtype=bool)
CELLS[2, 0] = CELLS[3, :, 1] = False  # a cross-section that varies
GRID = HexMesh.from_grid(CELLS, (0.018, 0.015, 0.015))
MESH = HexMesh(GRID.vertices * (1.0 + GRID.vertices[:, :1] * [0.0, 4.0, -3.0]), GRID.hexes)  # cells of several shapes
FIXED = MESH.face_nodes("x-min")


def states(random: np.random.Generator) -> np.ndarray:
    """At rest, perturbed, perturbed and rotated, compressed to near inversion, and inverted (5, N, 3)."""
    rest = MESH.vertices
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    shaken = rest + random.normal(0, 1e-3, rest.shape)
    flat = rest * [0.06, 1.3, 1.2]
    inverted = shaken.copy()
    inverted[-1] -= [0.045, 0.0, 0.0]
    return np.stack([rest, shaken, shaken @ turn.T, flat, inverted])


def engines(law: str, integration: str, device: str) -> tuple[CompiledEngine, TorchEngine]:
    return CompiledEngine(MESH, law, integration, FIXED), TorchEngine(MESH, law, integration, FIXED, device)


def constitutive(
    engine: CompiledEngine, moduli: np.ndarray, damped: bool, random: np.random.Generator
) -> ConstitutiveState:
    """State with these values of mu and lambda (B, 2) and, if `damped`, viscosity and stiffness damping.

    The viscosity differs between the points.
    """
    batch, cells, points = len(moduli), len(engine.mesh.hexes), len(engine.quadrature.points.shape)
    own = np.zeros((batch, 4))
    own[:, :2] = moduli
    enhanced = engine.integration == "enhanced"
    hourglass = None
    if enhanced:
        elastic, viscous = (x.numpy() for x in engine.hourglass_modes.stiffness(*torch.from_numpy(moduli.T)))
        hourglass = HourglassStiffness(elastic, viscous, 3e-3 * elastic)
    if not damped:
        return ConstitutiveState(own, hourglass=hourglass)
    own[:, 2:] = [300.0, 900.0]
    return ConstitutiveState(
        own,
        random.uniform(1000.0, 4000.0, (batch, cells, points)),
        random.normal(0, 20.0, (batch, cells, points, 6)),
        random.normal(0, 0.3, (batch, len(engine.mesh.vertices), 3)),
        100.0,
        hourglass,
        random.normal(0, 0.2, (batch, cells, 12)) if enhanced else None,
    )


@ON_DEVICES
@pytest.mark.parametrize(("law", "integration", "damped"), list(product(LAWS, INTEGRATION_SCHEMES, (False, True))))
def test_both_engines_agree(
    law: str, integration: str, damped: bool, device: str, random: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Energy, gradient, exact and projected tangents, and solutions, also if cells are evaluated a few at a time."""
    q = states(random)
    moduli = np.tile([7e4, 6e5], (len(q), 1)) * np.linspace(0.5, 1.5, len(q))[:, None]
    compiled, tensors = engines(law, integration, device)
    state = constitutive(compiled, moduli, damped, random)
    x, inertia = random.normal(size=q.shape), np.repeat(random.uniform(2e3, 4e3, q.shape[:2]), 3, axis=1)
    for project in (False, True):
        energy, gradient, tangents = compiled.evaluate(q, state, tangent=True, project=project)
        whole = tensors.evaluate(q, tensors.place(state), tangent=True, project=project)
        monkeypatch.setitem(torch_engine.POINTS_AT_ONCE, device, 5 * len(q) * len(compiled.quadrature.points.shape))
        for own in (whole, tensors.evaluate(q, state, tangent=True, project=project)):
            for found, expected in (
                (energy, own[0]),
                (gradient, own[1]),
                (compiled.multiply(tangents, x), tensors.multiply(own[2], x)),
                (compiled.reactions(tangents, x), tensors.reactions(own[2], x)),
            ):
                # Rounding is largest in the projected volume term of the inverted body.
                assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()
        monkeypatch.undo()
        found, expected = (
            nodal_solution(engine, own, inertia, x) for engine, own in ((compiled, tangents), (tensors, whole[2]))
        )
        assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


def nodal_solution(
    engine: CompiledEngine | TorchEngine, tangents: Any, inertia: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Solution (B, N, 3) for a right-hand side x (B, N, 3) on the free nodes, with an inertia (B, 3 N)."""
    free = engine.free_index
    out = np.zeros((len(x), inertia.shape[1]))
    out[:, free] = engine.solve_once(tangents, inertia[:, free], x.reshape(len(x), 1, -1)[..., free])[:, 0]
    return out.reshape(x.shape)


def test_gradient_and_tangent_by_finite_differences(random: np.random.Generator) -> None:
    for law, integration in product(LAWS, INTEGRATION_SCHEMES):
        engine = CompiledEngine(MESH, law, integration, FIXED)
        q = states(random)[1:3]
        state = constitutive(engine, np.tile([7e4, 6e5], (2, 1)), True, random)
        direction = random.normal(size=q.shape)
        h = 1e-8
        forward, backward = (engine.evaluate(q + sign * h * direction, state, tangent=False) for sign in (1, -1))
        _, gradient, tangents = engine.evaluate(q, state, tangent=True)
        slope = (forward[0] - backward[0]) / (2 * h)
        np.testing.assert_allclose((gradient * direction).sum((1, 2)), slope, rtol=1e-6)
        gradient_slope = (forward[1] - backward[1]) / (2 * h)
        tangent_product = engine.multiply(tangents, direction)
        assert np.abs(tangent_product - gradient_slope).max() < 1e-6 * np.abs(gradient_slope).max()


@ON_DEVICES
@pytest.mark.parametrize("integration", INTEGRATION_SCHEMES)
def test_strains_of_both_engines_agree(integration: str, device: str, random: np.random.Generator) -> None:
    """Strains, their change along a direction by finite differences, and the adjoint as the transpose of the change."""
    compiled, tensors = engines("corotated", integration, device)
    q = states(random)[:3]
    direction = random.normal(size=q.shape)
    strain, change = compiled.strains(q, direction)
    for found, expected in zip((strain, change), tensors.strains(q, direction), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11)
    h = 1e-7
    forward, backward = (compiled.strains(q + sign * h * direction, direction)[0] for sign in (1, -1))
    np.testing.assert_allclose(change, (forward - backward) / (2 * h), rtol=1e-5, atol=1e-6)
    weights = random.normal(size=strain.shape)
    for engine in (compiled, tensors):
        adjoint = engine.strains_adjoint(q, weights)
        assert (adjoint * direction).sum() == pytest.approx((weights * change).sum(), rel=1e-10)


@ON_DEVICES
@pytest.mark.parametrize("learned", [False, True], ids=["damped", "learned"])
@pytest.mark.parametrize("integration", ["full", "selective", "enhanced"])
@pytest.mark.parametrize("integrator", ["implicit-euler", "generalised-alpha"])
def test_trajectories_and_gradients_of_both_engines_agree(
    integrator: str, integration: str, learned: bool, device: str, random: np.random.Generator
) -> None:
    """On a damped batch: positions to a relative 1e-10, gradients to a relative 1e-8."""
    material = Material(
        1.5e5,
        0.45,
        mass="lumped",
        law="yeoh" if learned else "corotated",
        integration=integration,
        viscosity=20.0,
        stiffness_damping=0.0 if learned else 2e-3,
        branch_shares=(0.1, 0.2),
        branch_times=(0.02, 0.3),
        energy_weights=tuple(random.exponential(0.3, ENERGY_UNITS)) if learned else (),
        dissipation_weights=tuple(random.exponential(0.02, VISCOSITY_UNITS)) if learned else (),
    )
    kick = torch.tensor(random.normal(0, 0.1, (2, *MESH.vertices.shape)))
    names = ("poissons_ratio", "viscosity", "branch_shares", "energy_weights", "dissipation_weights")
    found = []
    for arithmetic, own in (("compiled", "cpu"), ("torch", device)):
        simulator = Simulator(MESH, material, FIXED, integrator=integrator, arithmetic=arithmetic, device=own)
        q = torch.from_numpy(np.stack([MESH.vertices] * 2)).requires_grad_()
        values = {name: torch.tensor(getattr(material, name), dtype=torch.float64).requires_grad_() for name in names}
        values["youngs_modulus"] = torch.tensor([1e5, 2e5], dtype=torch.float64, requires_grad=True)
        start = Start(q, kick, torch.zeros_like(kick), torch.zeros(kick.shape[:2]), ("a", "b"))
        positions, _ = rollout(simulator, start, 6, parameters=simulator.parameters(**values))
        leaves = [q, *(value for value in values.values() if value.numel())]
        found.append([positions.detach(), *torch.autograd.grad((positions[-1] ** 2).sum(), leaves)])
    for number, (compiled, tensors) in enumerate(zip(*found, strict=True)):
        assert float(compiled.abs().max()) > 0
        assert float((compiled - tensors).abs().max()) < (1e-8 if number else 1e-10) * float(compiled.abs().max())


@ON_DEVICES
@pytest.mark.parametrize("integration", ["full", "enhanced"])
def test_equilibria_of_both_engines_agree(integration: str, device: str, random: np.random.Generator) -> None:
    """Under loads that need projected tangents, one of them in several steps, to 1e-9 m."""
    material = Material(1e5, 0.45, law="corotated", mass="lumped", integration=integration)
    simulator = Simulator(MESH, material, FIXED)
    tensors = Simulator(MESH, material, FIXED, arithmetic="torch", device=device)
    tip = MESH.face_nodes("x-max")
    force = np.repeat(simulator.weight[None], 3, axis=0)
    force[0, tip, 2] -= 30.0 * np.abs(simulator.weight).sum() / len(tip)
    force[1, tip, 0] -= 20.0 * np.abs(simulator.weight).sum() / len(tip)
    expected = simulator.equilibrium(force)
    assert np.abs(tensors.equilibrium(force) - expected).max() < 1e-9
    right = random.normal(size=(3, *MESH.vertices.shape, 2))
    solutions = [each.solve_tangent(expected, right) for each in (simulator, tensors)]
    assert np.abs(solutions[1] - solutions[0]).max() < 1e-8 * np.abs(solutions[0]).max()
