"""The `geometry` of a specimen file, and the hexahedra it stands for."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.ndimage import label

from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.common.yaml_files import StrictModel
from rafl.fem.mesh import HexMesh

SURFACES = (".stl", ".obj", ".ply")
MOST_CELLS = 2_000_000  # of the grid around a surface
CHUNK = 50_000  # cell centres asked for at once


class Geometry(StrictModel):
    """A box, sections, or a closed surface; exactly one of them.

    `box_mm` has whole elements of `element_mm`, or `cells` along x, y and z. `rectangles` (cells wide, cells high) and
    `ellipses` (semi-axes in cells, and how far the middle is off along y) are sections of one element each, from clamp
    to tip. `surface` names a file in mm, beside the specimen's, whose coordinates are the specimen frame.
    """

    element_mm: float | None = Field(default=None, gt=0)
    box_mm: tuple[float, float, float] | None = None
    cells: tuple[int, int, int] | None = None
    rectangles: list[tuple[int, int]] | None = Field(default=None, min_length=1)
    ellipses: list[tuple[float, float] | tuple[float, float, float]] | None = Field(default=None, min_length=1)
    surface: str | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "Geometry":
        kinds = [key for key in ("box_mm", "rectangles", "ellipses", "surface") if getattr(self, key) is not None]
        if len(kinds) != 1:
            raise ValueError("expected one of box_mm, rectangles, ellipses and surface")
        if self.cells is not None and (self.box_mm is None or self.element_mm is not None or min(self.cells) < 1):
            raise ValueError("expected cells (1 or more) with box_mm, in the place of element_mm")
        if self.cells is None and self.element_mm is None:
            raise ValueError("expected element_mm, the size of an element")
        if self.box_mm is not None and min(self.box_mm) <= 0:
            raise ValueError("expected sides longer than 0 mm")
        if self.box_mm is not None and self.element_mm is not None:
            count = np.array(self.box_mm) / self.element_mm
            if np.abs(count - np.round(count)).max() > 1e-6:
                raise ValueError(f"expected sides that are whole multiples of {self.element_mm} mm, or cells")
        if min((min(axes[:2]) for axes in [*(self.rectangles or []), *(self.ellipses or [])]), default=1) <= 0:
            raise ValueError("expected sections wider and higher than 0")
        return self

    def solid(self, folder: Path, clamp: str) -> "Solid":
        """The hexahedra.

        Args:
            folder: of the specimen file.
            clamp: the face that is held, `x-min` ... `z-max`; a surface's cells begin there.

        Raises:
            InputError: a surface that cannot be filled.
        """
        if self.box_mm is not None:
            size = 1e-3 * np.array(self.box_mm)
            cells = self.cells or np.round(size / (1e-3 * (self.element_mm or 1.0))).astype(int)
            return Solid(HexMesh.box(cells, size), float(size.prod()))
        element = 1e-3 * (self.element_mm or 1.0)
        if self.surface is not None:
            return fill(folder / self.surface, element, clamp)
        grid = _rectangular(self.rectangles) if self.rectangles is not None else _elliptic(self.ellipses or [])
        return Solid(HexMesh.from_grid(grid, element), float(grid.sum() * element**3))


@dataclass(frozen=True)
class Solid:
    """Hexahedra, and the volume of the shape they stand for [m^3]."""

    mesh: HexMesh
    volume: float


def _rectangular(sections: list[tuple[int, int]]) -> NDArray[np.bool_]:
    wide, high = max(w for w, _ in sections), max(h for _, h in sections)
    grid = np.zeros((len(sections), wide, high), dtype=bool)
    for x, (w, h) in enumerate(sections):
        grid[x, (wide - w) // 2 : (wide + w) // 2, (high - h) // 2 : (high + h) // 2] = True
    return grid


def _elliptic(sections: list[tuple[float, float] | tuple[float, float, float]]) -> NDArray[np.bool_]:
    wide, high = (int(max(axes[k] for axes in sections)) for k in (0, 1))
    y, z = np.arange(-wide, wide + 1)[:, None], np.arange(-high, high + 1)
    middle = [axes[2] if len(axes) == 3 else 0.0 for axes in sections]
    return np.array(
        [((y - m) / axes[0]) ** 2 + (z / axes[1]) ** 2 <= 1.0 for m, axes in zip(middle, sections, strict=True)]
    )


def fill(path: Path, element: float, clamp: str) -> Solid:
    """The cells of a grid whose centres lie inside a closed surface.

    The grid begins at the clamped face and stands centred across, so that a symmetric surface gives symmetric cells.

    Args:
        path: of an STL, OBJ or PLY file in mm.
        element: edge of a cell [m].
        clamp: the face that is held, `x-min` ... `z-max`.

    Raises:
        InputError: no such file, not a surface, open, too coarse or too fine cells, cells that do not hang together.
    """
    surface = read_surface(path)
    low, high = 1e-3 * surface.bounds
    count = np.maximum(np.ceil((high - low) / element - 1e-6), 1.0).astype(int)
    if count.prod() > MOST_CELLS:
        raise InputError(
            f"surface {path}: expected at most {MOST_CELLS} elements around it, found {count.prod()} of "
            f"{1e3 * element:g} mm in {' x '.join(f'{x:.4g}' for x in 1e3 * (high - low))} mm; is the file in mm?"
        )
    begin = 0.5 * (low + high) - 0.5 * element * count
    axis = "xyz".index(clamp[0])
    begin[axis] = low[axis] if clamp.endswith("min") else high[axis] - element * count[axis]
    places = begin + element * (np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1) + 0.5)
    inside = np.concatenate(
        [surface.contains(1e3 * part) for part in np.array_split(places.reshape(-1, 3), -(-count.prod() // CHUNK))]
    ).reshape(count)
    if not inside.any():
        raise InputError(
            f"surface {path}: expected elements inside it, found none of {1e3 * element:g} mm; choose a smaller "
            "element_mm (and is the file in mm?)"
        )
    pieces = label(inside)[1]
    if pieces > 1:
        raise InputError(
            f"surface {path}: expected elements in one piece, found {pieces} pieces of {1e3 * element:g} mm elements; "
            "choose a smaller element_mm"
        )
    mesh = HexMesh.from_grid(inside, element)
    return Solid(HexMesh(mesh.vertices + begin, mesh.hexes), 1e-9 * float(surface.volume))


def read_surface(path: Path) -> trimesh.Trimesh:
    """A closed surface, its normals outwards [mm].

    Raises:
        InputError: no such file, not a surface, or open.
    """
    require_file(path, "a surface (.stl, .obj or .ply)")
    if path.suffix.lower() not in SURFACES:
        raise InputError(f"expected a surface ({', '.join(SURFACES)}), found {path}; export it in one of these")
    try:
        surface = trimesh.load_mesh(path, skip_materials=True)
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, ImportError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"expected a surface in {path}, which cannot be read: {reason:.120}; export it again"
        ) from None
    if not isinstance(surface, trimesh.Trimesh) or len(surface.faces) == 0:
        raise InputError(f"expected triangles in {path}, found none; export it again as a mesh")
    if not surface.is_watertight:
        _, sharing = np.unique(np.sort(surface.edges, axis=1), axis=0, return_counts=True)
        raise InputError(
            f"surface {path}: expected it closed (watertight), found {int((sharing != 2).sum())} of {len(sharing)} "
            "edges that do not join two triangles; close its holes and export it again"
        )
    if not surface.is_winding_consistent:
        surface.fix_normals()
    if surface.volume < 0:
        surface.invert()
    return surface
