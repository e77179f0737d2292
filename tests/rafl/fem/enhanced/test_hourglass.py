"""Cells with stabilised hourglass modes: rank, bending, stability, and the cut of the first layer of cells."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rafl.fem.enhanced.hourglass import HourglassModes
from rafl.fem.laws import LAWS
from rafl.fem.material import Material, lame
from rafl.fem.mesh import HexMesh
from rafl.simulation.simulator import Simulator

NO_GRAVITY = (0.0, 0.0, 0.0)
SIDES = np.array([0.01, 0.02, 0.015])
BRICK = HexMesh.box((1, 1, 1), SIDES)


def distorted(mesh: HexMesh, random: np.random.Generator, size: float = 2e-3) -> HexMesh:
    return HexMesh(mesh.vertices + random.uniform(-size, size, mesh.vertices.shape), mesh.hexes)


def dense_tangent(simulator: Simulator, q: np.ndarray) -> np.ndarray:
    """Tangent on all nodes [N/m], (3 N, 3 N)."""
    engine, count = simulator.engine, q.size
    tangents = engine.evaluate(q[None], simulator.constitutive_state(1), tangent=True)[2]
    columns = [engine.multiply(tangents, column.reshape(1, -1, 3)).ravel() for column in np.eye(count)]
    return np.array(columns).T


def free_simulator(mesh: HexMesh, nu: float, law: str = "corotated") -> Simulator:
    material = Material(1e5, nu, mass="lumped", law=law, integration="enhanced")
    return Simulator(mesh, material, np.array([], dtype=np.int64), gravity=NO_GRAVITY)


@pytest.mark.parametrize("nu", [0.0, 0.45, 0.4999])
def test_exactly_six_modes_without_energy(nu: float, random: np.random.Generator) -> None:
    """At rest, and turned and distorted: rigid motions only."""
    for mesh in (BRICK, distorted(BRICK, random)):
        values = np.linalg.eigvalsh(dense_tangent(free_simulator(mesh, nu), mesh.vertices))
        scale = 1e5 * SIDES.min()
        assert (np.abs(values[:6]) < 1e-10 * values[-1]).all()
        assert values[6] > 1e-3 * scale


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.499])
@pytest.mark.parametrize(("along", "across"), [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)])
def test_a_brick_bends_like_a_beam(nu: float, along: int, across: int) -> None:
    """Displacements linear in both directions: energy E I kappa^2 L / 2 of a beam, at every Poisson's ratio.

    Curvature kappa: the displacement along the beam is -kappa x z; its nodal values need no others, because the
    incompatible modes supply the deflection.
    """
    kappa = 1e-4
    centred = BRICK.vertices - 0.5 * SIDES
    u = np.zeros_like(centred)
    u[:, along] = kappa * centred[:, along] * centred[:, across]
    simulator = free_simulator(BRICK, nu)
    energy = simulator.engine.evaluate((BRICK.vertices + u)[None], simulator.constitutive_state(1), tangent=False)[0][0]
    length, height = SIDES[along], SIDES[across]
    width = SIDES[3 - along - across]
    expected = 0.5 * 1e5 * width * height**3 / 12 * kappa**2 * length
    assert energy == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("law", LAWS)
def test_affine_motions_are_exact_on_distorted_cells(law: str, random: np.random.Generator) -> None:
    """Patch test: the forces on inner nodes vanish, and the energy is that of the deformation gradient."""
    box = HexMesh.box((2, 2, 2), (0.02, 0.03, 0.02))
    inner = np.setdiff1d(np.arange(27), np.unique(box.surface))
    vertices = box.vertices.copy()
    vertices[inner] += random.uniform(-2e-3, 2e-3, (len(inner), 3))
    mesh = HexMesh(vertices, box.hexes)
    F = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix() @ np.array(
        [[1.1, 0.1, 0.0], [0.0, 0.95, 0.05], [0, 0, 1.02]]
    )
    energies = []
    for each in (mesh, box):
        simulator = free_simulator(each, 0.4, law)
        energy, gradient, _ = simulator.engine.evaluate(
            (each.vertices @ F.T)[None], simulator.constitutive_state(1), tangent=False
        )
        energies.append(energy[0])
        assert np.abs(gradient[0, inner]).max() < 1e-10 * np.abs(gradient).max()
    assert energies[0] == pytest.approx(energies[1], rel=1e-12)


def test_energy_does_not_depend_on_the_frame(random: np.random.Generator) -> None:
    simulator = free_simulator(distorted(BRICK, random), 0.45, "neo-hookean")
    q = BRICK.vertices + random.normal(0, 2e-3, BRICK.vertices.shape)
    turn = Rotation.from_rotvec([1.0, -2.0, 0.7]).as_matrix()
    state = simulator.constitutive_state(1)
    energies = [
        simulator.engine.evaluate(x[None], state, tangent=False)[0][0] for x in (q, q @ turn.T + [0.1, 0.2, -0.3])
    ]
    assert energies[0] == pytest.approx(energies[1], rel=1e-12)


@pytest.mark.parametrize("nu", [0.3, 0.499])
@pytest.mark.parametrize("law", ["corotated", "neo-hookean"])
def test_no_hourglass_mode_becomes_unstable_under_compression(law: str, nu: float) -> None:
    """A block pressed to 60 % of its height between plates, sides free to slip: no inner motion lowers the energy.

    The nodes of the plates move along the plates only; the tangent on the free unknowns is positive definite, apart
    from rigid motions along and about the axis of compression.
    """
    mesh = HexMesh.box((3, 3, 3), (0.03, 0.03, 0.03))
    lateral = 1.0 / np.sqrt(0.6) if nu > 0.49 else 0.6**-nu
    simulator = free_simulator(mesh, nu, law)
    q = mesh.vertices * [lateral, lateral, 0.6]
    free = np.ones((64, 3), dtype=bool)
    for face in ("z-min", "z-max"):
        free[mesh.face_nodes(face), 2] = False
    index = np.flatnonzero(free.ravel())
    values = np.linalg.eigvalsh(dense_tangent(simulator, q)[np.ix_(index, index)])
    assert (np.abs(values[:2]) < 1e-6 * values[-1]).all()  # slides along the plates
    assert values[3] > 1e-5 * values[-1]


def test_large_bending_and_twist_converge() -> None:
    """A beam bent by 120 degrees, and one twisted by 2.6 rad, by turning the tip's cross-section in one go."""
    mesh = HexMesh.box((10, 3, 3), (0.1, 0.03, 0.03))
    fixed = np.union1d(mesh.face_nodes("x-min"), mesh.face_nodes("x-max"))
    tip = mesh.face_nodes("x-max")
    material = Material(1.3e5, 0.49, mass="lumped", law="neo-hookean", integration="enhanced")
    simulator = Simulator(mesh, material, fixed, gravity=NO_GRAVITY)
    no_force = np.zeros((1, len(mesh.vertices), 3))
    for kind in ("bent", "twisted"):
        start = mesh.vertices[None].copy()
        across = mesh.vertices[tip] - [0.1, 0.015, 0.015]
        if kind == "bent":
            angle = np.deg2rad(120)
            turned = across @ Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix().T
            radius = 0.1 / angle
            start[0, tip] = turned + np.array([radius * np.sin(angle), 0.015, 0.015 - radius * (1 - np.cos(angle))])
        else:
            start[0, tip] = across @ Rotation.from_rotvec([2.6, 0.0, 0.0]).as_matrix().T + [0.1, 0.015, 0.015]
        q = simulator.equilibrium(no_force, start)
        F = np.einsum("beni,enj->beij", q[:, mesh.hexes], mesh.mean_quadrature.gradient[:, 0])
        assert np.linalg.det(F).min() > 0.9
        gradient = simulator.elastic_gradient(q)
        free = np.setdiff1d(np.arange(len(mesh.vertices)), fixed)
        assert np.abs(gradient[0, free]).max() < 1e-6


def test_derivative_by_mu_is_that_of_the_stiffness() -> None:
    """K is of first degree in mu and lambda: the derivatives by both add up to it, and finite differences agree."""
    modes = HourglassModes(BRICK)
    mu, lam = (torch.tensor([x], dtype=torch.float64) for x in lame(1e5, 0.45))
    stiffness, by_mu = modes.stiffness(mu, lam)
    h = 1e-3 * mu
    difference = (modes.stiffness(mu + h, lam)[0] - modes.stiffness(mu - h, lam)[0]) / (2 * h)
    torch.testing.assert_close(by_mu, difference, rtol=1e-5, atol=1e-8)
    by_lambda = (modes.stiffness(mu, lam + h)[0] - modes.stiffness(mu, lam - h)[0]) / (2 * h)
    torch.testing.assert_close(mu * by_mu + lam * by_lambda, stiffness, rtol=1e-5, atol=1e-4)


def test_split_layer_cuts_the_cells_at_a_face() -> None:
    """Volume and outline stay; there is one more layer of nodes, 30 % into the first cells, and the order is kept."""
    grid = np.ones((4, 3, 2), dtype=bool)
    grid[2:, 0] = False
    mesh = HexMesh.from_grid(grid, 0.01)
    for face, axis, place in (("x-min", 0, 0.003), ("y-max", 1, 0.03 - 0.003), ("z-min", 2, 0.003)):
        nodes = mesh.face_nodes(face)
        cut = mesh.split_layer(nodes, 0.3)
        assert cut.volumes.sum() == pytest.approx(mesh.volumes.sum())
        assert len(cut.vertices) == len(mesh.vertices) + len(nodes)
        assert (np.abs(cut.vertices[:, axis] - place) < 1e-12).sum() == len(nodes)
        keys = np.round(cut.vertices * 1e6).astype(int).tolist()
        assert keys == sorted(keys)
    with pytest.raises(ValueError, match="between 0 and 1"):
        mesh.split_layer(mesh.face_nodes("x-min"), 1.0)
    with pytest.raises(ValueError, match="cut at the nodes alike"):
        mesh.split_layer(mesh.hexes[0][[0, 1, 2, 3]], 0.5)
