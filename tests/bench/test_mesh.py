"""The parts that the converged solutions of the mesh benchmark rest on."""

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    return importlib.import_module("mesh")


def test_mixed_tangent_is_the_derivative_of_the_force(bench: ModuleType, random: np.random.Generator) -> None:
    """With the pressures that balance the strain, by central differences, on distorted cells at finite strain."""
    lines = (np.array([0.0, 1.0, 2.5]), np.array([0.0, 1.0]), np.array([0.0, 1.2, 2.0]))
    mesh = bench.Voxels(lines, np.ones((2, 1, 2), dtype=bool)).mesh
    vertices = mesh.vertices + random.uniform(-0.1, 0.1, mesh.vertices.shape)
    body = bench.MixedHexahedra(vertices, mesh.hexes[:, bench.SCIKIT_FEM_CORNERS], False, 2.0, 30.0, 1.0)
    u = random.normal(0.0, 0.05, body.nodes.shape)
    direction = np.zeros(u.size)
    direction[body.free] = random.normal(size=len(body.free))
    step, none = 1e-6 * direction.reshape(u.shape), np.zeros((len(mesh.hexes), 4))
    ahead, behind = (body.evaluate(u + sign * step, none).gradient for sign in (1, -1))
    pressure = body.lam * body.evaluate(u, none).strain
    expected = body.evaluate(u, pressure).tangent @ direction[body.free]
    np.testing.assert_allclose((ahead - behind).ravel()[body.free] / 2e-6, expected, atol=1e-6 * np.abs(expected).max())


def test_mixed_elements_do_not_resist_rotation(bench: ModuleType) -> None:
    mesh = bench.Voxels((np.arange(3.0), np.arange(2.0), np.arange(3.0)), np.ones((2, 1, 2), dtype=bool)).mesh
    body = bench.MixedHexahedra(mesh.vertices, mesh.hexes[:, bench.SCIKIT_FEM_CORNERS], False, 2.0, 1000.0, 1.0)
    turned = body.nodes @ Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix().T
    assert np.abs(body.evaluate(turned - body.nodes, np.zeros((4, 4))).gradient).max() < 1e-9


def test_divided_graded_and_halved_cells_keep_their_volume(bench: ModuleType) -> None:
    shape = bench.Shape.of("fishtail-crude").voxels
    volume = shape.mesh.volumes.sum()
    finer = shape.divided(2).graded(0, True, False).graded(2, True, True)
    assert finer.mesh.volumes.sum() == pytest.approx(volume)
    assert finer.upper_half(1).mesh.volumes.sum() == pytest.approx(0.5 * volume)
    assert bench.Shape.of("fishtail-crude").cells_across == 1
    assert bench.Shape.of("thicker").cells_across == 4


def test_limit_of_a_known_order(bench: ModuleType) -> None:
    """7 + h^1.5 has the limit 7; with an implausible order, and for two values, the assumed order is taken."""
    assert bench.limit([7 + h**1.5 for h in (1.0, 0.5, 0.25)], [1, 2, 4]) == pytest.approx(7.0)
    for values in (
        [7 + h**bench.ASSUMED_ORDER for h in (1.0, 0.5)],
        [5.0, 7 + 0.5**bench.ASSUMED_ORDER, 7 + 0.25**bench.ASSUMED_ORDER],
    ):
        assert bench.limit(values, [1, 2, 4][: len(values)]) == pytest.approx(7.0)
