"""The `geometry` section of a specimen file, and its hexahedral mesh."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator
from scipy.ndimage import label

from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.common.names import PathInside
from rafl.common.yaml_files import LARGEST, StrictModel
from rafl.fem.mesh import HexMesh

SURFACES = (".stl", ".obj", ".ply")
MAX_GRID_CELLS = 2_000_000  # of the grid around a shape
MAX_ELEMENTS = 200_000  # of a mesh; the simulation of a beam of 720,000 filled 24 GB of memory
QUERY_SIZE = 50_000  # cell centres per containment query


class Geometry(StrictModel):
    """Exactly one of: a box, sections, or a closed surface.

    `box_mm` is divided into elements of `element_mm`, or into `cells` along x, y and z. `rectangles` (width and height
    in cells) and `ellipses` (semi-axes, and optionally the offset of the centre along y, in cells) are sections from
    clamp to tip, each one element long. `surface` names a file next to the specimen's, in mm and specimen coordinates.
    """

    element_mm: float | None = Field(default=None, gt=0)
    box_mm: tuple[float, float, float] | None = None
    cells: tuple[int, int, int] | None = None
    rectangles: list[tuple[int, int]] | None = Field(default=None, min_length=1)
    ellipses: list[tuple[float, float] | tuple[float, float, float]] | None = Field(default=None, min_length=1)
    surface: PathInside | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "Geometry":
        kinds = [key for key in ("box_mm", "rectangles", "ellipses", "surface") if getattr(self, key) is not None]
        if len(kinds) != 1:
            raise ValueError("expected one of box_mm, rectangles, ellipses and surface")
        if self.cells is not None and (self.box_mm is None or self.element_mm is not None or min(self.cells) < 1):
            raise ValueError("expected cells (1 or more) with box_mm, instead of element_mm")
        if self.cells is None and self.element_mm is None:
            raise ValueError("expected element_mm, the edge length of an element")
        if self.box_mm is not None and min(self.box_mm) <= 0:
            raise ValueError("expected sides longer than 0 mm")
        if self.box_mm is not None and self.element_mm is not None:
            count = np.array(self.box_mm) / self.element_mm
            if np.abs(count - np.round(count)).max() > 1e-6:
                raise ValueError(f"expected sides that are whole multiples of {self.element_mm} mm, or cells")
        if min((min(axes[:2]) for axes in [*(self.rectangles or []), *(self.ellipses or [])]), default=1) <= 0:
            raise ValueError("expected sections with a width and a height above 0")
        return self

    def build_solid(self, folder: Path, clamp: str) -> "Solid":
        """Mesh the shape.

        Args:
            folder: of the specimen file.
            clamp: fixed face, `x-min` ... `z-max`; the cells of a surface start there.

        Raises:
            InputError: the surface cannot be filled.
        """
        if self.box_mm is not None:
            size = 1e-3 * np.array(self.box_mm)
            cells = np.array(self.cells or np.round(size / (1e-3 * (self.element_mm or 1.0))), dtype=float)
            _check_count("geometry", cells, MAX_ELEMENTS)
            return Solid(HexMesh.box(cells.astype(int), size), float(size.prod()))
        element = 1e-3 * (self.element_mm or 1.0)
        if self.surface is not None:
            return fill_surface(folder / self.surface, element, clamp)
        grid = _rectangle_grid(self.rectangles) if self.rectangles is not None else _ellipse_grid(self.ellipses or [])
        _check_count("geometry", grid.sum(), MAX_ELEMENTS)
        return Solid(HexMesh.from_grid(grid, element), float(grid.sum() * element**3))


@dataclass(frozen=True)
class Solid:
    """Hexahedral mesh, and the volume of the exact shape [m^3]."""

    mesh: HexMesh
    volume: float


def _check_count(label: str, cells: ArrayLike, most: int = MAX_GRID_CELLS) -> None:
    """Raise InputError for more cells (x, y, z) than a computer can simulate."""
    count = float(np.prod(np.asarray(cells, dtype=float)))
    if not count <= most:
        raise InputError(
            f"{label}: expected at most {most} elements, found {count:.6g}; choose a larger element_mm (and "
            "are all lengths in mm?)"
        )


def _rectangle_grid(sections: list[tuple[int, int]]) -> NDArray[np.bool_]:
    """Which cells of a grid (X, Y, Z) the sections fill, centred."""
    width, height = max(w for w, _ in sections), max(h for _, h in sections)
    _check_count("rectangles", (len(sections), width, height))
    grid = np.zeros((len(sections), width, height), dtype=bool)
    for x, (w, h) in enumerate(sections):
        grid[x, (width - w) // 2 : (width + w) // 2, (height - h) // 2 : (height + h) // 2] = True
    return grid


def _ellipse_grid(sections: list[tuple[float, float] | tuple[float, float, float]]) -> NDArray[np.bool_]:
    """Which cells of a grid (X, Y, Z) have their centres inside the sections."""
    half_width, half_height = (int(max(axes[k] for axes in sections)) for k in (0, 1))
    _check_count("ellipses", (len(sections), 2 * half_width + 1, 2 * half_height + 1))
    y, z = np.arange(-half_width, half_width + 1)[:, None], np.arange(-half_height, half_height + 1)
    centre = [axes[2] if len(axes) == 3 else 0.0 for axes in sections]
    return np.array(
        [((y - c) / axes[0]) ** 2 + (z / axes[1]) ** 2 <= 1.0 for c, axes in zip(centre, sections, strict=True)]
    )


def fill_surface(path: Path, element: float, clamp: str) -> Solid:
    """Mesh a closed surface with the cells of a grid whose centres lie inside.

    The grid starts at the fixed face and is centred along the other axes, so that a symmetric surface gives a
    symmetric mesh.

    Args:
        path: of an STL, OBJ or PLY file in mm.
        element: edge length of a cell [m].
        clamp: fixed face, `x-min` ... `z-max`.

    Raises:
        InputError: no such file, no closed surface, cells too coarse or too fine, or a mesh in several pieces.
    """
    surface = read_surface(path)
    low, high = 1e-3 * surface.bounds
    cells = np.maximum(np.ceil((high - low) / element - 1e-6), 1.0)
    _check_count(f"surface {path}, {' x '.join(f'{x:.4g}' for x in 1e3 * (high - low))} mm", cells)
    count = cells.astype(int)
    origin = 0.5 * (low + high) - 0.5 * element * count
    axis = "xyz".index(clamp[0])
    origin[axis] = low[axis] if clamp.endswith("min") else high[axis] - element * count[axis]
    centres = origin + element * (np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1) + 0.5)
    parts = -(-count.prod() // QUERY_SIZE)
    inside = np.concatenate(
        [surface.contains(1e3 * part) for part in np.array_split(centres.reshape(-1, 3), parts)]
    ).reshape(count)
    if not inside.any():
        raise InputError(
            f"surface {path}: expected elements inside it, found none of {1e3 * element:g} mm; choose a smaller "
            "element_mm (and is the file in mm?)"
        )
    pieces = label(inside)[1]
    bodies = surface.body_count
    if 1 < bodies <= pieces:
        raise InputError(
            f"surface {path}: expected one body, found {bodies} that do not touch; join them, or export one of them"
        )
    if pieces > 1:
        raise InputError(
            f"surface {path}: expected elements in one piece, found {pieces} pieces of {1e3 * element:g} mm elements; "
            "choose a smaller element_mm"
        )
    _check_count(f"surface {path}", inside.sum(), MAX_ELEMENTS)
    mesh = HexMesh.from_grid(inside, element)
    return Solid(HexMesh(mesh.vertices + origin, mesh.hexes), 1e-9 * float(surface.volume))


def read_surface(path: Path) -> trimesh.Trimesh:
    """Read a closed surface [mm] and turn its normals outwards.

    Raises:
        InputError: no such file, no surface, or not closed.
    """
    require_file(path, "a surface (.stl, .obj or .ply)")
    if path.suffix.lower() not in SURFACES:
        raise InputError(f"expected a surface ({', '.join(SURFACES)}), found {path}; export it in one of these")
    try:
        with np.errstate(all="ignore"):  # of damaged numbers, which are refused below
            surface = trimesh.load_mesh(path, skip_materials=True)
    except Exception as error:  # its readers raise many kinds on damaged files; all mean the same to the user
        reason = " ".join(str(error).split())
        raise InputError(
            f"expected a surface in {path}, which cannot be read: {reason:.120}; export it again"
        ) from None
    if isinstance(surface, trimesh.Trimesh) and not (np.abs(surface.vertices) < LARGEST).all():
        raise InputError(f"surface {path}: expected coordinates in mm, found infinite ones; export it again")
    if not isinstance(surface, trimesh.Trimesh) or len(surface.faces) == 0:
        raise InputError(f"expected triangles in {path}, found none; export it again as a mesh")
    if not surface.is_watertight:
        _, triangles = np.unique(np.sort(surface.edges, axis=1), axis=0, return_counts=True)
        open_edges = int((triangles != 2).sum())
        raise InputError(
            f"surface {path}: expected a closed surface (watertight), found {open_edges} of {len(triangles)} edges "
            "that do not join two triangles; close its holes and export it again"
        )
    if not surface.is_winding_consistent:
        surface.fix_normals()
    if surface.volume < 0:
        surface.invert()
    return surface
