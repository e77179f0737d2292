import numpy as np
import pytest
import torch

from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import SimulationError
from rafl.data.synthetic import twisted_shapes
from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.material import PRESETS, Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator


def beam(**keywords: object) -> Simulator:
    mesh = HexMesh.box((4, 2, 2), (0.08, 0.03, 0.03))
    return Simulator(mesh, Material(mass="lumped"), mesh.face_nodes("x-min"), **keywords)


def test_solve_tangent_inverts_the_derivative_of_the_gradient(random: np.random.Generator) -> None:
    """K x = K d gives back d, for a direction d that is zero on the fixed nodes."""
    simulator = beam()
    q = simulator.mesh.vertices + random.normal(0, 2e-4, (1, *simulator.mesh.vertices.shape))
    direction = random.normal(size=q.shape)
    direction[:, simulator.fixed] = 0.0
    h = 1e-8
    forward, backward = (simulator.elastic_gradient(q + sign * h * direction) for sign in (1, -1))
    slope = (forward - backward) / (2 * h)
    np.testing.assert_allclose(simulator.solve_tangent(q, slope), direction, rtol=1e-4, atol=1e-4)
    columns = simulator.solve_tangent(q, np.stack([slope, 2 * slope], axis=-1))
    np.testing.assert_allclose(columns[..., 1], 2 * columns[..., 0], rtol=1e-9)


def test_indefinite_tangent_is_solved(random: np.random.Generator) -> None:
    """Under strong compression the body buckles: Cholesky factorisation fails, but the adjoint solve must not."""
    simulator = beam()
    q = simulator.mesh.vertices[None] * [0.5, 1.0, 1.0]
    direction = random.normal(size=q.shape)
    direction[:, simulator.fixed] = 0.0
    h = 1e-7
    forward, backward = (simulator.elastic_gradient(q + sign * h * direction) for sign in (1, -1))
    solved = simulator.solve_tangent(q, (forward - backward) / (2 * h))
    np.testing.assert_allclose(solved, direction, rtol=1e-3, atol=1e-3)


def test_equilibrium_balances_the_weight() -> None:
    """The reaction at the clamp equals the weight of the beam and its load."""
    simulator = beam()
    force = simulator.weight.copy()
    force[simulator.mesh.face_nodes("x-max")] += [0.0, 0.0, -0.05]
    q = simulator.equilibrium(force[None])
    reaction = simulator.elastic_gradient(q)[0]
    free = np.setdiff1d(np.arange(len(reaction)), simulator.fixed)
    np.testing.assert_allclose(reaction[free], force[free], atol=2e-10)
    np.testing.assert_allclose(reaction[simulator.fixed].sum(0), -force[free].sum(0), atol=1e-8)
    assert q[0, -1, 2] < simulator.mesh.vertices[-1, 2]


@pytest.mark.parametrize("law", ["projective", "neo-hookean"])
def test_another_material_has_the_equilibrium_of_a_simulator_of_its_own(law: str) -> None:
    """It shares the engine where law and integration are the same, and only there."""
    simulator = beam()
    softer = Material(mass="lumped", law=law, youngs_modulus=0.5 * simulator.material.youngs_modulus)
    simulator.equilibrium(simulator.weight[None])
    other = simulator.with_material(softer)
    own = Simulator(simulator.mesh, softer, simulator.fixed)
    np.testing.assert_array_equal(other.equilibrium(other.weight[None]), own.equilibrium(own.weight[None]))
    assert (other.engine is simulator.engine) == (law == simulator.material.law)


@pytest.mark.parametrize("preset", PRESETS)
def test_equilibrium_under_a_load_that_folds_the_beam(preset: str) -> None:
    """Tip load of fifty times the weight of the beam, applied at once."""
    mesh = HexMesh.box((10, 3, 3), (0.1, 0.03, 0.03))
    simulator = Simulator(mesh, Material(poissons_ratio=0.49, **PRESETS[preset]), mesh.face_nodes("x-min"))
    tip = mesh.face_nodes("x-max")
    force = simulator.weight.copy()
    force[tip, 2] -= 50.0 * np.abs(simulator.weight).sum() / len(tip)
    q = simulator.equilibrium(force[None])
    free = np.setdiff1d(np.arange(len(force)), simulator.fixed)
    np.testing.assert_allclose(simulator.elastic_gradient(q)[0][free], force[free], atol=1e-8)


def test_batch_and_single_solves_agree(random: np.random.Generator) -> None:
    """Each trajectory has its own forces and material."""
    simulator = beam()
    shape = (3, *simulator.mesh.vertices.shape)
    start = np.broadcast_to(simulator.mesh.vertices, shape).copy()
    target = start + random.normal(0, 1e-3, shape)
    force = random.normal(0, 0.02, shape)
    inertia = np.tile(simulator.node_mass / 1e-4, (3, 1))
    moduli = np.array([[5e4, 2e5, 0, 0], [7e4, 3e5, 0, 0], [9e4, 9e5, 0, 0]])
    together = simulator.minimise(start, inertia, target, force, ConstitutiveState(moduli), "step")
    for t in range(3):
        row = slice(t, t + 1)
        state = ConstitutiveState(moduli[row])
        alone = simulator.minimise(start[row], inertia[row], target[row], force[row], state, "step")
        np.testing.assert_allclose(together[row], alone, atol=1e-12)


def test_result_does_not_depend_on_node_numbering(random: np.random.Generator) -> None:
    simulator = beam()
    mesh = simulator.mesh
    order = random.permutation(len(mesh.vertices))
    new_index = np.argsort(order)
    shuffled = Simulator(
        HexMesh(mesh.vertices[order], new_index[mesh.hexes]), simulator.material, new_index[simulator.fixed]
    )
    force = random.normal(0, 0.01, mesh.vertices.shape)
    q = simulator.equilibrium((simulator.weight + force)[None])
    other = shuffled.equilibrium((shuffled.weight + force[order])[None])
    np.testing.assert_allclose(other[0], q[0][order], atol=1e-9)


def test_inverted_body_recovers() -> None:
    """A corner moved through the opposite side of its cell and released returns to rest, without NaN."""
    for law in ("projective", "corotated", "neo-hookean"):
        mesh = HexMesh.box((3, 2, 2), (0.03, 0.02, 0.02))
        simulator = Simulator(mesh, Material(law=law), mesh.face_nodes("x-min"), gravity=(0.0, 0.0, 0.0))
        start = mesh.vertices.copy()
        start[-1] -= [0.013, 0.004, 0.003]
        q = simulator.equilibrium(np.zeros((1, *start.shape)), start[None])
        np.testing.assert_allclose(q[0], mesh.vertices, atol=1e-8)


def test_failed_solve_names_trajectory_and_remedy() -> None:
    simulator = beam()
    force = np.stack([simulator.weight, np.full_like(simulator.weight, np.nan)])
    q = np.stack([simulator.mesh.vertices] * 2)
    inertia = np.tile(simulator.node_mass / 1e-4, (2, 1))
    with pytest.raises(SimulationError, match=r"step 4: trajectory 1 did not converge .* smaller time step"):
        simulator.minimise(q, inertia, q, force, simulator.constitutive_state(2), "step 4")


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"integrator": "leapfrog"}, "integrator to be one of implicit-euler, generalised-alpha"),
        ({"arithmetic": "gpu"}, "arithmetic to be one of compiled, torch"),
        ({"substeps": 0}, "substeps >= 1"),
        ({"device": "cuda"}, "arithmetic to be torch on device 'cuda'"),
    ],
)
def test_unknown_settings_are_rejected(keywords: dict[str, object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        beam(**keywords)


@pytest.mark.parametrize(
    "values", [{"law": "rubber"}, {"mass": "heavy"}, {"poissons_ratio": 0.5}, {"viscosity": -1.0}, {"density": 0.0}]
)
def test_invalid_materials_are_rejected(values: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Material(**values)


def test_released_twisted_beam_does_not_invert() -> None:
    """Nearly incompressible beam released from a twist of 2.8 rad: det F stays positive in every cell."""
    mesh = HexMesh.box((10, 3, 3), (0.08, 0.03, 0.03))
    simulator = Simulator(mesh, Material(263824.0, 0.499), mesh.face_nodes("x-min"))
    start = torch.from_numpy(twisted_shapes(mesh, np.array([2.77, 1.94])))
    none = torch.zeros_like(start)
    q, _ = rollout(simulator, Start(start, none, none, none[..., 0], ("a", "b")), 12)
    F = torch.einsum("tbeni,egnj->tbegij", q[:, :, mesh.hexes], torch.from_numpy(mesh.quadrature.gradient))
    assert torch.linalg.det(F).min() > 0.8


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("youngs_modulus", -1.0),
        ("youngs_modulus", float("nan")),
        ("youngs_modulus", [1e5, 0.0]),
        ("poissons_ratio", 0.5),
        ("density", float("inf")),
        ("viscosity", -1e-9),
        ("gravity", [0.0, float("nan"), 0.0]),
        ("stiffness", 1e5),
    ],
)
def test_parameters_outside_their_range_are_refused(small_specimen: Specimen, key: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"expected .*{key}"):
        small_specimen.simulator(0.01).parameters(**{key: value})
