"""The boundary of a body and its strains, compared with exact solutions."""

import numpy as np

from rafl.evaluation.surface import Surface, SurfaceMotion, boundary
from rafl.fem.mesh import HexMesh


def test_boundary_of_a_block_with_an_inner_cell() -> None:
    """3 x 3 x 3 cells have 54 outer sides, and one cell and 8 vertices inside. Each face bounds its cell."""
    mesh = HexMesh.box((3, 3, 3), (0.03, 0.03, 0.03))
    vertices, cells = boundary(mesh)
    surface = Surface.of(mesh)
    assert (len(vertices), len(cells), len(surface.faces)) == (64 - 8, 27 - 1, 54)
    for face, cell in zip(surface.faces, surface.cells, strict=True):
        assert set(vertices[face]) <= set(mesh.hexes[cells[cell]])


def test_strain_of_a_stretched_block() -> None:
    """x stretched by 1.1, y by 0.9: Green strain diag(0.105, -0.095, 0)."""
    mesh = HexMesh.box((3, 3, 3), (0.03, 0.03, 0.03))
    q = np.stack([mesh.vertices, mesh.vertices * [1.1, 0.9, 1.0]])
    force = np.zeros((1, *mesh.vertices.shape))
    force[..., 0], force[..., 1] = 3.0, 4.0
    motion = SurfaceMotion.of(mesh, q, force)
    assert np.abs(motion.strain[0]).max() < 1e-12
    np.testing.assert_allclose(motion.strain[1], np.hypot(0.105, 0.095), rtol=1e-6)
    assert motion.force is not None
    np.testing.assert_array_equal(motion.force, np.full((1, 56), 5.0))
    np.testing.assert_allclose(motion.vertices[1], q[1, boundary(mesh)[0]], atol=1e-8)
