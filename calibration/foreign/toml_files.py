"""Calibrations of aniposelib and Caliscope, in TOML files."""

import tomllib
from pathlib import Path
from typing import Any

from rafl.calibration.foreign.camera import (
    ForeignCamera,
    read_distortion,
    read_image_size,
    read_matrix,
    read_numbers,
    read_rotation,
    refuse_fisheye,
)
from rafl.common.errors import InputError


def read_toml(path: Path) -> list[ForeignCamera]:
    """Read the cameras of aniposelib (a table each, with a name) or of Caliscope (tables cameras.1, cameras.2, ...).

    Cameras that Caliscope ignores are left out. Its cameras have numbers, no names.

    Raises:
        InputError: the file is damaged, or describes no cameras.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"expected a calibration of aniposelib or Caliscope in {path}, found: {error}") from None
    inner = content.get("cameras", content)
    tables = {
        key: table
        for key, table in (inner.items() if isinstance(inner, dict) else ())
        if isinstance(table, dict) and "matrix" in table and table.get("ignore") is not True
    }
    if not tables:
        raise InputError(
            f"{path}: expected a table with a `matrix` for every camera, as aniposelib and Caliscope write, found "
            "none; is it the right file?"
        )
    return [_camera(tables[key], key, path) for key in sorted(tables, key=_numeric_key)]


def _numeric_key(key: str) -> tuple[int, str]:
    """Orders cam_2 before cam_10."""
    digits = "".join(filter(str.isdecimal, key))
    return int(digits[:9] or 0), key


def _camera(table: dict[str, Any], key: str, path: Path) -> ForeignCamera:
    name = table.get("name")
    where = f"{path}, camera {key if name is None else name}"
    for needed in ("rotation", "translation"):
        if table.get(needed) in (None, "null"):
            raise InputError(
                f"{where}: expected the camera's `{needed}` in the world, found none; calibrate the extrinsics of this "
                "camera too, or take it out of the file"
            )
    refuse_fisheye(table.get("fisheye"), where)
    size = table.get("size")
    return ForeignCamera(
        name=name,
        matrix=read_matrix(table["matrix"], f"{where}, matrix"),
        rotation=read_rotation(table["rotation"], f"{where}, rotation"),
        translation=read_numbers(table["translation"], (3,), f"{where}, translation"),
        distortion=read_distortion(table.get("distortions", []), f"{where}, distortions"),
        image_size=None if size is None else read_image_size(size, f"{where}, size"),
    )
