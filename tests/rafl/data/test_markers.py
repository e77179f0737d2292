import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rafl.data.markers import Markers, embed, embedding_gap
from rafl.fem.mesh import HexMesh

MESH = HexMesh.box((4, 2, 2), (0.08, 0.04, 0.04))


def embedded(*points: tuple[float, float, float]) -> Markers:
    return embed(MESH, tuple(f"m{i}" for i in range(len(points))), np.array(points, dtype=float))


@settings(deadline=None, max_examples=30)
@given(st.floats(0.0, 0.08), st.floats(0.0, 0.04), st.lists(st.floats(-0.5, 0.5), min_size=9, max_size=9))
def test_surface_markers_follow_any_affine_deformation(x: float, z: float, entries: list[float]) -> None:
    markers = embedded((x, 0.0, z))
    assert markers.weights.sum() == pytest.approx(1.0)
    A = np.eye(3) + np.array(entries).reshape(3, 3)
    moved = markers.positions(torch.tensor(MESH.vertices @ A.T)).numpy()
    if abs(np.linalg.det(A)) > 1e-3:
        np.testing.assert_allclose(moved[0], A @ [x, 0.0, z], atol=1e-10)


def test_offset_marker_keeps_its_distance_under_rotation() -> None:
    markers = embedded((0.08, 0.02, 0.046), (0.08, -0.006, 0.03), (0.03, 0.02, -0.002))
    np.testing.assert_allclose(markers.normal_offset, [0.006, 0.006, 0.002], atol=1e-12)
    assert embedding_gap(MESH, markers).max() < 1e-12
    rotation = Rotation.from_rotvec([1.0, 0.5, -0.3]).as_matrix()
    moved = markers.positions(torch.tensor(MESH.vertices @ rotation.T + 0.1)).numpy()
    np.testing.assert_allclose(moved, markers.rest @ rotation.T + 0.1, atol=1e-12)


def test_marker_beyond_an_edge_has_a_gap() -> None:
    markers = embedded((0.083, 0.02, 0.044))
    assert embedding_gap(MESH, markers)[0] > 2e-3


def test_positions_are_differentiable(random: np.random.Generator) -> None:
    markers = embedded((0.033, 0.02, 0.046), (0.05, 0.0, 0.011))
    q = torch.tensor(MESH.vertices + random.normal(0, 1e-3, MESH.vertices.shape)).requires_grad_()
    assert torch.autograd.gradcheck(markers.positions, (q,), eps=1e-6, atol=1e-7, fast_mode=True)


def test_corner_jacobian_equals_finite_differences(random: np.random.Generator) -> None:
    mesh = HexMesh.box((3, 2, 2), (0.03, 0.02, 0.02))
    points = np.array([[0.012, -5e-4, 0.011], [0.02, 0.0195, 0.003], [0.03, 0.0095, 0.0105]])
    markers = embed(mesh, ("a", "b", "c"), points)
    q = torch.tensor(mesh.vertices + random.normal(0, 1e-3, (2, *mesh.vertices.shape)))
    direction = torch.tensor(random.normal(size=q.shape))
    h = 1e-6
    expected = (markers.positions(q + h * direction) - markers.positions(q - h * direction)) / (2 * h)
    found = torch.einsum("bmick,bmck->bmi", markers.corner_jacobian(q), direction[:, torch.from_numpy(markers.quad)])
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)
