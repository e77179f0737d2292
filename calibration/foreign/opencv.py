"""Calibrations in OpenCV's YAML and XML files."""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rafl.calibration.foreign.camera import (
    Array,
    ForeignCamera,
    read_distortion,
    read_image_size,
    read_matrix,
    read_numbers,
    read_rotation,
    refuse_fisheye,
)
from rafl.common.errors import InputError

# Keys in use, without capitals and underscores. The number of the camera follows in files of stereo pairs.
MATRIX_KEYS = ("cameramatrix", "intrinsicmatrix", "intrinsics", "mtx", "m", "k")
DISTORTION_KEYS = ("distortioncoefficients", "distcoeffs", "distcoeff", "distortion", "dist", "d")
ROTATION_KEYS = ("rvec", "rotationvector", "rotationmatrix", "rotation", "rmat", "r")
TRANSLATION_KEYS = ("tvec", "translationvector", "translation", "t")
POSE_KEYS = ("extrinsics", "extrinsicparameters", "extrinsicmatrix", "extrinsic")
SIZE_KEYS = (("imagewidth", "imageheight"), ("width", "height"))
POSE = "rvec and tvec, R and T, or extrinsics"


class _Loader(yaml.CSafeLoader):
    """Reads OpenCV's tagged matrices as plain mappings."""


def _construct_mapping(loader: _Loader, _suffix: str, node: yaml.Node) -> dict[Any, Any]:
    assert isinstance(node, yaml.MappingNode)
    return loader.construct_mapping(node, deep=True)


_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _construct_mapping)


def is_opencv_yaml(text: str) -> bool:
    """Whether the text of a YAML file is OpenCV's: it starts with a directive, or a line with an intrinsic matrix."""
    keys = {
        _plain(line.partition(":")[0].strip("\"' ")) for line in text.splitlines() if ":" in line and line[0] != " "
    }
    return text.startswith("%YAML") or any(
        key + number in keys for key in MATRIX_KEYS for number in ("", "1") if key + number != "k1"
    )


def read_opencv(path: Path) -> list[ForeignCamera]:
    """Read a file with one camera, or with a stereo pair whose world is the frame of camera 1.

    Raises:
        InputError: the file is damaged, or does not describe such cameras.
    """
    return _cameras(_read_content(path), path)


def read_stereo_folder(paths: list[Path]) -> list[ForeignCamera] | None:
    """Read a stereo pair from files of which one has the intrinsic matrices and another one the pose.

    Returns None if no file has the intrinsic matrices of a pair.

    Raises:
        InputError: a file is damaged, or the files do not describe such a pair.
    """
    contents = [_read_content(path) for path in paths]
    if not any(_find(content, MATRIX_KEYS, "1") for content in contents):
        return None
    return _cameras({key: value for content in contents for key, value in content.items()}, paths[0].parent)


def _plain(key: Any) -> str:
    return str(key).lower().replace("_", "")


def _read_content(path: Path) -> dict[str, Any]:
    """The values of a file by key, without capitals and underscores."""
    content: Any
    try:
        if path.suffix.lower() == ".xml":
            root = ElementTree.fromstring(path.read_bytes())
            content = {element.tag: _xml_value(element) for element in root}
        else:
            text = path.read_text(encoding="utf-8")
            # OpenCV 2 and 3 write a directive that is no YAML: %YAML:1.0
            text = text.partition("\n")[2] if text.startswith("%YAML") else text
            # Aliases make a short file long. OpenCV writes none.
            if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.CSafeLoader)):
                raise InputError(f"{path}: expected a calibration of OpenCV, found YAML aliases; write the values out")
            content = yaml.load(text, _Loader)
    except (ElementTree.ParseError, yaml.YAMLError, ValueError, AssertionError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"expected a calibration of OpenCV in {path}, which is not readable: {reason}") from None
    if not isinstance(content, dict):
        raise InputError(f"expected a calibration of OpenCV in {path}, found no keys and values; is it the right file?")
    return {_plain(key): value for key, value in content.items()}


def _xml_value(element: ElementTree.Element) -> Any:
    """The value of an XML element: a mapping, a list of words, or a single word."""
    if len(element):
        return {part.tag: _xml_value(part) for part in element}
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words


def _find(content: dict[str, Any], keys: tuple[str, ...], number: str = "") -> str | None:
    """The first of some keys, with a camera's number, that a file has."""
    return next((key + number for key in keys if content.get(key + number) is not None), None)


def _value(value: Any, where: str) -> Any:
    """The value of a key. OpenCV's matrices, mappings with data and its shape, become arrays."""
    if not isinstance(value, dict) or "data" not in value:
        return value
    extents = value["sizes"] if "sizes" in value else [value.get("rows"), value.get("cols")]
    shape = read_numbers(extents, (-1,), f"{where}, shape").astype(int).tolist()
    data = read_numbers(value["data"], (-1,), where)
    if min(shape, default=0) < 1 or len(data) != math.prod(shape):
        raise InputError(
            f"{where}: expected a matrix, found {len(data)} numbers for {' x '.join(map(str, shape))}; the file is "
            "damaged, export it again"
        )
    return data.reshape(shape)


def _cameras(content: dict[str, Any], path: Path) -> list[ForeignCamera]:
    """The cameras of a file from its values."""
    if _find(content, MATRIX_KEYS) is None and _find(content, MATRIX_KEYS, "1"):
        return [_camera(content, path, "1", (np.eye(3), np.zeros(3))), _camera(content, path, "2")]
    return [_camera(content, path, "")]


def _camera(content: dict[str, Any], path: Path, number: str, pose: tuple[Array, Array] | None = None) -> ForeignCamera:
    """One camera of a file. Its pose (R, t) is that in the file if none is given."""
    where = f"{path}{f', camera {number}' if number else ''}"
    matrix = _find(content, MATRIX_KEYS, number)
    if matrix is None:
        raise InputError(
            f"{where}: expected an intrinsic matrix (camera_matrix, or M1 and M2 of a stereo pair), found the keys "
            f"{', '.join(content)[:80]}; is it a calibration of OpenCV?"
        )
    refuse_fisheye(read_numbers(content.get("fisheyemodel", 0), (1,), f"{where}, fisheye_model").any(), where)
    refuse_fisheye(content.get("distortionmodel") in ("equidistant", "fisheye"), where)
    distortion = _find(content, DISTORTION_KEYS, number)
    coefficients = _value(content[distortion], f"{where}, {distortion}") if distortion else []
    intrinsic = read_matrix(_value(content[matrix], f"{where}, {matrix}"), f"{where}, {matrix}")
    rotation, translation = pose or _pose(content, path)
    return ForeignCamera(
        name=None,
        matrix=intrinsic,
        rotation=rotation,
        translation=translation,
        distortion=read_distortion(coefficients, f"{where}, {distortion}"),
        image_size=_image_size(content, where),
    )


def _image_size(content: dict[str, Any], where: str) -> tuple[int, int] | None:
    """Width and height [px]; None if the file does not tell them."""
    for keys in SIZE_KEYS:
        if all(key in content for key in keys):
            return read_image_size([content[key] for key in keys], f"{where}, {' and '.join(keys)}")
    for key in ("imagesize", "size", "resolution"):
        if content.get(key) is not None:
            return read_image_size(_value(content[key], f"{where}, {key}"), f"{where}, {key}")
    return None


def _pose(content: dict[str, Any], path: Path) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3) of the world, or of a pair's first camera, to the camera."""
    key = _find(content, POSE_KEYS)
    if key is not None:
        where = f"{path}, {key}"
        numbers = read_numbers(_value(content[key], where), (-1,), where)
        if len(numbers) == 6:
            return read_rotation(numbers[:3], where), numbers[3:]
        if len(numbers) in (12, 16):
            matrix = numbers.reshape(-1, 4)
            return read_rotation(matrix[:3, :3], where), matrix[:3, 3]
        raise InputError(
            f"{where}: expected one pose of the camera (6, 12 or 16 numbers), found {len(numbers)} numbers; keep the "
            "pose of the board that lies in the world frame"
        )
    rotation, translation = _find(content, ROTATION_KEYS), _find(content, TRANSLATION_KEYS)
    if rotation is None or translation is None:
        raise InputError(
            f"{path}: expected the pose of the camera in the world ({POSE}), found no such keys; a calibration of the "
            "lens alone does not tell where the camera stands"
        )
    return (
        read_rotation(_value(content[rotation], f"{path}, {rotation}"), f"{path}, {rotation}"),
        read_numbers(_value(content[translation], f"{path}, {translation}"), (3,), f"{path}, {translation}"),
    )
