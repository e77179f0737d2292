"""Standard problems of element accuracy, linear, with each integration scheme.

Source of most: MacNeal and Harder, A Proposed Standard Set of Problems to Test Finite Element Accuracy (1985). Results
are normalised: 1 is exact, less is too stiff.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import pytest
import skfem
from scipy.sparse import bmat, csr_array
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, div, sym_grad

from rafl.fem.material import INTEGRATION_SCHEMES, Material, lame
from rafl.fem.mesh import CORNERS, HexMesh
from rafl.simulation.simulator import Simulator

# Smallest and largest normalised result of each scheme. `full` and `selective` lock in bending with one cell across,
# and `full` when nearly incompressible.
LOCKED = (0.0, 0.3)
COOK = {"full": (0.3, 0.4), "selective": (0.93, 0.95), "enhanced": (0.94, 1.01)}
CYLINDER = {"full": (0.3, 0.4), "selective": (0.98, 1.0), "enhanced": (0.98, 1.005)}
CURVED_BEAM = {"full": LOCKED, "selective": LOCKED, "enhanced": (0.97, 1.02)}
STRAIGHT_BEAM = {"full": LOCKED, "selective": LOCKED, "enhanced": (0.965, 1.02)}

by_scheme = pytest.mark.parametrize("scheme", INTEGRATION_SCHEMES)

# Inner nodes of MacNeal and Harder's patch, in the node order of a cell.
PATCH_NODES = [
    (0.249, 0.342, 0.192),
    (0.320, 0.186, 0.643),
    (0.273, 0.750, 0.230),
    (0.165, 0.745, 0.702),
    (0.826, 0.288, 0.288),
    (0.677, 0.305, 0.683),
    (0.850, 0.649, 0.263),
    (0.788, 0.693, 0.644),
]
PATCH_STRAIN = 1e-3 * np.array([[1.0, 0.5, 0.5], [0.5, 1.0, 0.5], [0.5, 0.5, 1.0]])


@dataclass(frozen=True)
class LinearBody:
    """A mesh with a linear material, which can be held in single directions.

    Attributes:
        mesh: the rest shape.
        scheme: of integration.
        youngs_modulus, poissons_ratio: of the material.
    """

    mesh: HexMesh
    scheme: str
    youngs_modulus: float
    poissons_ratio: float

    @cached_property
    def stiffness(self) -> csr_array:
        """Tangent at rest, of the unknowns 3 * vertex + component."""
        material = Material(
            self.youngs_modulus, self.poissons_ratio, mass="lumped", law="neo-hookean", integration=self.scheme
        )
        simulator = Simulator(self.mesh, material, np.zeros(0, dtype=np.int64))
        q = self.mesh.vertices[None]
        tangents = simulator.engine.evaluate(q, simulator.constitutive_state(1), tangent=True)[2]
        unknowns = simulator.engine.linear_solver.unknowns
        position = np.argsort(unknowns.free_index)
        return unknowns.sparse_matrix(tangents[0], np.zeros(unknowns.count))[position][:, position]

    def displacement(self, force: np.ndarray, held: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
        """Displacements (N, 3) under forces (N, 3); where `held` (N, 3) is true, they are 0 or those of `at` (N, 3)."""
        u = np.zeros(force.size) if at is None else np.where(held, at, 0.0).ravel()
        free = np.flatnonzero(~held.ravel())
        right = (force.ravel() - self.stiffness @ u)[free]
        u[free] = splu(self.stiffness[free][:, free].tocsc()).solve(right)
        return u.reshape(-1, 3)


def quad_forces(mesh: HexMesh, nodes: np.ndarray, traction: np.ndarray | None, pressure: float = 0.0) -> np.ndarray:
    """Consistent nodal forces (N, 3) of a traction (3) and a pressure on the boundary quads between some nodes."""
    quads = mesh.surface[np.isin(mesh.surface, nodes).all(axis=1)]
    corners = mesh.vertices[quads]  # (S, 4, 3)
    force = np.zeros_like(mesh.vertices)
    for r in 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0):
        for s in 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0):
            shape = np.array([(1 - r) * (1 - s), r * (1 - s), r * s, (1 - r) * s])
            along = np.array([[-(1 - s), 1 - s, s, -s], [-(1 - r), -r, r, 1 - r]])
            first, second = np.einsum("dn,sni->dsi", along, corners)
            normal = 0.25 * np.cross(first, second)
            load = -pressure * normal
            if traction is not None:
                load = load + traction * np.linalg.norm(normal, axis=1)[:, None]
            np.add.at(force, quads, shape[:, None] * load[:, None])
    return force


def seven_cells() -> HexMesh:
    """The unit cube divided into a distorted inner cell and the six cells between it and the sides."""
    vertices = np.concatenate([CORNERS, PATCH_NODES])
    hexes = [np.arange(8, 16)]
    bits = CORNERS.astype(int)
    for axis in range(3):
        for side in (0, 1):
            corner = bits.copy()
            corner[:, axis] = side
            hexes.append(corner @ [4, 2, 1] + np.where(bits[:, axis] == side, 0, 8))
    return HexMesh(vertices, np.array(hexes))


@by_scheme
@pytest.mark.parametrize("nu", [0.25, 0.4999])
def test_patch_with_prescribed_displacements(scheme: str, nu: float) -> None:
    """The sides follow a constant strain: so do the inner nodes, and the mean stress is that of Hooke's law."""
    mesh = seven_cells()
    body = LinearBody(mesh, scheme, 1e6, nu)
    exact = mesh.vertices @ PATCH_STRAIN
    held = np.zeros_like(exact, dtype=bool)
    held[:8] = True
    u = body.displacement(np.zeros_like(exact), held, exact)
    np.testing.assert_allclose(u, exact, atol=1e-12)
    forces = (body.stiffness @ u.ravel()).reshape(-1, 3)
    mu, lam = lame(1e6, nu)
    stress = 2 * mu * PATCH_STRAIN + lam * np.trace(PATCH_STRAIN) * np.eye(3)
    np.testing.assert_allclose(mesh.vertices.T @ forces, stress, rtol=1e-8, atol=1e-8 * stress.max())


@by_scheme
@pytest.mark.parametrize("nu", [0.25, 0.4999])
def test_patch_with_prescribed_tractions(scheme: str, nu: float) -> None:
    """Tractions of a constant stress on the sides, with six components held: all nodes follow the constant strain."""
    mesh = seven_cells()
    mu, lam = lame(1e6, nu)
    stress = 2 * mu * PATCH_STRAIN + lam * np.trace(PATCH_STRAIN) * np.eye(3)
    force = np.zeros_like(mesh.vertices)
    for axis in range(3):
        for side, face in enumerate(("min", "max")):
            traction = (2 * side - 1) * stress[axis]
            force += quad_forces(mesh, mesh.face_nodes(f"{'xyz'[axis]}-{face}"), traction)
    held = np.zeros_like(force, dtype=bool)
    held[0] = True  # the corners on the axes z, y, x
    held[1, :2] = held[2, 0] = True
    exact = mesh.vertices @ PATCH_STRAIN
    u = LinearBody(mesh, scheme, 1e6, nu).displacement(force, held, exact)
    np.testing.assert_allclose(u, exact, atol=1e-11)


def cook_mesh(cells: int) -> HexMesh:
    """Cook's tapered panel, 48 long, 44 high where clamped and 16 where loaded, one cell thick."""
    box = HexMesh.box((cells, cells, 1), (1.0, 1.0, 1.0))
    x, y, z = box.vertices.T
    return HexMesh(np.stack([48 * x, 44 * x + y * (44 - 28 * x), z], axis=1), box.hexes)


@cache
def cook_reference(nu: float, cells: int = 32) -> float:
    """Mean rise of the loaded edge in plane strain, E = 1, load 1: Taylor-Hood elements of scikit-fem."""
    mu, lam = lame(1.0, nu)
    square = skfem.MeshQuad.init_tensor(*[np.linspace(0, 1, cells + 1)] * 2)
    x, y = square.p
    mesh = skfem.MeshQuad(np.stack([48 * x, 44 * x + y * (44 - 28 * x)]), square.t)
    motion = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=5)
    pressure = motion.with_element(skfem.ElementQuad1())
    K = skfem.BilinearForm(lambda u, v, _: 2 * mu * ddot(sym_grad(u), sym_grad(v))).assemble(motion)
    B = skfem.BilinearForm(lambda u, p, _: div(u) * p).assemble(motion, pressure)
    M = skfem.BilinearForm(lambda p, q, _: p * q / lam).assemble(pressure)
    edge = skfem.FacetBasis(mesh, motion.elem, facets=mesh.facets_satisfying(lambda x: x[0] > 48 - 1e-9))
    load = skfem.LinearForm(lambda v, _: v[1] / 16).assemble(edge)
    fixed = motion.get_dofs(lambda x: x[0] < 1e-9).all()
    system = bmat([[K, B.T], [B, -M]], "csc")
    right = np.concatenate([load, np.zeros(M.shape[0])])
    return float(right @ skfem.solve(*skfem.condense(system, right, D=fixed)))


def cook(scheme: str, cells: int, nu: float = 0.499) -> float:
    """Cook's panel in plane strain: mean rise of the loaded edge, normalised."""
    mesh = cook_mesh(cells)
    loaded = mesh.face_nodes("x-max")
    force = quad_forces(mesh, loaded, np.array([0.0, 1.0 / 16.0, 0.0]))
    held = np.zeros_like(force, dtype=bool)
    held[:, 2] = True
    held[mesh.face_nodes("x-min")] = True
    u = LinearBody(mesh, scheme, 1.0, nu).displacement(force, held)
    return float((force * u).sum()) / cook_reference(nu)


@by_scheme
def test_cooks_panel(scheme: str) -> None:
    """Skewed cells under bending and shear, nearly incompressible: 8 x 8 cells beside converged elements."""
    low, high = COOK[scheme]
    assert low < cook(scheme, 8) < high


def cylinder(scheme: str, nu: float) -> float:
    """Thick cylinder, radii 3 and 9, inner pressure 1, E = 1000, plane strain: widening of the bore, normalised.

    A quarter of nine sectors and five rings. Lame: u(a) = (1 + nu) a p / E (b^2 + (1 - 2 nu) a^2) / (b^2 - a^2).
    """
    box = HexMesh.box((5, 9, 1), (5.0, 0.5 * np.pi, 1.0))
    radius = np.interp(box.vertices[:, 0], np.arange(6), [3.0, 3.5, 4.2, 5.2, 6.75, 9.0])
    angle = box.vertices[:, 1]
    mesh = HexMesh(np.stack([radius * np.cos(angle), radius * np.sin(angle), box.vertices[:, 2]], axis=1), box.hexes)
    bore = box.face_nodes("x-min")
    force = quad_forces(mesh, bore, None, pressure=1.0)
    held = np.zeros_like(force, dtype=bool)
    held[:, 2] = True
    held[box.face_nodes("y-min"), 1] = True
    held[box.face_nodes("y-max"), 0] = True
    u = LinearBody(mesh, scheme, 1000.0, nu).displacement(force, held)
    widening = np.linalg.norm(u[bore], axis=1).mean()
    exact = (1 + nu) * 3.0 / 1000.0 * (81.0 + (1 - 2 * nu) * 9.0) / (81.0 - 9.0)
    return float(widening / exact)


@by_scheme
def test_thick_cylinder(scheme: str) -> None:
    """Exact solution of Lame, nearly incompressible."""
    low, high = CYLINDER[scheme]
    assert low < cylinder(scheme, 0.499) < high


def curved_beam(scheme: str, cells: int) -> float:
    """Quarter ring, radii 4.12 and 4.32, 0.1 thick, E = 1e7, nu = 0.25, radial unit load at its end, normalised.

    Exact: P pi (a^2 + b^2) / (E t (a^2 - b^2 + (a^2 + b^2) ln(b / a))) = 0.0886 (Timoshenko and Goodier, Theory of
    Elasticity, section 33); MacNeal and Harder give 0.08734.
    """
    box = HexMesh.box((cells, 1, 1), (0.5 * np.pi, 0.2, 0.1))
    angle, radius = box.vertices[:, 0], 4.12 + box.vertices[:, 1]
    mesh = HexMesh(np.stack([radius * np.sin(angle), radius * np.cos(angle), box.vertices[:, 2]], axis=1), box.hexes)
    force = quad_forces(mesh, box.face_nodes("x-max"), np.array([1.0 / (0.2 * 0.1), 0.0, 0.0]))
    held = np.zeros_like(force, dtype=bool)
    held[box.face_nodes("x-min")] = True
    u = LinearBody(mesh, scheme, 1e7, 0.25).displacement(force, held)
    a, b = 4.12, 4.32
    sum_ = a**2 + b**2
    exact = np.pi * sum_ / (1e7 * 0.1 * (a**2 - b**2 + sum_ * np.log(b / a)))
    return float((force * u).sum()) / exact


@by_scheme
def test_curved_beam(scheme: str) -> None:
    """Twelve cells along a quarter ring, one across."""
    low, high = CURVED_BEAM[scheme]
    assert low < curved_beam(scheme, 12) < high


def straight_beam(scheme: str, slant: float, parallel: bool, axis: int) -> float:
    """MacNeal and Harder's beam, 6 x 0.2 x 0.1, six cells, E = 1e7, nu = 0.3, unit load at its end, normalised.

    Args:
        scheme: of integration.
        slant: of the planes between the cells: their shift at y = 0 and y = 0.2 [cell lengths].
        parallel: whether all planes slant alike, for parallelograms, or in turn, for trapezia.
        axis: direction of the load. Exact deflections: 0.1081 along y, 0.4321 along z.
    """
    mesh = HexMesh.box((6, 1, 1), (6.0, 0.2, 0.1))
    x, y, z = mesh.vertices.T
    inner = (x > 0.5) & (x < 5.5)
    sign = np.ones_like(x) if parallel else (-1.0) ** np.rint(x)
    mesh = HexMesh(np.stack([x + np.where(inner, slant * sign * (1.0 - 10.0 * y), 0.0), y, z], axis=1), mesh.hexes)
    traction = np.zeros(3)
    traction[axis] = 1.0 / (0.2 * 0.1)
    force = quad_forces(mesh, mesh.face_nodes("x-max"), traction)
    held = np.zeros_like(force, dtype=bool)
    held[mesh.face_nodes("x-min")] = True
    u = LinearBody(mesh, scheme, 1e7, 0.3).displacement(force, held)
    return float((force * u).sum()) / (0.1081 if axis == 1 else 0.4321)


@by_scheme
@pytest.mark.parametrize("axis", [1, 2])
def test_straight_beam(scheme: str, axis: int) -> None:
    """Rectangular cells, one across."""
    low, high = STRAIGHT_BEAM[scheme]
    assert low < straight_beam(scheme, 0.0, True, axis) < high


@by_scheme
@pytest.mark.parametrize("parallel", [True, False], ids=["parallelograms", "trapezia"])
def test_straight_beam_of_slanted_cells(
    scheme: str, parallel: bool, record_property: Callable[[str, object], None]
) -> None:
    """Cells slanted by 45 degrees lock with every trilinear element; the results are recorded, and never too soft."""
    for axis in (1, 2):
        result = straight_beam(scheme, 0.1, parallel, axis)
        record_property(f"deflection along {'xyz'[axis]}", round(result, 4))
        assert 0.0 < result < 1.01
