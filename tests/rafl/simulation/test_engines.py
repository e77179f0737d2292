"""Comparison of the compiled engine with the reference engine."""

from itertools import product

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rafl.fem.constitutive_state import ConstitutiveState, HourglassStiffness
from rafl.fem.laws import LAWS
from rafl.fem.material import INTEGRATION_SCHEMES, Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import CompiledEngine
from rafl.simulation.reference_engine import ReferenceEngine
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

MESH = HexMesh.box((3, 2, 2), (0.06, 0.03, 0.03))
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


def engines(law: str, integration: str) -> tuple[CompiledEngine, ReferenceEngine]:
    return CompiledEngine(MESH, law, integration, FIXED), ReferenceEngine(MESH, law, integration, FIXED)


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


@pytest.mark.parametrize(("law", "integration", "damped"), list(product(LAWS, INTEGRATION_SCHEMES, (False, True))))
def test_compiled_and_reference_engines_agree(
    law: str, integration: str, damped: bool, random: np.random.Generator
) -> None:
    q = states(random)
    moduli = np.tile([7e4, 6e5], (len(q), 1)) * np.linspace(0.5, 1.5, len(q))[:, None]
    compiled, reference = engines(law, integration)
    state = constitutive(compiled, moduli, damped, random)
    x = random.normal(size=q.shape)
    for project in (False, True):
        compiled_values = compiled.evaluate(q, state, tangent=True, project=project)
        reference_values = reference.evaluate(q, state, tangent=True, project=project)
        for found, expected in (
            (compiled_values[0], reference_values[0]),
            (compiled_values[1], reference_values[1]),
            (compiled.multiply(compiled_values[2], x), reference.multiply(reference_values[2], x)),
        ):
            # Rounding is largest in the projected volume term of the inverted body.
            assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()


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


@pytest.mark.parametrize("integration", INTEGRATION_SCHEMES)
def test_strains_of_both_engines_agree(integration: str, random: np.random.Generator) -> None:
    """Strains, their change along a direction by finite differences, and the adjoint as the transpose of the change."""
    compiled, reference = engines("corotated", integration)
    q = states(random)[:3]
    direction = random.normal(size=q.shape)
    strain, change = compiled.strains(q, direction)
    for found, expected in zip((strain, change), reference.strains(q, direction), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11)
    h = 1e-7
    forward, backward = (compiled.strains(q + sign * h * direction, direction)[0] for sign in (1, -1))
    np.testing.assert_allclose(change, (forward - backward) / (2 * h), rtol=1e-5, atol=1e-6)
    weights = random.normal(size=strain.shape)
    for engine in (compiled, reference):
        adjoint = engine.strains_adjoint(q, weights)
        assert (adjoint * direction).sum() == pytest.approx((weights * change).sum(), rel=1e-10)


@pytest.mark.parametrize("integration", ["full", "enhanced"])
@pytest.mark.parametrize("integrator", ["implicit-euler", "generalised-alpha"])
def test_trajectories_and_gradients_of_both_engines_agree(
    integrator: str, integration: str, random: np.random.Generator
) -> None:
    """On a damped batch: positions to a relative 1e-10, gradients to a relative 1e-8."""
    material = Material(
        1.5e5,
        0.45,
        mass="lumped",
        law="corotated",
        integration=integration,
        viscosity=20.0,
        stiffness_damping=2e-3,
        branch_shares=(0.1, 0.2),
        branch_times=(0.02, 0.3),
    )
    kick = torch.tensor(random.normal(0, 0.1, (2, *MESH.vertices.shape)))
    found = []
    for arithmetic in ("compiled", "plain"):
        simulator = Simulator(MESH, material, FIXED, integrator=integrator, arithmetic=arithmetic)
        q = torch.from_numpy(np.stack([MESH.vertices] * 2)).requires_grad_()
        parameters = simulator.parameters(youngs_modulus=torch.tensor([1e5, 2e5], requires_grad=True))
        start = Start(q, kick, torch.zeros_like(kick), torch.zeros(kick.shape[:2]), ("a", "b"))
        positions, _ = rollout(simulator, start, 6, parameters=parameters)
        (positions[-1] ** 2).sum().backward()
        found.append((positions.detach(), q.grad, parameters.youngs_modulus))
    (compiled, by_q, _), (reference, by_q_reference, _) = found
    assert by_q is not None
    assert by_q_reference is not None
    assert float((compiled - reference).abs().max()) < 1e-10 * float(reference.abs().max())
    assert float((by_q - by_q_reference).abs().max()) < 1e-8 * float(by_q_reference.abs().max())
