"""Shapes of box-shaped cells between grid lines, which can be divided, graded and halved."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh

END_FRACTIONS = (0.125, 0.25, 0.5)  # where the cells at an end of an axis are cut


@dataclass(frozen=True)
class Voxels:
    """Cells of a grid.

    Attributes:
        lines: coordinates of the grid's planes along x, y, z [m].
        filled: whether each cell belongs to the shape, (X, Y, Z).
    """

    lines: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
    filled: NDArray[np.bool_]

    @classmethod
    def of(cls, mesh: HexMesh) -> "Voxels":
        """The cells of a mesh of boxes whose faces lie in common planes."""
        lines = tuple(np.unique(np.round(mesh.vertices[:, axis], 9)) for axis in range(3))
        centres = mesh.vertices[mesh.hexes].mean(axis=1)
        index = tuple(np.searchsorted(lines[axis], centres[:, axis]) - 1 for axis in range(3))
        filled = np.zeros([len(line) - 1 for line in lines], dtype=bool)
        filled[index] = True
        return cls(lines, filled)

    def _with_lines(self, axis: int, line: NDArray[np.float64]) -> "Voxels":
        """The shape with other planes along one axis; cells beyond the new ones are left out."""
        parent = np.searchsorted(self.lines[axis], 0.5 * (line[1:] + line[:-1])) - 1
        lines = tuple(line if axis == other else self.lines[other] for other in range(3))
        return Voxels(lines, np.take(self.filled, parent, axis=axis))

    def divided(self, parts: int) -> "Voxels":
        """Every cell divided into `parts` along each axis."""
        result = self
        for axis, line in enumerate(self.lines):
            count = len(line) - 1
            result = result._with_lines(
                axis, np.interp(np.arange(parts * count + 1) / parts, np.arange(count + 1), line)
            )
        return result

    def graded(self, axis: int, low: bool, high: bool, fractions: tuple[float, ...] = END_FRACTIONS) -> "Voxels":
        """The first (`low`) and last (`high`) cells along an axis cut at fractions of their size from its end."""
        line, cuts = self.lines[axis], np.array(fractions)
        first = line[0] + cuts * (line[1] - line[0]) if low else []
        last = line[-1] - cuts * (line[-1] - line[-2]) if high else []
        return self._with_lines(axis, np.sort(np.concatenate([line, first, last])))

    def upper_half(self, axis: int) -> "Voxels":
        """The half above the mid-plane normal to an axis."""
        line = self.lines[axis]
        middle = 0.5 * (line[0] + line[-1])
        return self._with_lines(axis, np.concatenate([[middle], line[line > middle + 1e-9]]))

    @property
    def mesh(self) -> HexMesh:
        """The mesh of the filled cells."""
        box = HexMesh.box(self.filled.shape, self.filled.shape)
        index = np.rint(box.vertices).astype(int)
        vertices = np.stack([self.lines[axis][index[:, axis]] for axis in range(3)], axis=-1)
        hexes = box.hexes[self.filled.ravel()]
        used, indices = np.unique(hexes, return_inverse=True)
        return HexMesh(vertices[used], indices.reshape(hexes.shape))
