"""`calib.yaml`: the cameras of a rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from pydantic import Field, field_validator

from calibration.camera import OrthographicCamera, Plane
from groundwork import StrictModel, read_yaml, write_text

FORMAT = "rafl-calibration/1"
PLANE_SIGMA_MM = 0.5


@dataclass(frozen=True)
class Rig:
    """Cameras by name, in one world frame."""

    cameras: dict[str, OrthographicCamera]


class _PlaneEntry(StrictModel):
    normal: tuple[float, float, float]
    offset_mm: float
    sigma_mm: float = Field(PLANE_SIGMA_MM, gt=0)

    @field_validator("normal")
    @classmethod
    def _unit(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        if abs(np.linalg.norm(normal) - 1.0) > 1e-3:
            raise ValueError("expected a vector of length 1")
        return normal


class _CameraEntry(StrictModel):
    model: Literal["orthographic"]
    image_size: tuple[int, int]
    pixels_per_mm: tuple[float, float]
    skew: float = 0.0
    rotation_vector: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_px: tuple[float, float]
    distortion: tuple[float, float] = (0.0, 0.0)
    plane: _PlaneEntry | None = None
    time_offset_s: float = 0.0
    residual_px: float = Field(0.0, ge=0)
    covariance: list[list[float]] | None = None

    @field_validator("image_size", "pixels_per_mm")
    @classmethod
    def _positive(cls, value: tuple[float, float]) -> tuple[float, float]:
        if min(value) <= 0:
            raise ValueError("expected two positive numbers")
        return value

    @field_validator("covariance")
    @classmethod
    def _square(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        if value is not None and np.shape(value) != (10, 10):
            raise ValueError("expected 10 rows of 10 numbers")
        return value


class _RigFile(StrictModel):
    format: str
    cameras: dict[str, _CameraEntry] = Field(min_length=1)


def read_rig(path: Path) -> Rig:
    """Read `calib.yaml`.

    Raises:
        InputError: missing, damaged, or of a newer version.
    """
    content = read_yaml(path, _RigFile, "a calibration (calib.yaml)", FORMAT)
    return Rig({name: _camera(entry) for name, entry in content.cameras.items()})


def _camera(entry: _CameraEntry) -> OrthographicCamera:
    plane, covariance = None, None
    if entry.plane is not None:
        plane = Plane(entry.plane.normal, 1e-3 * entry.plane.offset_mm, 1e-3 * entry.plane.sigma_mm)
    if entry.covariance is not None:
        covariance = tuple(map(tuple, entry.covariance))
    mx, my = entry.pixels_per_mm
    return OrthographicCamera(
        entry.image_size,
        (1e3 * mx, 1e3 * my),
        1e3 * entry.skew,
        entry.rotation_vector,
        entry.offset_px,
        entry.distortion,
        plane,
        entry.time_offset_s,
        entry.residual_px,
        covariance,
    )


def rig_text(rig: Rig) -> str:
    """The content of `calib.yaml`."""
    cameras = {name: _entry(camera) for name, camera in rig.cameras.items()}
    return yaml.safe_dump({"format": FORMAT, "cameras": cameras}, sort_keys=False, default_flow_style=None)


def _entry(camera: OrthographicCamera) -> dict[str, object]:
    entry: dict[str, object] = {
        "model": "orthographic",
        "image_size": list(camera.image_size),
        "pixels_per_mm": [float(1e-3 * m) for m in camera.scale],
        "skew": float(1e-3 * camera.skew),
        "rotation_vector": list(camera.rotation_vector),
        "offset_px": list(camera.offset),
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


def write_rig(path: Path, rig: Rig) -> None:
    """Write `calib.yaml`, whole or not at all."""
    write_text(path, rig_text(rig))
