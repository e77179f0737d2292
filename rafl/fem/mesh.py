"""Hexahedral meshes: vertices, cells, quadrature points and boundary."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

# Corner coordinates of the unit cell in node order, (8, 3).
CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float)

# The four nodes of each side of a cell, anticlockwise as seen from outside.
CELL_SIDES = {
    "x-min": (0, 1, 3, 2),
    "x-max": (4, 6, 7, 5),
    "y-min": (0, 4, 5, 1),
    "y-max": (2, 3, 7, 6),
    "z-min": (0, 2, 6, 4),
    "z-max": (1, 5, 7, 3),
}


@dataclass(frozen=True)
class QuadraturePoints:
    """Integration points of each cell.

    Attributes:
        shape: shape functions at the points, (P points, 8 nodes); the same in node_pairs cell.
        gradient: rest-frame shape function gradients [1/m], (E, P points, 8 nodes, 3).
        volume: quadrature weight times Jacobian [m^3], (E, P points).
    """

    shape: NDArray[np.float64]
    gradient: NDArray[np.float64]
    volume: NDArray[np.float64]


@dataclass(frozen=True)
class HexMesh:
    """A mesh of trilinear hexahedra.

    Attributes:
        vertices: rest positions [m], (N, 3).
        hexes: vertex indices of each cell, (E, 8); node (i, j, k) of a cell has index 4i + 2j + k.
    """

    vertices: NDArray[np.float64]
    hexes: NDArray[np.int64]

    @classmethod
    def box(cls, cells: ArrayLike, size: ArrayLike) -> "HexMesh":
        """A box with `cells` (3) cells and edges `size` (3) [m]. One corner is the origin; vertices run z fastest.

        Raises:
            ValueError: a number of cells is no integer above 0.
        """
        counts = np.asarray(cells)
        if counts.shape != (3,) or (counts != counts.astype(np.int64)).any() or (counts < 1).any():
            raise ValueError(f"expected three numbers of cells of at least 1, got {cells!r}")
        nx, ny, nz = (int(n) for n in counts)
        axes = [np.linspace(0.0, s, n + 1) for s, n in zip(np.asarray(size), (nx, ny, nz), strict=True)]
        vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        i, j, k = (a.ravel() for a in np.meshgrid(*map(np.arange, (nx, ny, nz)), indexing="ij"))
        corners = [((i + int(di)) * (ny + 1) + j + int(dj)) * (nz + 1) + k + int(dk) for di, dj, dk in CORNERS]
        return cls(vertices, np.stack(corners, axis=1).astype(np.int64))

    @classmethod
    def from_grid(cls, cells: NDArray[np.bool_], size: ArrayLike) -> "HexMesh":
        """The cells that are True in a grid (X, Y, Z). `size` is the edge length of a cell [m], one or three.

        Vertex (0, 0, 0) of the grid is the origin. Vertices run z fastest, then y, then x.

        Raises:
            ValueError: no cell is True.
        """
        if not cells.any():
            raise ValueError(f"expected at least one cell in the grid of shape {cells.shape}, got none")
        box = cls.box(cells.shape, np.array(cells.shape) * size)
        hexes = box.hexes[cells.ravel()]
        used, indices = np.unique(hexes, return_inverse=True)
        return cls(box.vertices[used], indices.reshape(hexes.shape))

    def scaled(self, factors: ArrayLike) -> "HexMesh":
        """The mesh scaled by `factors` (3) along x, y, z."""
        return HexMesh(self.vertices * np.asarray(factors, dtype=float), self.hexes)

    def split_layer(self, nodes: NDArray[np.int64], fraction: float) -> "HexMesh":
        """The mesh with every cell that has a side at `nodes` cut in two, parallel to this side.

        `fraction` is the share of the cell between the side and the cut. Vertices run z fastest, then y, then x.

        Raises:
            ValueError: fraction not between 0 and 1, or a cell that is not cut shares an edge that is.
        """
        if not 0.0 < fraction < 1.0:
            raise ValueError(f"expected a fraction between 0 and 1, got {fraction}")
        held = np.isin(self.hexes, nodes)
        hexes, cut = self.hexes.copy(), dict[tuple[int, int], int]()
        vertices, far_parts = list(self.vertices), []
        for name, side in CELL_SIDES.items():
            offset = {"x": 4, "y": 2, "z": 1}[name[0]] * (1 if name.endswith("min") else -1)
            opposite = np.array(side) + offset
            for e in np.flatnonzero(held[:, side].all(axis=1) & ~held[:, opposite].any(axis=1)):
                far = self.hexes[e].copy()
                for a, b in zip(side, opposite, strict=True):
                    edge = (int(self.hexes[e, a]), int(self.hexes[e, b]))
                    if edge not in cut:
                        cut[edge] = len(vertices)
                        vertices.append((1.0 - fraction) * self.vertices[edge[0]] + fraction * self.vertices[edge[1]])
                    hexes[e, b] = far[a] = cut[edge]
                far_parts.append(far)
        result = HexMesh(
            np.array(vertices), np.concatenate([hexes, np.array(far_parts, dtype=np.int64).reshape(-1, 8)])
        )
        if {tuple(sorted(edge)) for edge in cut} & {tuple(edge) for edge in result.edges.tolist()}:
            raise ValueError("expected every cell along an edge to be cut at the nodes alike, found one that is not")
        digits = np.round(result.vertices / np.ptp(result.vertices, axis=0).max(), 9)
        order = np.lexsort(digits.T[::-1])
        return HexMesh(result.vertices[order], np.argsort(order)[result.hexes])

    @cached_property
    def quadrature(self) -> QuadraturePoints:
        """The 8 Gauss points at (0.5 -+ 0.5/sqrt 3) of the unit cell, in node order.

        Raises:
            ValueError: a cell is inverted or flat; the message names its index.
        """
        points = 0.5 + (CORNERS - 0.5) / np.sqrt(3.0)
        factors = np.where(CORNERS[None] > 0.5, points[:, None], 1.0 - points[:, None])  # (P, 8, 3)
        signs = np.where(CORNERS > 0.5, 1.0, -1.0)
        local = np.stack(
            [signs[:, a] * factors[:, :, (a + 1) % 3] * factors[:, :, (a + 2) % 3] for a in range(3)],
            axis=-1,
        )  # (P, 8 nodes, 3)
        jacobian = np.einsum("eni,gnj->egij", self.vertices[self.hexes], local)
        determinant = np.linalg.det(jacobian)
        size = np.ptp(self.vertices[self.hexes], axis=1).max(axis=1, keepdims=True)
        degenerate = determinant <= 1e-9 * size**3
        if degenerate.any():
            cell = int(np.argmax(degenerate.any(axis=1)))
            raise ValueError(
                f"cell {cell} is inverted or flat (Jacobian {determinant[cell].min():.3g} m^3); "
                "its eight nodes must run z fastest, then y, then x"
            )
        gradient = np.einsum("gnj,egji->egni", local, np.linalg.inv(jacobian))
        return QuadraturePoints(factors.prod(axis=-1), np.ascontiguousarray(gradient), determinant / len(points))

    @cached_property
    def mean_quadrature(self) -> QuadraturePoints:
        """One point per cell with the cell's mean gradient (B-bar), which is exact for affine motions.

        Raises:
            ValueError: a cell is inverted or flat; the message names its index.
        """
        full = self.quadrature
        gradient = np.einsum("eg,egnj->enj", full.volume, full.gradient) / self.volumes[:, None, None]
        return QuadraturePoints(full.shape.mean(0, keepdims=True), gradient[:, None], self.volumes[:, None])

    @cached_property
    def volumes(self) -> NDArray[np.float64]:
        """Volume of each cell [m^3], (E,)."""
        return np.asarray(self.quadrature.volume.sum(axis=1))

    def deformed_volumes(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Volume of each cell [m^3], (E,), with the vertices at q (N, 3) [m]; negative if it is inverted."""
        rule = self.quadrature
        deformation = np.einsum("eni,egnj->egij", q[self.hexes], rule.gradient, optimize=True)
        return np.asarray((np.linalg.det(deformation) * rule.volume).sum(axis=1))

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """Vertex indices of each cell edge, once per edge, (K, 2)."""
        pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
        node_pairs = np.sort(self.hexes[:, pairs].reshape(-1, 2), axis=1)
        return np.unique(node_pairs, axis=0)

    @cached_property
    def edge_lengths(self) -> NDArray[np.float64]:
        """Rest length of each edge [m], (K)."""
        first, second = self.edges.T
        return np.asarray(np.linalg.norm(self.vertices[first] - self.vertices[second], axis=1))

    def max_edge_change(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Largest change of an edge vector, relative to its rest length, under displacements [m] (B, N, 3); (B)."""
        first, second = self.edges.T
        change = displacement[:, first] - displacement[:, second]
        return np.asarray(np.sqrt(((change**2).sum(-1) / self.edge_lengths**2).max(axis=1)))

    def max_edge_change_bound(self, largest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Upper bound, quick to compute, of `max_edge_change` for displacement components up to `largest` [m]; (B)."""
        return 2.0 * math.sqrt(3.0) * largest / self._shortest_edge

    @cached_property
    def _shortest_edge(self) -> float:
        return float(self.edge_lengths.min())

    def symmetry_planes(self, fixed: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the mesh is symmetric about its mid-plane normal to each axis, (3).

        The reflection must map both the cells and the vertices `fixed` onto themselves.
        """
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        tree, cells = cKDTree(self.vertices), np.unique(np.sort(self.hexes, axis=1), axis=0)
        symmetric = np.zeros(3, dtype=bool)
        for axis in range(3):
            reflected = self.vertices.copy()
            reflected[:, axis] = low[axis] + high[axis] - reflected[:, axis]
            distance, image = tree.query(reflected)
            symmetric[axis] = (
                distance.max() < 1e-6 * (high - low).max()
                and np.array_equal(np.unique(np.sort(image[self.hexes], axis=1), axis=0), cells)
                and np.array_equal(np.unique(image[fixed]), np.unique(fixed))
            )
        return symmetric

    @cached_property
    def surface(self) -> NDArray[np.int64]:
        """Boundary quads (S, 4), with vertices anticlockwise as seen from outside."""
        return np.asarray(self._sides[self._boundary])

    @cached_property
    def surface_cells(self) -> NDArray[np.int64]:
        """Cell of each boundary quad, (S)."""
        return np.asarray(self._boundary % len(self.hexes))

    @cached_property
    def _sides(self) -> NDArray[np.int64]:
        """Quads of all cells, (6 E, 4): first one side of every cell, then the next."""
        return np.concatenate([self.hexes[:, side] for side in CELL_SIDES.values()])

    @cached_property
    def _boundary(self) -> NDArray[np.int64]:
        """Rows of `_sides` that no other cell shares, (S)."""
        _, first, counts = np.unique(np.sort(self._sides, axis=1), axis=0, return_index=True, return_counts=True)
        return np.sort(first[counts == 1])

    def face_nodes(self, face: str) -> NDArray[np.int64]:
        """Vertex indices on the bounding-box face `x-min` ... `z-max`.

        Raises:
            ValueError: unknown face.
        """
        if face not in CELL_SIDES:
            raise ValueError(f"expected face to be one of {', '.join(CELL_SIDES)}, got {face!r}")
        axis = "xyz".index(face[0])
        along = self.vertices[:, axis]
        extreme = along.min() if face.endswith("min") else along.max()
        return np.flatnonzero(np.abs(along - extreme) < 1e-6 * np.ptp(along))

    def face_quads(self, face: str) -> NDArray[np.int64]:
        """Boundary quads (S, 4) in the bounding-box face `x-min` ... `z-max`.

        Raises:
            ValueError: unknown face.
        """
        return self.surface[np.isin(self.surface, self.face_nodes(face)).all(axis=1)]
