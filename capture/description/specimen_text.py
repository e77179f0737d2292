"""The text of a specimen file, and the body that a size or a surface describes."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from rafl.capture.specimen.geometry import read_surface
from rafl.capture.specimen.specimen import Body, read_specimen_file
from rafl.common.errors import InputError
from rafl.tracking.linking.layout import SPECIMEN_FORMAT

Array = NDArray[Any]

ELEMENT_MM = 10.0  # edge of the elements of the specimens that come with the package
# Elements across the thinnest side, at least. Two bend right; a surface needs more, because its elements have steps.
MIN_ACROSS_BOX, MIN_ACROSS_SURFACE = 2, 4
MAX_ELEMENTS = 5000  # a simulation with more takes hours to fit
# The silicone of the specimens that come with the package: E [Pa], nu, density [kg/m^3].
ASSUMED_MATERIAL = {"youngs_modulus": 215856, "poissons_ratio": 0.45, "density": 1070}


def body_of_box(name: str, size_mm: tuple[float, float, float], element_mm: float | None) -> Body:
    """A box clamped at x-min, with elements as near to `element_mm` as its sides allow.

    Raises:
        InputError: it is so thin that it would need too many elements.
    """
    size = np.array(size_mm)
    element = element_mm or min(ELEMENT_MM, size.min() / MIN_ACROSS_BOX)
    cells = np.maximum(np.rint(size / element), 1.0).astype(int)
    _check_count(int(cells.prod()), element, size)
    shape: dict[str, object] = {"box_mm": [float(f"{x:g}") for x in size]}
    even = np.allclose(cells * element, size, rtol=1e-9)
    shape |= {"element_mm": float(f"{element:g}")} if even else {"cells": cells.tolist()}
    return _body(name, shape)


def body_of_surface(name: str, surface: Path, element_mm: float | None, folder: Path) -> Body:
    """A body within a closed surface, clamped at x-min.

    Args:
        name: of the specimen.
        surface: STL, OBJ or PLY file in mm.
        element_mm: edge of the elements; None for one that the thinnest side needs.
        folder: of the specimen file, which names the surface relative to it.

    Raises:
        InputError: no such surface, it lies in another folder, or it is so thin that it would need too many elements.
    """
    size = np.ptp(read_surface(surface).bounds, axis=0)
    element = element_mm or float(f"{min(ELEMENT_MM, size.min() / MIN_ACROSS_SURFACE):.2g}")
    _check_count(int(np.ceil(size / element).prod()), element, size)
    return _body(name, {"surface": relative_path(surface, folder), "element_mm": element})


def body_like(name: str, path: Path, folder: Path) -> Body:
    """The body of another specimen file, whose markers are left out.

    Raises:
        InputError: the file cannot be read, or its surface lies in another folder.
    """
    content = read_specimen_file(path)
    values = content.model_dump(exclude_unset=True, exclude={"markers"}) | {"name": name}
    if content.geometry.surface is not None:
        values["geometry"]["surface"] = relative_path(path.parent / content.geometry.surface, folder)
    return Body.model_validate(values)


def _check_count(count: int, element: float, size: Array) -> None:
    if count > MAX_ELEMENTS:
        raise InputError(
            f"expected a body of at most {MAX_ELEMENTS} elements, found {count} of {element:.3g} mm in "
            f"{' x '.join(f'{x:.4g}' for x in size)} mm; if the size is right, the body is thin: choose --element-mm"
        )


def _body(name: str, shape: dict[str, object]) -> Body:
    return Body.model_validate(
        {
            "format": SPECIMEN_FORMAT,
            "name": name,
            "geometry": shape,
            "material": ASSUMED_MATERIAL,
            "clamp": {"face": "x-min"},
            "load": {"face": "x-max"},
        }
    )


def specimen_name(path: Path) -> str:
    """The name of a specimen whose file has this path."""
    return re.sub(r"[^\w.-]", "-", path.stem)


def relative_path(path: Path, folder: Path) -> str:
    """The path of a file as seen from a folder that contains it.

    Raises:
        InputError: the folder does not contain it; a specimen file names no files elsewhere.
    """
    relative = Path(os.path.relpath(path, folder))
    if ".." in relative.parts:
        raise InputError(
            f"expected {path.name} beside the specimen file, in {folder}, found it elsewhere; copy it there"
        )
    return relative.as_posix()


def specimen_text(body: Body, markers: list[dict[str, object]], remarks: dict[str, str]) -> str:
    """The text of a specimen file.

    Args:
        body: all but the markers.
        markers: entries of the list.
        remarks: comments by the key that they stand before; the one of the empty key stands first.
    """
    lines = [f"# {remarks['']}"]
    for key, value in body.model_dump(exclude_unset=True, mode="json").items():
        lines += [f"# {remarks[key]}"] if key in remarks else []
        lines.append(f"{key}: {_flow(value)}")
    lines += [f"# {remarks['markers']}"] if "markers" in remarks else []
    return "\n".join([*lines, "markers:", *(f"  - {_flow(entry)}" for entry in markers), ""])


def _flow(value: object) -> str:
    """A value as YAML on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1e9)
    return text.removesuffix("\n").removesuffix("\n...")
