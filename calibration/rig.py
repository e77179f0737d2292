"""`calib.yaml`: the cameras of a rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field, field_validator

from rafl.calibration.camera import MAX_IMAGE_SIZE, Camera, OrthographicCamera, Perspective, PinholeCamera, Plane
from rafl.calibration.fields import Direction, PositivePair
from rafl.common.errors import InputError
from rafl.common.files import write_text
from rafl.common.names import Name, PathInside, check_distinct, require_names
from rafl.common.yaml_files import StrictModel, parse_yaml_text, read_yaml

FORMAT = "rafl-calibration/1"
LABEL = "a calibration (calib.yaml)"
PLANE_SIGMA_MM = 0.5  # of the markers' distances from their plane, unless given


@dataclass(frozen=True)
class Rig:
    """Cameras by name, in one world frame.

    Raises:
        InputError: a camera's name is invalid; videos and groups in HDF5 files are named after it.
    """

    cameras: dict[str, Camera]

    def __post_init__(self) -> None:
        require_names(self.cameras, "cameras")


@dataclass(frozen=True)
class BoardSource:
    """What a rig was calibrated from.

    Attributes:
        images: folder with one subfolder of board images per camera.
        board: description of the board.
    """

    images: Path
    board: Path


class _PlaneEntry(StrictModel):
    normal: Direction
    offset_mm: float
    sigma_mm: float = Field(PLANE_SIGMA_MM, gt=0)


class _PerspectiveEntry(StrictModel):
    distance_m: float = Field(gt=0)
    depth_mm: float
    centre_px: tuple[float, float]


class _Entry(StrictModel):
    image_size: tuple[int, int]
    rotation_vector: tuple[float, float, float] = (0.0, 0.0, 0.0)
    plane: _PlaneEntry | None = None
    time_offset_s: float = 0.0
    residual_px: float = Field(0.0, ge=0)
    covariance: list[list[float]] | None = None

    @field_validator("image_size")
    @classmethod
    def _check_size(cls, value: tuple[int, int]) -> tuple[int, int]:
        if not 0 < min(value) <= max(value) <= MAX_IMAGE_SIZE:
            raise ValueError(f"expected two positive numbers of at most {MAX_IMAGE_SIZE} px")
        return value

    @field_validator("covariance")
    @classmethod
    def _check_shape(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        if value is not None and [len(row) for row in value] != [10] * 10:
            raise ValueError("expected 10 rows of 10 numbers")
        return value

    def common_arguments(self) -> dict[str, Any]:
        """Arguments of the attributes that both camera models have, in SI units."""
        plane = None
        if self.plane is not None:
            plane = Plane(self.plane.normal, 1e-3 * self.plane.offset_mm, 1e-3 * self.plane.sigma_mm)
        return {
            "image_size": self.image_size,
            "rotation_vector": self.rotation_vector,
            "plane": plane,
            "time_offset": self.time_offset_s,
            "residual": self.residual_px,
            "covariance": None if self.covariance is None else tuple(map(tuple, self.covariance)),
        }


class _OrthographicEntry(_Entry):
    model: Literal["orthographic"]
    pixels_per_mm: PositivePair
    skew: float = 0.0
    offset_px: tuple[float, float]
    distortion: tuple[float, float] = (0.0, 0.0)
    perspective: _PerspectiveEntry | None = None

    def camera(self) -> Camera:
        """The camera, in SI units."""
        mx, my = self.pixels_per_mm
        seen = self.perspective
        return OrthographicCamera(
            scale=(1e3 * mx, 1e3 * my),
            skew=1e3 * self.skew,
            offset=self.offset_px,
            distortion=self.distortion,
            perspective=None if seen is None else Perspective(seen.distance_m, 1e-3 * seen.depth_mm, seen.centre_px),
            **self.common_arguments(),
        )


class _PinholeEntry(_Entry):
    model: Literal["pinhole"]
    focal_px: PositivePair
    centre_px: tuple[float, float]
    skew_px: float = 0.0
    translation_mm: tuple[float, float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def camera(self) -> Camera:
        """The camera, in SI units."""
        x, y, z = self.translation_mm
        return PinholeCamera(
            focal=self.focal_px,
            centre=self.centre_px,
            skew=self.skew_px,
            translation=(1e-3 * x, 1e-3 * y, 1e-3 * z),
            distortion=self.distortion,
            **self.common_arguments(),
        )


class _SourceEntry(StrictModel):
    images: PathInside
    board: PathInside


_CameraEntry = Annotated[_OrthographicEntry | _PinholeEntry, Field(discriminator="model")]


class _RigFile(StrictModel):
    format: str
    calibrated_from: _SourceEntry | None = None
    cameras: dict[Name, _CameraEntry] = Field(min_length=1)

    @field_validator("cameras")
    @classmethod
    def _check_distinct(cls, value: dict[str, _CameraEntry]) -> dict[str, _CameraEntry]:
        check_distinct(value)
        return value


def read_board_source(path: Path) -> BoardSource | None:
    """The board images from which `calib.yaml` was made; None if it does not name them.

    Raises:
        InputError: the file is missing, damaged or of a newer version, or names a folder elsewhere.
    """
    entry = read_yaml(path, _RigFile, LABEL, FORMAT).calibrated_from
    if entry is None:
        return None
    source = BoardSource(path.parent / entry.images, path.parent / entry.board)
    for part in (source.images, source.board):  # a link may lead elsewhere
        if not part.resolve().is_relative_to(path.parent.resolve()):
            raise InputError(f"{path}: expected board images in its folder, found {part} elsewhere; copy them there")
    return source


def read_calibration(path: str | Path) -> Rig:
    """Read `calib.yaml`.

    Raises:
        InputError: the file is missing, damaged or of a newer version.
    """
    path = Path(path)
    content = read_yaml(path, _RigFile, LABEL, FORMAT)
    return Rig({name: entry.camera() for name, entry in content.cameras.items()})


def parse_calibration(text: str, source: Path) -> Rig:
    """The rig that the content of `calib.yaml` describes.

    Args:
        text: the content, as `rig_text` writes it.
        source: the file that holds it, for error messages.

    Raises:
        InputError: the text is damaged or of a newer version.
    """
    content = parse_yaml_text(text, _RigFile, "a calibration", FORMAT, source)
    return Rig({name: entry.camera() for name, entry in content.cameras.items()})


def rig_text(rig: Rig, calibrated_from: dict[str, str] | None = None) -> str:
    """The content of `calib.yaml`; `calibrated_from` holds the paths of the images and of the board."""
    cameras = {name: _to_python(_entry(camera)) for name, camera in rig.cameras.items()}
    content: dict[str, object] = {"format": FORMAT}
    if calibrated_from is not None:
        content["calibrated_from"] = calibrated_from
    return yaml.safe_dump(content | {"cameras": cameras}, sort_keys=False, default_flow_style=None)


def _to_python(value: Any) -> Any:
    """Convert NumPy numbers to Python numbers, which YAML can write."""
    if isinstance(value, dict):
        return {key: _to_python(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_to_python(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _entry(camera: Camera) -> dict[str, object]:
    entry: dict[str, object] = {}
    if isinstance(camera, OrthographicCamera):
        entry |= {
            "model": "orthographic",
            "image_size": list(camera.image_size),
            "pixels_per_mm": [float(1e-3 * m) for m in camera.scale],
            "skew": float(1e-3 * camera.skew),
            "rotation_vector": list(camera.rotation_vector),
            "offset_px": list(camera.offset),
            "distortion": list(camera.distortion),
        }
        if camera.perspective is not None:
            entry["perspective"] = {
                "distance_m": camera.perspective.distance,
                "depth_mm": 1e3 * camera.perspective.depth,
                "centre_px": list(camera.perspective.centre),
            }
    elif isinstance(camera, PinholeCamera):
        entry |= {
            "model": "pinhole",
            "image_size": list(camera.image_size),
            "focal_px": list(camera.focal),
            "centre_px": list(camera.centre),
            "skew_px": camera.skew,
            "rotation_vector": list(camera.rotation_vector),
            "translation_mm": [float(1e3 * t) for t in camera.translation],
            "distortion": list(camera.distortion),
        }
    if camera.plane is not None:
        entry["plane"] = {
            "normal": list(camera.plane.normal),
            "offset_mm": 1e3 * camera.plane.offset,
            "sigma_mm": 1e3 * camera.plane.sigma,
        }
    entry |= {"time_offset_s": camera.time_offset, "residual_px": camera.residual}
    if camera.covariance is not None:
        entry["covariance"] = [list(row) for row in camera.covariance]
    return entry


def write_calibration(path: str | Path, rig: Rig, source: BoardSource | None = None) -> None:
    """Write `calib.yaml`, completely or not at all.

    Args:
        path: of the file.
        rig: the cameras.
        source: what they were calibrated from. The file names it if it lies below the file's folder.
    """
    path = Path(path)
    write_text(path, rig_text(rig, None if source is None else _paths_below(source, path.parent)))


def _paths_below(source: BoardSource, folder: Path) -> dict[str, str] | None:
    """The paths of a source as seen from a folder that contains it; None if the folder does not."""
    parts = {"images": source.images.resolve(), "board": source.board.resolve()}
    if not all(part.is_relative_to(folder.resolve()) for part in parts.values()):
        return None
    return {key: part.relative_to(folder.resolve()).as_posix() for key, part in parts.items()}
