import numpy as np
import pytest
import torch

from rafl.common.errors import SimulationError
from rafl.data.synthetic import twisted
from rafl.fem.constitutive_state import Resistance
from rafl.fem.material import PRESETS, Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator


def beam(**keywords: object) -> Simulator:
    mesh = HexMesh.box((4, 2, 2), (0.08, 0.03, 0.03))
    return Simulator(mesh, Material(mass="lumped"), mesh.face_nodes("x-min"), **keywords)


def test_solve_tangent_inverts_the_slope_of_the_gradient(random: np.random.Generator) -> None:
    """K x = K d for a direction d that vanishes on held nodes gives back d."""
    simulator = beam()
    q = simulator.mesh.vertices + random.normal(0, 2e-4, (1, *simulator.mesh.vertices.shape))
    direction = random.normal(size=q.shape)
    direction[:, simulator.fixed] = 0.0
    h = 1e-8
    up, down = (simulator.elastic_gradient(q + sign * h * direction) for sign in (1, -1))
    slope = (up - down) / (2 * h)
    np.testing.assert_allclose(simulator.solve_tangent(q, slope), direction, rtol=1e-4, atol=1e-4)
    columns = simulator.solve_tangent(q, np.stack([slope, 2 * slope], axis=-1))
    np.testing.assert_allclose(columns[..., 1], 2 * columns[..., 0], rtol=1e-9)


def test_an_indefinite_tangent_is_solved_too(random: np.random.Generator) -> None:
    """Strong compression buckles: Cholesky fails there, the adjoint must not."""
    simulator = beam()
    q = simulator.mesh.vertices[None] * [0.5, 1.0, 1.0]
    direction = random.normal(size=q.shape)
    direction[:, simulator.fixed] = 0.0
    h = 1e-7
    up, down = (simulator.elastic_gradient(q + sign * h * direction) for sign in (1, -1))
    solved = simulator.solve_tangent(q, (up - down) / (2 * h))
    np.testing.assert_allclose(solved, direction, rtol=1e-3, atol=1e-3)


def test_equilibrium_balances_the_weight() -> None:
    """What the clamp carries is the weight of everything that hangs on it."""
    simulator = beam()
    force = simulator.weight.copy()
    force[simulator.mesh.face_nodes("x-max")] += [0.0, 0.0, -0.05]
    q = simulator.equilibrium(force[None])
    reaction = simulator.elastic_gradient(q)[0]
    free = np.setdiff1d(np.arange(len(reaction)), simulator.fixed)
    np.testing.assert_allclose(reaction[free], force[free], atol=2e-10)
    np.testing.assert_allclose(reaction[simulator.fixed].sum(0), -force[free].sum(0), atol=1e-8)
    assert q[0, -1, 2] < simulator.mesh.vertices[-1, 2]


@pytest.mark.parametrize("preset", PRESETS)
def test_a_load_that_folds_the_beam_still_balances(preset: str) -> None:
    """A tip load fifty times the beam's weight, put on at once."""
    mesh = HexMesh.box((10, 3, 3), (0.1, 0.03, 0.03))
    simulator = Simulator(mesh, Material(poissons_ratio=0.49, **PRESETS[preset]), mesh.face_nodes("x-min"))
    tip = mesh.face_nodes("x-max")
    force = simulator.weight.copy()
    force[tip, 2] -= 50.0 * np.abs(simulator.weight).sum() / len(tip)
    q = simulator.equilibrium(force[None])
    free = np.setdiff1d(np.arange(len(force)), simulator.fixed)
    np.testing.assert_allclose(simulator.elastic_gradient(q)[0][free], force[free], atol=1e-8)


def test_one_batch_is_as_good_as_one_by_one(random: np.random.Generator) -> None:
    """Each trajectory with its own forces and its own material."""
    simulator = beam()
    shape = (3, *simulator.mesh.vertices.shape)
    start = np.broadcast_to(simulator.mesh.vertices, shape).copy()
    target = start + random.normal(0, 1e-3, shape)
    force = random.normal(0, 0.02, shape)
    inertia = np.tile(simulator.node_mass / 1e-4, (3, 1))
    moduli = np.array([[5e4, 2e5, 0, 0, 0], [7e4, 3e5, 0, 0, 0], [9e4, 9e5, 0, 0, 0]])
    together = simulator.minimise(start, inertia, target, force, Resistance(moduli), "step")
    for t in range(3):
        row = slice(t, t + 1)
        alone = simulator.minimise(start[row], inertia[row], target[row], force[row], Resistance(moduli[row]), "step")
        np.testing.assert_allclose(together[row], alone, atol=1e-12)


def test_the_numbering_does_not_matter(random: np.random.Generator) -> None:
    simulator = beam()
    mesh = simulator.mesh
    order = random.permutation(len(mesh.vertices))
    place = np.argsort(order)
    shuffled = Simulator(HexMesh(mesh.vertices[order], place[mesh.hexes]), simulator.material, place[simulator.fixed])
    force = random.normal(0, 0.01, mesh.vertices.shape)
    q = simulator.equilibrium((simulator.weight + force)[None])
    other = shuffled.equilibrium((shuffled.weight + force[order])[None])
    np.testing.assert_allclose(other[0], q[0][order], atol=1e-9)


def test_a_body_turned_inside_out_recovers() -> None:
    """One corner pushed through the opposite side of its cell, let go: back to rest, and no NaN."""
    for law in ("projective", "corotated", "neo-hookean"):
        mesh = HexMesh.box((3, 2, 2), (0.03, 0.02, 0.02))
        simulator = Simulator(mesh, Material(law=law), mesh.face_nodes("x-min"), gravity=(0.0, 0.0, 0.0))
        start = mesh.vertices.copy()
        start[-1] -= [0.013, 0.004, 0.003]
        q = simulator.equilibrium(np.zeros((1, *start.shape)), start[None])
        np.testing.assert_allclose(q[0], mesh.vertices, atol=1e-8)


def test_failure_names_the_trajectory_and_the_residual() -> None:
    simulator = beam()
    force = np.stack([simulator.weight, np.full_like(simulator.weight, np.nan)])
    q = np.stack([simulator.mesh.vertices] * 2)
    inertia = np.tile(simulator.node_mass / 1e-4, (2, 1))
    with pytest.raises(SimulationError, match=r"step 4: trajectory 1 did not converge .* smaller time step"):
        simulator.minimise(q, inertia, q, force, simulator.resistance(2), "step 4")


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"integrator": "leapfrog"}, "integrator to be one of implicit-euler, generalised-alpha"),
        ({"arithmetic": "gpu"}, "arithmetic to be one of compiled, plain"),
        ({"substeps": 0}, "substeps >= 1"),
        ({"device": "cuda"}, "arithmetic to be plain on device 'cuda'"),
    ],
)
def test_unknown_settings_are_refused(keywords: dict[str, object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        beam(**keywords)


@pytest.mark.parametrize(
    "values", [{"law": "rubber"}, {"mass": "heavy"}, {"poissons_ratio": 0.5}, {"viscosity": -1.0}, {"density": 0.0}]
)
def test_unknown_materials_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Material(**values)


def test_a_twisted_beam_does_not_snap_inside_out() -> None:
    """Let go from 2.8 rad, nearly incompressible: cells stay the right way round, and the motion is smooth."""
    mesh = HexMesh.box((10, 3, 3), (0.08, 0.03, 0.03))
    simulator = Simulator(mesh, Material(263824.0, 0.499), mesh.face_nodes("x-min"))
    start = torch.from_numpy(twisted(mesh, np.array([2.77, 1.94])))
    none = torch.zeros_like(start)
    q, _ = rollout(simulator, Start(start, none, none, none[..., 0], ("a", "b")), 12)
    F = torch.einsum("tbeni,egnj->tbegij", q[:, :, mesh.hexes], torch.from_numpy(mesh.quadrature.gradient))
    assert torch.linalg.det(F).min() > 0.8
