"""The marker layout: names and positions of the markers on the undeformed specimen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag

from rafl.common.names import Name, check_distinct
from rafl.common.yaml_files import StrictModel, read_yaml

SPECIMEN_FORMAT = "rafl-specimen/1"
MAX_GRID_LINES = 100  # rows, and columns, of a grid
PLACE_DIGITS = 3  # of at_mm; places that agree in them are one
DEFAULT_SIGMA_MM = 0.5  # standard deviation of a dot that a hand places with a ruler or a stencil


class MarkerEntry(StrictModel):
    """One marker of a specimen."""

    name: Name
    at_mm: tuple[float, float, float]
    at_sigma_mm: float = Field(default=DEFAULT_SIGMA_MM, ge=0)

    def markers(self) -> list["MarkerEntry"]:
        """The marker itself."""
        return [self]


# Directions of the columns and rows of a grid, by the axis of its face.
GRID_DIRECTIONS = {
    "x": ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    "y": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "z": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
}


class MarkerGrid(StrictModel):
    """Markers in rows and columns on one face, numbered row by row: `L` gives L1, L2, and so on.

    `at_mm` is the first one. On the side faces columns follow x and rows go down; on top and bottom rows follow y; on
    the ends columns follow y and rows go down. `spacing_mm` is that of columns and of rows, or one number for both.
    """

    name: Name
    face: Literal["x-min", "x-max", "y-min", "y-max", "z-min", "z-max"]
    at_mm: tuple[float, float, float]
    rows: int = Field(ge=1, le=MAX_GRID_LINES)
    columns: int = Field(ge=1, le=MAX_GRID_LINES)
    spacing_mm: Annotated[float, Field(gt=0)] | tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    at_sigma_mm: float = Field(default=DEFAULT_SIGMA_MM, ge=0)

    def markers(self) -> list[MarkerEntry]:
        """The markers of the grid."""
        spacing = self.spacing_mm if isinstance(self.spacing_mm, tuple) else (self.spacing_mm, self.spacing_mm)
        across, down = np.array(GRID_DIRECTIONS[self.face[0]]) * np.array(spacing)[:, None]
        entries = []
        for number, (row, column) in enumerate(np.ndindex(self.rows, self.columns), start=1):
            x, y, z = (self.at_mm + row * down + column * across).round(9).tolist()
            entries.append(MarkerEntry(name=f"{self.name}{number}", at_mm=(x, y, z), at_sigma_mm=self.at_sigma_mm))
        return entries


def _check_distinct(items: list[MarkerEntry | MarkerGrid]) -> list[MarkerEntry | MarkerGrid]:
    """Raise ValueError if two markers have one name or one place."""
    markers = [marker for item in items for marker in item.markers()]
    check_distinct(marker.name for marker in markers)
    names: dict[tuple[float, ...], str] = {}
    for marker in markers:
        place = tuple(round(value, PLACE_DIGITS) + 0.0 for value in marker.at_mm)
        if place in names:
            raise ValueError(
                f"expected markers at different places, found {names[place]} and {marker.name} both at {list(place)} mm"
            )
        names[place] = marker.name
    return items


def _kind(value: object) -> str:
    return "<grid>" if isinstance(value, MarkerGrid) or (isinstance(value, dict) and "rows" in value) else "<marker>"


_Item = Annotated[Annotated[MarkerEntry, Tag("<marker>")] | Annotated[MarkerGrid, Tag("<grid>")], Discriminator(_kind)]
MarkerList = Annotated[list[_Item], AfterValidator(_check_distinct)]


class _Body(BaseModel):
    """The size of a box; other shapes are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    box_mm: tuple[float, float, float] | None = None


class MarkerEntries(BaseModel):
    """The part of a specimen file that tracking reads. Other keys are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    format: str
    geometry: _Body | None = None
    markers: Annotated[MarkerList, Field(min_length=1)]


@dataclass(frozen=True)
class MarkerLayout:
    """The markers of a specimen.

    Attributes:
        names: (M).
        positions: at rest, in the specimen frame, as described [m], (M, 3).
        sigma: standard deviations of the positions [m], (M), or one for all.
        box: size of the specimen [m], (3), if it is a box with a corner in the origin; None if that is not known.
    """

    names: tuple[str, ...]
    positions: NDArray[np.float64]
    sigma: NDArray[np.float64] | float = 1e-3 * DEFAULT_SIGMA_MM
    box: tuple[float, float, float] | None = None

    @classmethod
    def of(cls, items: Sequence[MarkerEntry | MarkerGrid]) -> "MarkerLayout":
        """From a specimen file's entries."""
        markers = [marker for item in items for marker in item.markers()]
        positions = 1e-3 * np.array([marker.at_mm for marker in markers], dtype=float).reshape(-1, 3)
        sigma = 1e-3 * np.array([marker.at_sigma_mm for marker in markers], dtype=float)
        return cls(tuple(marker.name for marker in markers), positions, sigma)


def read_layout(path: Path) -> MarkerLayout:
    """Read the markers of a specimen file (specimen.yaml).

    Raises:
        InputError: the file is missing, damaged, or of a newer version.
    """
    content = read_yaml(path, MarkerEntries, "a specimen (specimen.yaml)", SPECIMEN_FORMAT)
    layout = MarkerLayout.of(content.markers)
    if content.geometry is None or content.geometry.box_mm is None:
        return layout
    x, y, z = content.geometry.box_mm
    return replace(layout, box=(1e-3 * x, 1e-3 * y, 1e-3 * z))
