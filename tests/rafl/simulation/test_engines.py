"""The compiled kernels against the plain tensors that specify them."""

from itertools import product

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rafl.fem.constitutive_state import Resistance
from rafl.fem.laws import LAWS
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import Compiled
from rafl.simulation.reference_engine import Plain
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

MESH = HexMesh.box((3, 2, 2), (0.06, 0.03, 0.03))
FIXED = MESH.face_nodes("x-min")


def states(random: np.random.Generator) -> np.ndarray:
    """At rest, shaken, turned, squeezed to near inversion and inside out (5, N, 3)."""
    rest = MESH.vertices
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    shaken = rest + random.normal(0, 1e-3, rest.shape)
    flat = rest * [0.06, 1.3, 1.2]
    inverted = shaken.copy()
    inverted[-1] -= [0.045, 0.0, 0.0]
    return np.stack([rest, shaken, shaken @ turn.T, flat, inverted])


def engines(law: str, integration: str) -> tuple[Compiled, Plain]:
    return Compiled(MESH, law, integration, FIXED), Plain(MESH, law, integration, FIXED)


@pytest.mark.parametrize(("law", "integration", "damped"), list(product(LAWS, ("full", "selective"), (False, True))))
def test_energy_gradient_and_tangent(law: str, integration: str, damped: bool, random: np.random.Generator) -> None:
    q = states(random)
    moduli = np.tile([7e4, 6e5, 0.0, 0.0, 0.0], (len(q), 1)) * np.linspace(0.5, 1.5, len(q))[:, None]
    compiled, plain = engines(law, integration)
    resistance = Resistance(moduli)
    if damped:
        moduli[:, 2:] = [20.0, 300.0, 900.0]
        points = compiled.integration.points.volume.shape
        strain = random.normal(0, 1.0, (len(q), *points, 6))
        resistance = Resistance(moduli, random.normal(0, 0.3, q.shape), 100.0, strain, 120.0)
    x = random.normal(size=q.shape)
    for project in (False, True):
        ours = compiled.terms(q, resistance, tangent=True, project=project)
        theirs = plain.terms(q, resistance, tangent=True, project=project)
        for mine, other in (
            (ours[0], theirs[0]),
            (ours[1], theirs[1]),
            (compiled.multiply(ours[2], x), plain.multiply(theirs[2], x)),
        ):
            # The inside-out body's projected volume term is where rounding is largest.
            assert np.abs(mine - other).max() < 1e-10 * np.abs(other).max()


def test_gradient_is_the_slope_of_the_energy_and_tangent_that_of_the_gradient(random: np.random.Generator) -> None:
    for law, integration in product(LAWS, ("full", "selective")):
        engine = Compiled(MESH, law, integration, FIXED)
        q = states(random)[1:3]
        points = engine.integration.points.volume.shape
        past = (random.normal(0, 0.3, q.shape), 100.0, random.normal(0, 1.0, (2, *points, 6)), 120.0)
        resistance = Resistance(np.tile([7e4, 6e5, 20.0, 300.0, 900.0], (2, 1)), *past)
        direction = random.normal(size=q.shape)
        h = 1e-8
        up, down = (engine.terms(q + sign * h * direction, resistance, tangent=False) for sign in (1, -1))
        _, gradient, tangents = engine.terms(q, resistance, tangent=True)
        slope = (up[0] - down[0]) / (2 * h)
        np.testing.assert_allclose((gradient * direction).sum((1, 2)), slope, rtol=1e-6)
        bend = (up[1] - down[1]) / (2 * h)
        product_ = engine.multiply(tangents, direction)
        assert np.abs(product_ - bend).max() < 1e-6 * np.abs(bend).max()


@pytest.mark.parametrize("integrator", ["implicit-euler", "generalised-alpha"])
def test_both_simulate_and_differentiate_alike(integrator: str, random: np.random.Generator) -> None:
    """Positions and gradients of a damped batch agree to 1e-10 of their size."""
    material = Material(1.5e5, 0.45, mass="lumped", law="corotated", viscosity=20.0, stiffness_damping=2e-3)
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
    (ours, by_q, _), (theirs, by_other, _) = found
    assert by_q is not None
    assert by_other is not None
    assert float((ours - theirs).abs().max()) < 1e-10 * float(theirs.abs().max())
    assert float((by_q - by_other).abs().max()) < 1e-8 * float(by_other.abs().max())
