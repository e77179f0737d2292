"""Reading a calibration of any program as a rig."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from rafl.calibration.camera import PinholeCamera
from rafl.calibration.foreign.camera import ForeignCamera
from rafl.calibration.foreign.dlt import read_dlt
from rafl.calibration.foreign.matlab import read_matlab
from rafl.calibration.foreign.opencv import is_opencv_yaml, read_opencv, read_stereo_folder
from rafl.calibration.foreign.toml_files import read_toml
from rafl.calibration.rig import Rig, read_calibration
from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.common.names import require_names
from rafl.common.units import METRES, Unit

MAX_BYTES = 2**22  # a calibration with all its board points has some hundred kB
OPENCV_SUFFIXES = (".yml", ".yaml", ".xml")
LABEL = "a calibration (calib.yaml, or one of OpenCV, aniposelib, Caliscope, MATLAB or DLT coefficients)"

ImageSizes = Mapping[str, tuple[int, int]]  # width and height [px] by camera


def read_any_calibration(
    path: Path, unit: str | None = None, image_sizes: Callable[[int], ImageSizes] = lambda _: {}
) -> Rig:
    """Read `calib.yaml`, or a calibration that another program wrote.

    Cameras without names, in files that know only their order, take the names of the filmed cameras, in order.

    Args:
        path: file, or folder of files of OpenCV or MATLAB with one camera each, named after the cameras.
        unit: mm, cm or m: unit of the lengths in a file that does not state it.
        image_sizes: asked for cameras without name or image size; takes the number of cameras in the file, and returns
            the image sizes of the filmed cameras, in order.

    Raises:
        InputError: the file is missing or damaged, describes no pinhole cameras, leaves the unit or the image size
            open, or its cameras are not the filmed ones.
    """
    if path.is_file() and path.suffix.lower() in (".yaml", ".yml") and not is_opencv_yaml(_start_of_text(path)):
        if unit is not None:
            raise InputError(f"{path} states its unit in its keys (translation_mm); leave out the unit {unit}")
        return read_calibration(path)
    cameras, own_unit = _read_folder(path) if path.is_dir() else _read_file(require_file(path, LABEL))
    scale = _scale(path, unit, own_unit)
    known: ImageSizes = {}
    if any(camera.name is None or camera.image_size is None for camera in cameras):
        known = image_sizes(len(cameras))
    names = _names(path, cameras, known)
    found = {name: _camera(path, name, item, scale, known) for name, item in zip(names, cameras, strict=True)}
    _check_places(path, found)
    return Rig(dict(found))


def _start_of_text(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.read(MAX_BYTES).decode("utf-8", "replace")


def _read_file(path: Path) -> tuple[list[ForeignCamera], float | None]:
    """The cameras of a file, and the unit of length [m] that it states."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"expected {LABEL} at {path}, found a file of {size / 1e6:.0f} MB; is it the right file?")
    suffix = path.suffix.lower()
    if suffix == ".mat":
        return read_matlab(path)
    readers = {".toml": read_toml, ".csv": read_dlt} | dict.fromkeys(OPENCV_SUFFIXES, read_opencv)
    if suffix not in readers:
        raise InputError(f"expected {LABEL} at {path}, found the file type {suffix or 'without ending'!r}; convert it")
    return readers[suffix](path), None


def _read_folder(folder: Path) -> tuple[list[ForeignCamera], float | None]:
    """The cameras of a folder of files with one camera each."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (*OPENCV_SUFFIXES, ".mat"))
    if not paths:
        raise InputError(f"expected files of OpenCV or MATLAB with one camera each in {folder}, found none; check it")
    opencv = [path for path in paths if path.suffix.lower() != ".mat"]
    if len(opencv) == len(paths) and (pair := read_stereo_folder(opencv)) is not None:
        return pair, None
    cameras, units = [], set()
    for path in paths:
        found, unit = _read_file(path)
        if len(found) != 1:
            raise InputError(
                f"{path}: expected one camera in every file of {folder}, found {len(found)}; name this file itself"
            )
        cameras.append(replace(found[0], name=path.stem))
        units.add(unit)
    return cameras, units.pop() if len(units) == 1 else None


def _scale(path: Path, given: str | None, stated: float | None) -> float:
    """The unit of length of a file [m]."""
    if given is not None and given not in list(Unit):
        raise InputError(f"expected a unit out of {', '.join(Unit)}, found {given!r}")
    if stated is None and given is None:
        raise InputError(
            f"{path} does not state the unit of its translations; state it, for instance with --calib-unit mm"
        )
    if stated is not None and given is not None and not np.isclose(stated, METRES[given]):
        raise InputError(f"{path} states a unit of {stated:g} m, found --calib-unit {given}; leave the option out")
    return METRES[given] if given is not None else stated or 0.0


def _names(path: Path, cameras: list[ForeignCamera], known: ImageSizes) -> list[str]:
    """Names of the cameras: those in the file, or else those of the filmed cameras, in order."""
    names = [camera.name for camera in cameras]
    if None in names:
        if known and len(known) != len(cameras):
            raise InputError(
                f"{path}: expected as many cameras as were filmed ({', '.join(known)}), found {len(cameras)} without "
                "names; take out the others, or film with all"
            )
        return list(known) or [f"camera{k + 1}" for k in range(len(cameras))]
    found = [str(name) for name in names]
    require_names(found, f"cameras in {path}")
    return found


def _camera(path: Path, name: str, camera: ForeignCamera, scale: float, known: ImageSizes) -> PinholeCamera:
    size = camera.image_size or known.get(name)
    if size is None and known and len(known) == 1:
        size = next(iter(known.values()))
    if size is None:
        raise InputError(
            f"{path}: expected the image size of camera {name}, found none in the file, and no videos of {name}"
            f"{' among those of ' + ', '.join(known) if known else ''}; name the camera as in the file"
        )
    return camera.pinhole(scale, size)


def _check_places(path: Path, cameras: dict[str, PinholeCamera]) -> None:
    """Refuse two cameras at the same place: they give no depth."""
    centres = {name: -camera.rotation.T @ np.asarray(camera.translation) for name, camera in cameras.items()}
    for one, other in combinations(centres, 2):
        if np.array_equal(centres[one], centres[other]):
            raise InputError(
                f"{path}: expected cameras at different places, found {one} and {other} at the same; is one a copy of "
                "the other?"
            )
