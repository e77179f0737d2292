import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rafl.material import Material
from rafl.mesh import HexMesh
from rafl.simulator import SimulationError, Simulator

MU, LAM = np.array([7e4]), np.array([3e5])


def beam(fixed: bool = True, **keywords: object) -> Simulator:
    mesh = HexMesh.box((4, 2, 2), (0.08, 0.03, 0.03))
    held = mesh.face_nodes("x-min") if fixed else np.zeros(0, dtype=np.int64)
    return Simulator(mesh, Material(mass="lumped"), held, **keywords)  # type: ignore[arg-type]


def shaken(simulator: Simulator, random: np.random.Generator, size: float = 2e-3) -> np.ndarray:
    q = simulator.mesh.vertices + random.normal(0, size, simulator.mesh.vertices.shape)
    q[simulator.fixed] = simulator.mesh.vertices[simulator.fixed]
    return q[None]


def slope_of_gradient(simulator: Simulator, q: np.ndarray, direction: np.ndarray, h: float = 1e-6) -> np.ndarray:
    up, down = (simulator.elastic_gradient(q + sign * h * direction, MU, LAM) for sign in (1, -1))
    return (up - down) / (2 * h)


def test_no_force_under_rigid_motion_and_equivariance(random: np.random.Generator) -> None:
    simulator = beam()
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    moved = simulator.mesh.vertices @ turn.T + [0.1, -0.2, 0.3]
    assert np.abs(simulator.elastic_gradient(moved[None], MU, LAM)).max() < 1e-10
    q = shaken(simulator, random)
    gradient = simulator.elastic_gradient(q, MU, LAM)
    np.testing.assert_allclose(simulator.elastic_gradient(q @ turn.T, MU, LAM), gradient @ turn.T, atol=1e-10)


def test_gradient_is_the_slope_of_the_energy(random: np.random.Generator) -> None:
    simulator = beam()
    q = shaken(simulator, random)
    direction = random.normal(size=q.shape)
    h = 1e-7

    def energy(at: np.ndarray) -> float:
        return float(simulator._terms(at, MU, LAM, project=False, tangent=False)[0][0])

    slope = (energy(q + h * direction) - energy(q - h * direction)) / (2 * h)
    assert (simulator.elastic_gradient(q, MU, LAM) * direction).sum() == pytest.approx(slope, rel=1e-6)


def test_tangent_solve_inverts_the_slope_of_the_gradient(random: np.random.Generator) -> None:
    """(K + m) x = K d + m d for a direction d that vanishes on held nodes gives back d."""
    simulator = beam()
    q = shaken(simulator, random)
    direction = random.normal(size=q.shape)
    direction[:, simulator.fixed] = 0.0
    slope = slope_of_gradient(simulator, q, direction)
    inertia = np.full(q.shape[:2], 50.0)
    right = slope + inertia[..., None] * direction
    np.testing.assert_allclose(
        simulator.tangent_solve(simulator.tangent(q, MU, LAM), inertia, right),
        direction,
        rtol=1e-5,
        atol=1e-5,
    )


def test_an_indefinite_tangent_is_solved_too(random: np.random.Generator) -> None:
    """Strong compression buckles: Cholesky fails there, the adjoint must not."""
    simulator = beam()
    q = simulator.mesh.vertices[None] * [0.5, 1.0, 1.0]
    direction = random.normal(size=q.shape)
    direction[:, simulator.fixed] = 0.0
    slope = slope_of_gradient(simulator, q, direction)
    solved = simulator.tangent_solve(simulator.tangent(q, MU, LAM), np.zeros(q.shape[:2]), slope)
    np.testing.assert_allclose(solved, direction, rtol=1e-3, atol=1e-3)


def test_a_free_body_keeps_its_momentum(random: np.random.Generator) -> None:
    simulator = beam(fixed=False)
    mass = simulator.node_mass[None]
    q, v = shaken(simulator, random), random.normal(0, 0.3, (1, len(mass[0]), 3))
    momentum = (mass[..., None] * v).sum(axis=(0, 1))
    for _ in range(5):
        after = simulator.step(q, v, np.zeros_like(q), MU, LAM, mass)
        q, v = after, (after - q) / simulator.time_step
    np.testing.assert_allclose((mass[..., None] * v).sum(axis=(0, 1)), momentum, atol=1e-8)


def test_free_fall_is_exact_for_implicit_euler() -> None:
    """After n steps from rest q = g dt^2 n (n + 1) / 2."""
    simulator = beam(fixed=False)
    q = simulator.mesh.vertices[None].copy()
    v = np.zeros_like(q)
    for _ in range(10):
        after = simulator.step(q, v, simulator.weight[None], MU, LAM, simulator.node_mass[None])
        q, v = after, (after - q) / simulator.time_step
    fallen = np.array(simulator.gravity) * simulator.time_step**2 * 55
    np.testing.assert_allclose(q[0] - simulator.mesh.vertices, np.broadcast_to(fallen, q[0].shape), atol=1e-9)


def test_equilibrium_balances_the_weight() -> None:
    """What the clamp carries is the weight of everything that hangs on it."""
    simulator = beam()
    force = simulator.weight.copy()
    force[simulator.mesh.face_nodes("x-max")] += [0.0, 0.0, -0.05]
    q = simulator.equilibrium(force[None])
    mu, lam = (np.full(1, value) for value in simulator.material.lame)
    reaction = simulator.elastic_gradient(q, mu, lam)[0]
    free = np.setdiff1d(np.arange(len(reaction)), simulator.fixed)
    np.testing.assert_allclose(reaction[free], force[free], atol=2e-9)
    np.testing.assert_allclose(reaction[simulator.fixed].sum(0), -force[free].sum(0), atol=1e-7)
    assert q[0, -1, 2] < simulator.mesh.vertices[-1, 2]


def test_one_batch_is_as_good_as_one_by_one(random: np.random.Generator) -> None:
    simulator = beam()
    q = np.concatenate([shaken(simulator, random) for _ in range(3)])
    v = random.normal(0, 0.1, q.shape)
    force = np.stack([simulator.weight] * 3)
    mu, lam = np.array([5e4, 7e4, 9e4]), np.array([2e5, 3e5, 9e5])
    mass = np.stack([simulator.node_mass] * 3)
    together = simulator.step(q, v, force, mu, lam, mass)
    for t in range(3):
        row = slice(t, t + 1)
        alone = simulator.step(q[row], v[row], force[row], mu[row], lam[row], mass[row])
        np.testing.assert_allclose(together[row], alone, atol=1e-11)


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


def test_failure_names_the_trajectory_and_the_residual() -> None:
    simulator = beam()
    force = np.stack([simulator.weight, np.full_like(simulator.weight, np.nan)])
    q = np.stack([simulator.mesh.vertices] * 2)
    mass = np.stack([simulator.node_mass] * 2)
    with pytest.raises(SimulationError, match=r"step: trajectory 1 did not converge .* smaller time step"):
        simulator.step(q, np.zeros_like(q), force, np.repeat(MU, 2), np.repeat(LAM, 2), mass)
