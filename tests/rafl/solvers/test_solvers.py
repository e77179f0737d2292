import numpy as np
import pytest

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.mesh import HexMesh
from rafl.simulation.compiled_engine import CompiledEngine
from rafl.solvers.banded import BandedCholesky
from rafl.solvers.block_elimination import BlockElimination
from rafl.solvers.linear import LinearSolver
from rafl.solvers.multigrid_cg import MultigridCG

CELLS = np.ones((5, 3, 2), dtype=bool)
CELLS[2:4, 0] = False  # a waist, so that level sets differ in size
MESHES = {"box": HexMesh.box((4, 2, 2), (0.08, 0.03, 0.03)), "waist": HexMesh.from_grid(CELLS, 0.01)}
NO_FIXED_NODES = np.zeros(0, dtype=np.int64)


def system(mesh: HexMesh, fixed: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell tangents of a batch of three, a diagonal over all nodes, and the dense matrices (3, 3 N, 3 N)."""
    engine = CompiledEngine(mesh, "corotated", "full", fixed)
    q = mesh.vertices + random.normal(0, 1e-3, (3, *mesh.vertices.shape))
    tangents = engine.evaluate(q, ConstitutiveState(np.tile([7e4, 3e5, 0, 0, 0], (3, 1))), tangent=True)[2]
    size = 3 * len(mesh.vertices)
    units = np.eye(size).reshape(size, 1, -1, 3)
    dense = np.stack([[engine.multiply(tangents[t : t + 1], u)[0].ravel() for u in units] for t in range(3)])
    return tangents, random.uniform(200.0, 400.0, (3, size)), dense


@pytest.mark.parametrize("kind", [BandedCholesky, BlockElimination, MultigridCG])
@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
@pytest.mark.parametrize("has_fixed_nodes", [True, False])
def test_solvers_invert_the_assembled_matrix(
    kind: type, mesh: HexMesh, has_fixed_nodes: bool, random: np.random.Generator
) -> None:
    fixed = mesh.face_nodes("x-min") if has_fixed_nodes else NO_FIXED_NODES
    solver: LinearSolver = kind(mesh, fixed)
    tangents, diagonal, dense = system(mesh, fixed, random)
    free = solver.free_index
    right = random.normal(size=(2, 3, len(free)))
    factors = solver.allocate(3)
    rows = np.array([0, 2])  # a subset of the batch
    assert solver.factor(factors, rows, tangents[rows], diagonal[rows][:, free]).all()
    np.testing.assert_array_equal(factors.ready, [True, False, True])
    solution = solver.solve(factors, rows, right)
    for x, b, t in zip(solution, right, rows, strict=True):
        matrix = dense[t][np.ix_(free, free)] + np.diag(diagonal[t, free])
        np.testing.assert_allclose(matrix @ x.T, b.T, atol=2e-9)
    pivoted = solver.solve_indefinite(tangents[0], diagonal[0, free], right[0])
    np.testing.assert_allclose(pivoted, solution[0], rtol=1e-7, atol=1e-9 * np.abs(pivoted).max())


@pytest.mark.parametrize("kind", [BandedCholesky, BlockElimination])
def test_indefinite_matrices_are_reported(kind: type, random: np.random.Generator) -> None:
    mesh = MESHES["box"]
    solver: LinearSolver = kind(mesh, NO_FIXED_NODES)
    tangents, diagonal, _ = system(mesh, NO_FIXED_NODES, random)
    factors = solver.allocate(3)
    diagonal[1] -= 1e5
    definite = solver.factor(factors, np.arange(3), tangents, diagonal[:, solver.free_index])
    np.testing.assert_array_equal(definite, [True, False, True])
    np.testing.assert_array_equal(factors.ready, definite)


def test_node_order_hardly_changes_the_bandwidth(random: np.random.Generator) -> None:
    mesh = HexMesh.box((8, 2, 2), (0.08, 0.02, 0.02))
    order = random.permutation(len(mesh.vertices))
    shuffled = HexMesh(mesh.vertices[order], np.argsort(order)[mesh.hexes])
    ordered_width, shuffled_width = (
        BandedCholesky(m, m.face_nodes("x-min")).unknowns.bandwidth for m in (mesh, shuffled)
    )
    assert shuffled_width < 1.5 * ordered_width
