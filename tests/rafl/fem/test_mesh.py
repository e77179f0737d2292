import numpy as np
import pytest

from rafl.fem.material import Material, lame
from rafl.fem.mesh import HexMesh


def tapered_block() -> HexMesh:
    """A sheared and tapered block, in which no cell is a box."""
    mesh = HexMesh.box((3, 2, 2), (0.3, 0.2, 0.2))
    x, y, z = mesh.vertices.T
    return HexMesh(np.stack([x + 0.2 * z, y * (1 + 0.5 * x), z + 0.1 * x * y], axis=1), mesh.hexes)


def test_volume_of_a_tapered_block() -> None:
    """Exact volume: mean Jacobian of the map (x + 0.2 z, y (1 + x / 2), z + 0.1 x y), at 216,000 points."""
    n = 60
    grid = (np.arange(n) + 0.5) / n
    x, y, _ = np.meshgrid(0.3 * grid, 0.2 * grid, 0.2 * grid, indexing="ij")
    jacobian = np.zeros((*x.shape, 3, 3))
    jacobian[..., 0, 0], jacobian[..., 0, 2] = 1.0, 0.2
    jacobian[..., 1, 0], jacobian[..., 1, 1] = 0.5 * y, 1 + 0.5 * x
    jacobian[..., 2, 0], jacobian[..., 2, 1], jacobian[..., 2, 2] = 0.1 * y, 0.1 * x, 1.0
    exact = np.linalg.det(jacobian).mean() * 0.3 * 0.2 * 0.2
    volume = tapered_block().volumes.sum()
    assert volume == pytest.approx(exact, rel=2e-3)


def test_gradients_reproduce_linear_fields() -> None:
    """The gradient of A x + b is A in cells of any shape."""
    mesh = tapered_block()
    a = np.array([[1.0, 2.0, -1.0], [0.3, -0.7, 0.2], [2.0, 0.1, 1.5]])
    field = mesh.vertices @ a.T + 3.0
    gradient = np.einsum("eni,egnj->egij", field[mesh.hexes], mesh.quadrature.gradient)
    np.testing.assert_allclose(gradient, np.broadcast_to(a, gradient.shape), atol=1e-12)


def test_error_names_the_distorted_cell() -> None:
    mesh = HexMesh.box((3, 1, 1), (3.0, 1.0, 1.0))
    vertices = mesh.vertices.copy()
    vertices[mesh.hexes[1][4:]] -= [1.5, 0, 0]
    with pytest.raises(ValueError, match="cell 1 is inverted"):
        _ = HexMesh(vertices, mesh.hexes).quadrature


def test_surface_is_closed_with_outward_normals() -> None:
    """Area vectors of a closed surface sum to zero. The integral of x . n / 3 is the volume."""
    mesh = HexMesh.box((3, 2, 2), (0.3, 0.2, 0.1))
    corners = mesh.vertices[mesh.surface]
    area = 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    np.testing.assert_allclose(area.sum(0), 0.0, atol=1e-15)
    assert (area * corners.mean(1)).sum() / 3.0 == pytest.approx(0.006)
    assert len(mesh.surface) == 2 * (3 * 2 + 3 * 2 + 2 * 2)


def test_face_nodes() -> None:
    mesh = HexMesh.box((4, 2, 3), (0.4, 0.2, 0.3))
    assert len(mesh.face_nodes("x-min")) == 12
    assert (mesh.vertices[mesh.face_nodes("z-max"), 2] == pytest.approx(0.3)) is True
    with pytest.raises(ValueError, match="x-min"):
        mesh.face_nodes("left")


def test_mass_models() -> None:
    """The lumped model has the true mass. The uniform model of the paper gives every node the mass of a whole cell."""
    mesh = HexMesh.box((10, 3, 3), (0.1, 0.03, 0.03))
    assert Material(mass="lumped").node_volume(mesh).sum() == pytest.approx(9e-5)
    assert 1070 * Material(mass="uniform").node_volume(mesh).sum() == pytest.approx(0.18832)


def test_mesh_from_grid_and_scaling() -> None:
    """Three cells in an L have 16 vertices, z fastest. Scaling multiplies the volume."""
    cells = np.zeros((2, 2, 1), dtype=bool)
    cells[0], cells[1, 0] = True, True
    mesh = HexMesh.from_grid(cells, 0.01).scaled([2.0, 1.0, 1.5])
    assert mesh.vertices.shape == (16, 3)
    assert mesh.volumes.sum() == pytest.approx(9e-6)
    assert len(mesh.surface) == 14
    np.testing.assert_array_equal(np.lexsort(mesh.vertices.T[::-1]), np.arange(16))
    with pytest.raises(ValueError, match="at least one cell"):
        HexMesh.from_grid(np.zeros((2, 2, 2), dtype=bool), 0.01)


def test_full_grid_equals_the_box() -> None:
    grid, box = HexMesh.from_grid(np.ones((3, 2, 2), dtype=bool), 0.01), HexMesh.box((3, 2, 2), (0.03, 0.02, 0.02))
    np.testing.assert_allclose(grid.vertices, box.vertices)
    np.testing.assert_array_equal(grid.hexes, box.hexes)


def test_symmetry_planes() -> None:
    mesh = HexMesh.box((3, 2, 2), (0.03, 0.02, 0.01))
    no_nodes = np.array([], dtype=np.int64)
    assert mesh.symmetry_planes(no_nodes).tolist() == [True, True, True]
    assert mesh.symmetry_planes(mesh.face_nodes("x-min")).tolist() == [False, True, True]
    assert mesh.symmetry_planes(mesh.face_nodes("x-min")[:2]).tolist() == [False, False, False]
    cells = np.ones((3, 2, 2), dtype=bool)
    cells[2, :, 1] = False
    notched = HexMesh.from_grid(cells, 0.01)
    assert notched.symmetry_planes(no_nodes).tolist() == [False, True, False]
    bent = notched.vertices + 1e-4 * notched.vertices[:, [1]]
    assert HexMesh(bent, notched.hexes).symmetry_planes(no_nodes).tolist() == [False, False, False]


def test_max_edge_change_and_its_bound() -> None:
    """A stretch by 10 % along x, one displaced node, and random displacements, which must stay below the bound."""
    mesh = HexMesh.box((3, 2, 2), (0.06, 0.02, 0.01))
    stretched = 0.1 * mesh.vertices * [1.0, 0.0, 0.0]
    single_node = np.zeros_like(mesh.vertices)
    single_node[0] = [0.001, 0.002, -0.002]
    displacements = np.stack([stretched, single_node])
    np.testing.assert_allclose(mesh.max_edge_change(displacements), [0.1, 0.003 / 0.005])
    random = np.random.default_rng(3).uniform(-1e-3, 1e-3, (50, *mesh.vertices.shape))
    assert (mesh.max_edge_change(random) <= mesh.max_edge_change_bound(np.abs(random).max(axis=(1, 2)))).all()
    opposite = np.where(mesh.vertices.sum(axis=1, keepdims=True) > 0.03, 1e-3, -1e-3) * np.ones(3)
    assert mesh.max_edge_change_bound(np.array([1e-3])) == pytest.approx(mesh.max_edge_change(opposite[None]))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damage", ["inverted", "flat", "a point"])
def test_error_names_the_inverted_or_flat_cell(damage: str) -> None:
    mesh = HexMesh.box((3, 1, 1), (0.03, 0.01, 0.01))
    vertices, hexes = mesh.vertices.copy(), mesh.hexes.copy()
    if damage == "inverted":
        hexes[1] = hexes[1][[4, 5, 6, 7, 0, 1, 2, 3]]
    elif damage == "flat":
        vertices[hexes[1, 4:], 0] = vertices[hexes[1, :4], 0]
        hexes = hexes[:2]
    else:
        hexes[1] = 0
    with pytest.raises(ValueError, match="cell 1 is inverted or flat"):
        _ = HexMesh(vertices, hexes).quadrature


def test_lame_parameters() -> None:
    mu, lam = lame(2.5, 0.25)
    assert mu == pytest.approx(1.0)
    assert lam == pytest.approx(1.0)
