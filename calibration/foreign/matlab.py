"""Calibrations of MATLAB's Computer Vision Toolbox, exported as plain structs."""

from pathlib import Path
from typing import Any

import numpy as np

from rafl.calibration.foreign.camera import (
    Array,
    ForeignCamera,
    read_distortion,
    read_image_size,
    read_matrix,
    read_numbers,
    read_rotation,
)
from rafl.calibration.foreign.mat_file import Unreadable, read_mat_variables
from rafl.common.errors import InputError
from rafl.common.units import METRES

EXPORT = "in MATLAB: s = toStruct(stereoParams); save('calib.mat', '-struct', 's', '-v7')"
MATRIX_KEYS = ("IntrinsicMatrix", "K")
POSES = (("R", "t"), ("R", "T"), ("r", "t"), ("RotationMatrix", "TranslationVector"))
BOARD_POSES = ("RotationVectors", "TranslationVectors")
RADIAL, TANGENTIAL = ("RadialDistortion", "RDistort"), ("TangentialDistortion", "TDistort")


def read_matlab(path: Path) -> tuple[list[ForeignCamera], float | None]:
    """Read stereoParameters (the world is the frame of camera 1), or cameras with intrinsic matrix and pose.

    MATLAB counts pixels from 1, and its matrices before release 2022b multiply row vectors: x = X R + t. An intrinsic
    matrix with its zeros above the diagonal is of this kind, and so is the rotation beside it.

    Returns:
        The cameras, and the unit of length [m] from `WorldUnits`, None if the file does not tell it.

    Raises:
        InputError: the file is damaged, holds objects instead of structs, or describes no cameras.
    """
    variables = read_mat_variables(path.read_bytes(), path.as_posix(), EXPORT)
    structs = _camera_structs(variables)
    if not structs:
        found = ", ".join(f"the {_kind(value)} {name}" for name, value in variables.items()) or "no variables"
        raise InputError(f"{path}: expected structs with the cameras' parameters, found {found:.80}; {EXPORT}")
    cameras: list[ForeignCamera] = []
    units: set[float | None] = set()
    for name, value in structs.items():
        where = f"{path}, {name}" if name else path.as_posix()
        if "CameraParameters1" in value:
            first, second = (value.get(f"CameraParameters{k}") for k in (1, 2))
            cameras.append(_camera(first, f"{where}, CameraParameters1", (np.eye(3), np.zeros(3))))
            cameras.append(_camera(second, f"{where}, CameraParameters2", _pose_of_camera_2(value, where)))
            units |= {_unit(first), _unit(second)}
        else:
            cameras.append(_camera(value, where, None, name if len(structs) > 1 else None))
            units.add(_unit(value))
    return cameras, units.pop() if len(units) == 1 else None


def _kind(value: Any) -> str:
    """Kind of a variable, for messages."""
    kinds: dict[type, str] = {Unreadable: "object", dict: "struct", str: "text", list: "cell"}
    return kinds.get(type(value), "array")


def _camera_structs(value: dict[str, Any], name: str = "") -> dict[str, dict[str, Any]]:
    """The structs of stereo pairs and cameras in a struct, by the name of their field."""
    if "CameraParameters1" in value or any(key in value for key in MATRIX_KEYS):
        return {name: value}
    found: dict[str, dict[str, Any]] = {}
    for key, inner in value.items():
        if isinstance(inner, dict):
            found |= _camera_structs(inner, str(key))
    return found


def _unit(camera: Any) -> float | None:
    return METRES.get(str(camera.get("WorldUnits", "")).strip().lower()) if isinstance(camera, dict) else None


def _camera(value: Any, where: str, pose: tuple[Array, Array] | None, name: str | None = None) -> ForeignCamera:
    """A camera from its struct, with a pose (R, t) that is known or stands in the struct."""
    key = next((key for key in MATRIX_KEYS if isinstance(value, dict) and key in value), None)
    if key is None:
        raise InputError(f"{where}: expected a struct with IntrinsicMatrix or K, found none; {EXPORT}")
    matrix = read_numbers(value[key], (3, 3), f"{where}, {key}")
    of_rows = bool(matrix[2, :2].any())
    matrix = read_matrix(matrix.T if of_rows else matrix, f"{where}, {key}")
    matrix[:2, 2] -= 1.0  # the first pixel is number 1
    radial = _coefficients(value, RADIAL, where)
    k1, k2, k3 = np.pad(radial[:3], (0, 3 - len(radial[:3])))
    p1, p2 = np.pad(_coefficients(value, TANGENTIAL, where)[:2], (0, 2))[:2]
    size = value.get("ImageSize")
    has_size = size is not None and np.size(size) > 0
    rotation, translation = pose or _own_pose(value, where, of_rows)
    return ForeignCamera(
        name=name,
        matrix=matrix,
        rotation=rotation,
        translation=translation,
        distortion=read_distortion([k1, k2, p1, p2, k3], where),
        image_size=read_image_size(np.ravel(size)[::-1], f"{where}, ImageSize") if has_size else None,
    )


def _coefficients(value: dict[str, Any], keys: tuple[str, str], where: str) -> Array:
    key = next((key for key in keys if key in value), None)
    return np.zeros(0) if key is None else read_numbers(value[key], (-1,), f"{where}, {key}")


def _own_pose(value: dict[str, Any], where: str, of_rows: bool) -> tuple[Array, Array]:
    """Rotation and translation from world to camera in a camera's struct."""
    for rotation, translation in POSES:
        if rotation in value and translation in value:
            matrix = read_rotation(value[rotation], f"{where}, {rotation}")
            return matrix.T if of_rows else matrix, read_numbers(value[translation], (3,), f"{where}, {translation}")
    rotation, translation = BOARD_POSES
    if np.size(value.get(rotation, ())) == 3 and np.size(value.get(translation, ())) == 3:
        return read_rotation(value[rotation], f"{where}, {rotation}"), read_numbers(value[translation], (3,), where)
    raise InputError(
        f"{where}: expected the camera's pose in the world, R and t beside its intrinsic matrix, found none; add them, "
        "or export stereoParams"
    )


def _pose_of_camera_2(value: dict[str, Any], where: str) -> tuple[Array, Array]:
    """Rotation and translation from camera 1 to camera 2."""
    pose = value.get("PoseCamera2")
    if isinstance(pose, dict) and "R" in pose and "Translation" in pose:
        return (
            read_rotation(pose["R"], f"{where}, PoseCamera2.R"),
            read_numbers(pose["Translation"], (3,), f"{where}, PoseCamera2.Translation"),
        )
    if "RotationOfCamera2" in value and "TranslationOfCamera2" in value:
        return (
            read_rotation(value["RotationOfCamera2"], f"{where}, RotationOfCamera2").T,
            read_numbers(value["TranslationOfCamera2"], (3,), f"{where}, TranslationOfCamera2"),
        )
    raise InputError(f"{where}: expected RotationOfCamera2 and TranslationOfCamera2, found none; {EXPORT}")
