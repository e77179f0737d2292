"""A stereo pair of pinhole cameras, and the files in which other programs describe it."""

from pathlib import Path

import cv2
import numpy as np
import scipy.io

SIZE = (1280, 720)
MATRICES = {
    "left": np.array([[14400.0, 0.0, 633.5], [0.0, 14390.0, 355.25], [0.0, 0.0, 1.0]]),
    "right": np.array([[14100.0, 0.0, 650.0], [0.0, 14120.0, 362.0], [0.0, 0.0, 1.0]]),
}
DISTORTIONS = {"left": [0.31, -1.5, 2e-3, -1e-3, 4.0], "right": [-0.2, 0.7, -1e-3, 5e-4, 0.0]}
ROTATIONS = {"left": np.array([1.57, 0.02, -0.03]), "right": np.array([1.45, 0.35, -0.4])}
TRANSLATIONS_MM = {"left": np.array([-58.0, -8.0, 2000.0]), "right": np.array([-40.0, 12.0, 1900.0])}
POINTS_MM = np.random.default_rng(3).uniform([0, -20, -40], [110, 40, 40], (40, 3))


def rotation(name: str) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(ROTATIONS[name])[0])


def opencv_pixels(name: str, points_mm: np.ndarray = POINTS_MM, *, distorted: bool = True) -> np.ndarray:
    """Pixels (N, 2) of world points by OpenCV."""
    distortion = np.array(DISTORTIONS[name] if distorted else [0.0] * 5)
    pixels = cv2.projectPoints(points_mm, ROTATIONS[name], TRANSLATIONS_MM[name], MATRICES[name], distortion)[0]
    return np.asarray(pixels[:, 0])


def write_opencv(path: Path, values: dict[str, object]) -> None:
    """A file by OpenCV's own writer."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


def opencv_values(name: str) -> dict[str, object]:
    return {
        "image_width": SIZE[0],
        "image_height": SIZE[1],
        "camera_matrix": MATRICES[name],
        "distortion_coefficients": np.array([DISTORTIONS[name]]),
        "rvec": ROTATIONS[name],
        "tvec": TRANSLATIONS_MM[name],
    }


def aniposelib_text() -> str:
    tables = [
        f'[cam_{k}]\nname = "{name}"\nsize = [{SIZE[0]}, {SIZE[1]}]\nmatrix = {MATRICES[name].tolist()}\n'
        f"distortions = {DISTORTIONS[name]}\nrotation = {ROTATIONS[name].tolist()}\n"
        f"translation = {TRANSLATIONS_MM[name].tolist()}\n"
        for k, name in enumerate(MATRICES)
    ]
    return "\n".join([*tables, "[metadata]\nadjusted = false\nerror = 0.4\n"])


def projection(name: str) -> np.ndarray:
    """K [R t], (3, 4)."""
    return np.asarray(MATRICES[name] @ np.column_stack([rotation(name), TRANSLATIONS_MM[name]]))


def dlt_coefficients(name: str) -> np.ndarray:
    """Coefficients (11) with the pixel (1, 1) at the lower left, which leave out the distortion."""
    flipped = np.array([[1.0, 0.0, 1.0], [0.0, -1.0, SIZE[1]], [0.0, 0.0, 1.0]]) @ projection(name)
    return np.asarray((flipped / flipped[2, 3]).ravel()[:11])


def write_dlt(path: Path) -> None:
    np.savetxt(path, np.column_stack([dlt_coefficients(name) for name in MATRICES]), delimiter=",", fmt="%.18e")


def relative_pose() -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3) [mm] from the left to the right camera."""
    turn = rotation("right") @ rotation("left").T
    return turn, TRANSLATIONS_MM["right"] - turn @ TRANSLATIONS_MM["left"]


def matlab_struct(name: str) -> dict[str, object]:
    """A camera as MATLAB's `toStruct` gives it: matrices for row vectors, pixels counted from 1."""
    k1, k2, p1, p2, k3 = DISTORTIONS[name]
    matrix = MATRICES[name] + np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    return {
        "RadialDistortion": [k1, k2, k3],
        "TangentialDistortion": [p1, p2],
        "ImageSize": [float(SIZE[1]), float(SIZE[0])],
        "WorldUnits": "millimeters",
        "IntrinsicMatrix": matrix.T,
    }


def write_matlab_stereo(path: Path) -> None:
    turn, shift = relative_pose()
    pair = {
        "CameraParameters1": matlab_struct("left"),
        "CameraParameters2": matlab_struct("right"),
        "RotationOfCamera2": turn.T,
        "TranslationOfCamera2": shift,
    }
    scipy.io.savemat(path, {"stereoParams": pair})
