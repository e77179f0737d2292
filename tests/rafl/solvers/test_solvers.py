import numpy as np
import pytest

from rafl.fem.constitutive_state import Resistance
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import Compiled
from rafl.solvers.banded import Banded
from rafl.solvers.block_elimination import Levels
from rafl.solvers.linear import LinearSolver
from rafl.solvers.multigrid_cg import Iterative

CELLS = np.ones((5, 3, 2), dtype=bool)
CELLS[2:4, 0] = False  # a waist, so that levels differ in size
MESHES = {"box": HexMesh.box((4, 2, 2), (0.08, 0.03, 0.03)), "waist": HexMesh.from_grid(CELLS, 0.01)}
FREE = np.zeros(0, dtype=np.int64)


def system(mesh: HexMesh, fixed: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells' tangents of a batch of three, a diagonal over all nodes, and the dense matrices (3, 3 N, 3 N)."""
    engine = Compiled(mesh, "corotated", "full", fixed)
    q = mesh.vertices + random.normal(0, 1e-3, (3, *mesh.vertices.shape))
    tangents = engine.terms(q, Resistance(np.tile([7e4, 3e5, 0, 0, 0], (3, 1))), tangent=True)[2]
    size = 3 * len(mesh.vertices)
    units = np.eye(size).reshape(size, 1, -1, 3)
    dense = np.stack([[engine.multiply(tangents[t : t + 1], unit)[0].ravel() for unit in units] for t in range(3)])
    return tangents, random.uniform(200.0, 400.0, (3, size)), dense


@pytest.mark.parametrize("kind", [Banded, Levels, Iterative])
@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
@pytest.mark.parametrize("held", [True, False])
def test_solvers_invert_the_assembled_matrix(
    kind: type, mesh: HexMesh, held: bool, random: np.random.Generator
) -> None:
    fixed = mesh.face_nodes("x-min") if held else FREE
    solver: LinearSolver = kind(mesh, fixed)
    tangents, diagonal, dense = system(mesh, fixed, random)
    free = solver.free_index
    right = random.normal(size=(2, 3, len(free)))
    factors = solver.allocate(3)
    rows = np.array([0, 2])  # some of a batch, into their own places
    assert solver.factor(factors, rows, tangents[rows], diagonal[rows][:, free]).all()
    np.testing.assert_array_equal(factors.ready, [True, False, True])
    found = solver.solve(factors, rows, right)
    for x, b, t in zip(found, right, rows, strict=True):
        matrix = dense[t][np.ix_(free, free)] + np.diag(diagonal[t, free])
        np.testing.assert_allclose(matrix @ x.T, b.T, atol=2e-9)
    whole = solver.solve_indefinite(tangents[0], diagonal[0, free], right[0])
    np.testing.assert_allclose(whole, found[0], rtol=1e-7, atol=1e-9 * np.abs(whole).max())


@pytest.mark.parametrize("kind", [Banded, Levels])
def test_an_indefinite_matrix_is_told(kind: type, random: np.random.Generator) -> None:
    mesh = MESHES["box"]
    solver: LinearSolver = kind(mesh, FREE)
    tangents, diagonal, _ = system(mesh, FREE, random)
    factors = solver.allocate(3)
    diagonal[1] -= 1e5
    definite = solver.factor(factors, np.arange(3), tangents, diagonal[:, solver.free_index])
    np.testing.assert_array_equal(definite, [True, False, True])
    np.testing.assert_array_equal(factors.ready, definite)


def test_numbering_does_not_widen_the_band(random: np.random.Generator) -> None:
    mesh = HexMesh.box((8, 2, 2), (0.08, 0.02, 0.02))
    order = random.permutation(len(mesh.vertices))
    shuffled = HexMesh(mesh.vertices[order], np.argsort(order)[mesh.hexes])
    tidy, untidy = (Banded(m, m.face_nodes("x-min")).unknowns.width for m in (mesh, shuffled))
    assert untidy < 1.5 * tidy
