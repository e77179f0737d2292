import numpy as np
import pytest
import torch
from devices import ON_DEVICES

from rafl.fem.constitutive_state import ConstitutiveState
from rafl.fem.mesh import HexMesh
from rafl.simulation.torch_engine import TorchEngine
from rafl.solvers.tensor_blocks import MAX_DIRECT_SIZE, TensorBlockElimination, inverse_factors

CELLS = np.ones((6, 3, 2), dtype=bool)
CELLS[2:4, 0] = False  # a waist, so that level sets differ in size
MESHES = {
    "box": HexMesh.box((4, 2, 2), (0.08, 0.03, 0.03)),
    "waist": HexMesh.from_grid(CELLS, 0.01),
    "one level": HexMesh.box((1, 1, 1), (0.02, 0.02, 0.02)),
    "two levels": HexMesh.box((2, 1, 1), (0.02, 0.01, 0.01)),
    "two bodies": HexMesh.from_grid(np.array([True, True, False, True])[:, None, None], 0.01),
}


def system(mesh: HexMesh, fixed: np.ndarray, device: str, random: np.random.Generator) -> tuple[TorchEngine, ...]:
    """An engine, cell tangents of a batch of three, a diagonal over all nodes and the dense matrices (3, 3 N, 3 N)."""
    engine = TorchEngine(mesh, "corotated", "full", fixed, device)
    q = mesh.vertices + random.normal(0, 1e-3, (3, *mesh.vertices.shape))
    tangents = engine.evaluate(q, ConstitutiveState(np.tile([7e4, 3e5, 0, 0], (3, 1))), tangent=True)[2]
    size = 3 * len(mesh.vertices)
    units = np.eye(size).reshape(size, 1, -1, 3)
    dense = np.stack([[engine.multiply(tangents[t : t + 1], u)[0].ravel() for u in units] for t in range(3)])
    return engine, tangents, random.uniform(200.0, 400.0, (3, size)), dense


@ON_DEVICES
@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
@pytest.mark.parametrize("has_fixed_nodes", [True, False])
def test_solutions_satisfy_the_assembled_system(
    mesh: HexMesh, has_fixed_nodes: bool, device: str, random: np.random.Generator
) -> None:
    """For a subset of a batch, by Cholesky factors and by those of indefinite matrices."""
    fixed = mesh.face_nodes("x-min") if has_fixed_nodes else np.zeros(0, dtype=np.int64)
    engine, tangents, diagonal, dense = system(mesh, fixed, device, random)
    free = engine.free_index
    assert sorted(free // 3) == sorted(np.repeat(np.setdiff1d(np.arange(len(mesh.vertices)), fixed), 3))
    right = random.normal(size=(2, 3, len(free)))
    factors = engine.allocate(3)
    rows = np.array([0, 2])
    assert engine.factor(factors, rows, tangents[rows], diagonal[rows][:, free]).all()
    np.testing.assert_array_equal(factors.ready, [True, False, True])
    solution = engine.solve(factors, rows, right)
    for x, b, t in zip(solution, right, rows, strict=True):
        matrix = dense[t][np.ix_(free, free)] + np.diag(diagonal[t, free])
        np.testing.assert_allclose(matrix @ x.T, b.T, atol=2e-10)
    own = (torch.tensor(x, device=device) for x in (diagonal[0, free], right[0]))
    pivoted = engine.linear_solver.solve_indefinite(tangents[0], *own).cpu().numpy()
    np.testing.assert_allclose(pivoted, solution[0], rtol=1e-8, atol=1e-10 * np.abs(pivoted).max())


@ON_DEVICES
def test_one_indefinite_matrix_does_not_spoil_the_others(device: str, random: np.random.Generator) -> None:
    """It is reported, and `solve_once` solves with it all the same."""
    mesh = MESHES["waist"]
    engine, tangents, diagonal, dense = system(mesh, np.zeros(0, dtype=np.int64), device, random)
    diagonal[1] -= 1e5
    right = random.normal(size=(3, 2, len(engine.free_index)))
    own = diagonal[:, engine.free_index]
    factors = engine.allocate(3)
    np.testing.assert_array_equal(engine.factor(factors, np.arange(3), tangents, own), [True, False, True])
    np.testing.assert_array_equal(factors.ready, [True, False, True])
    solution = engine.solve_once(tangents, own, right)
    order = engine.free_index
    for x, b, matrix, extra in zip(solution, right, dense, own, strict=True):
        np.testing.assert_allclose((matrix[np.ix_(order, order)] + np.diag(extra)) @ x.T, b.T, atol=1e-9)


@ON_DEVICES
def test_undefined_entries_are_reported(device: str, random: np.random.Generator) -> None:
    mesh = MESHES["box"]
    engine, tangents, diagonal, _ = system(mesh, mesh.face_nodes("x-min"), device, random)
    tangents[2, -1, 3, 3] = torch.nan
    own = diagonal[:, engine.free_index]
    found = engine.factor(engine.allocate(3), np.arange(3), tangents, own)
    np.testing.assert_array_equal(found, [True, True, False])


def test_levels_are_eliminated_from_both_ends() -> None:
    """The blocks of a box hold no added unknown, and half as many groups as levels."""
    mesh = HexMesh.box((7, 2, 2), (0.07, 0.02, 0.02))
    solver = TensorBlockElimination(mesh, mesh.face_nodes("x-min"), torch.device("cpu"))
    assert solver.count == 7 * 27
    factors = solver.allocate(2)
    tangents, diagonal = (
        torch.zeros(1, 28, 24, 24, dtype=torch.float64),
        torch.ones(1, solver.count, dtype=torch.float64),
    )
    assert solver.factor(factors, np.array([1]), tangents, diagonal).all()
    blocks = [block[1:] for block in factors.storage]
    assert [tuple(block.shape) for block in blocks] == [*[(1, 2, 27, 27)] * 3, (1, 1, 27, 27), *[(1, 2, 27, 27)] * 3]


@ON_DEVICES
@pytest.mark.parametrize("size", [1, MAX_DIRECT_SIZE, MAX_DIRECT_SIZE + 1, 3 * MAX_DIRECT_SIZE + 7])
def test_inverse_factors(size: int, device: str, random: np.random.Generator) -> None:
    """Of a batch with an indefinite matrix in either half, from the lower triangles only."""
    root = torch.tensor(random.normal(size=(2, 3, size, size)), device=device)
    matrix = root @ root.mT + size * torch.eye(size, dtype=root.dtype, device=device)
    lower = torch.linalg.cholesky(matrix)
    read = matrix.tril()
    read[0, 1, 0, 0] = read[1, 2, -1, -1] = -1.0
    inverse, info = inverse_factors(read)
    definite = torch.tensor([[True, False, True], [True, True, False]], device=device)
    assert bool(((info == 0) == definite).all())
    identity = torch.eye(size, dtype=root.dtype, device=device)
    assert float((inverse[definite] @ lower[definite] - identity).abs().max()) < 1e-12
    assert float(inverse[definite].triu(1).abs().max()) == 0.0
