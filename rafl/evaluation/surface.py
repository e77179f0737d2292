"""The boundary of a simulated body over time: positions, strains and residual forces, as a viewer draws them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh
from rafl.fem.strain import green_strain, magnitude

Array = NDArray[Any]


@dataclass(frozen=True)
class Surface:
    """Boundary of a mesh. It has B vertices and C cells, numbered as in the mesh, and S faces.

    Attributes:
        faces: indices among the B vertices, anticlockwise as seen from outside, (S, 4).
        cells: index of each face's cell among the C cells, (S).
    """

    faces: NDArray[np.int64]
    cells: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: HexMesh) -> "Surface":
        """The boundary of a mesh."""
        vertices, cells = boundary(mesh)
        return cls(np.searchsorted(vertices, mesh.surface), np.searchsorted(cells, mesh.surface_cells))


@dataclass(frozen=True)
class SurfaceMotion:
    """Motion of a body's boundary in T frames.

    Attributes:
        vertices: positions [m], float32 (T, B, 3).
        strain: magnitude of the Green strain of each cell, by its mean deformation gradient, float32 (T, C).
        force: magnitude of the residual force [N] in the step after each frame but the last, float32 (T - 1, B); None
            without a residual force.
    """

    vertices: NDArray[np.float32]
    strain: NDArray[np.float32]
    force: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, mesh: HexMesh, q: Array, force: Array | None = None) -> "SurfaceMotion":
        """The boundary of vertex positions q (T, N, 3) [m], with residual forces (T - 1, N, 3) [N] or none."""
        vertices, cells = boundary(mesh)
        strain, _ = green_strain(mesh, mesh.mean_quadrature, q, np.zeros_like(q))
        return cls(
            q[:, vertices].astype(np.float32),
            magnitude(strain)[:, cells, 0].astype(np.float32),
            None if force is None else np.linalg.norm(force[:, vertices], axis=-1).astype(np.float32),
        )


def boundary(mesh: HexMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the vertices (B) and of the cells (C) at the boundary of a mesh, in ascending order."""
    return np.unique(mesh.surface), np.unique(mesh.surface_cells)
