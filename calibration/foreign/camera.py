"""One camera of a calibration of another program, and the checks of its numbers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import MAX_IMAGE_SIZE, PinholeCamera
from rafl.common.errors import InputError

Array = NDArray[Any]

MAX_NUMBER = 1e15  # no unit makes any number of a calibration so large
ROTATION_TOLERANCE = 1e-3  # of R R^T against the identity: matrices are printed with few digits
MATRIX_TOLERANCE = 1e-9  # of the zeros and the one of an intrinsic matrix, relative to its largest entry
# The coefficients that follow k1, k2, p1, p2, k3 in OpenCV: the rational, thin prism and tilted models.
FURTHER_COEFFICIENTS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")


@dataclass(frozen=True)
class ForeignCamera:
    """A pinhole camera as a file describes it: u = K (R X + t).

    Attributes:
        name: in the file; None if cameras have only a place in its order.
        matrix: K, upper triangular [px], (3, 3).
        rotation: R, world to camera, (3, 3).
        translation: t, in the file's unit of length, (3).
        distortion: k1, k2, p1, p2, k3.
        image_size: width and height [px]; None if the file does not tell it.
        from_bottom: whether v is counted upwards, so that v' = height - v is ours.
    """

    name: str | None
    matrix: Array
    rotation: Array
    translation: Array
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    image_size: tuple[int, int] | None = None
    from_bottom: bool = False

    def pinhole(self, unit: float, image_size: tuple[int, int]) -> PinholeCamera:
        """The camera in SI units.

        Args:
            unit: the file's unit of length [m].
            image_size: width and height [px].
        """
        matrix = self.matrix
        if self.from_bottom:
            matrix = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, image_size[1]], [0.0, 0.0, 1.0]]) @ matrix
        (fx, skew, cx), (_, fy, cy), _ = matrix.tolist()
        a, b, c = Rotation.from_matrix(self.rotation).as_rotvec().tolist()
        x, y, z = (unit * self.translation).tolist()
        return PinholeCamera(
            image_size=image_size,
            rotation_vector=(a, b, c),
            focal=(fx, fy),
            centre=(cx, cy),
            skew=skew,
            translation=(x, y, z),
            distortion=self.distortion,
        )


def read_numbers(value: Any, shape: tuple[int, ...], where: str) -> Array:
    """Finite numbers of a given shape. An extent of -1 fits any length; lists need not be nested as the shape is.

    Args:
        value: as read from a file.
        shape: of the result.
        where: file, camera and key, for messages.

    Raises:
        InputError: they are no such numbers.
    """
    count = "some" if -1 in shape else int(np.prod(shape))
    expected = f"{where}: expected {count} numbers{' (' + ' x '.join(map(str, shape)) + ')' if len(shape) > 1 else ''}"
    try:
        numbers = np.asarray(value)
        if numbers.dtype.kind not in "OUSbiuf":
            raise ValueError
        numbers = numbers.astype(float).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{expected}, found {_shortened(value)}; export the calibration again") from None
    if not np.isfinite(numbers).all():
        raise InputError(f"{expected}, found some that are not finite; export the calibration again")
    if (np.abs(numbers) > MAX_NUMBER).any():
        raise InputError(f"{expected} below {MAX_NUMBER:g}, found others; export the calibration again")
    return numbers


def _shortened(value: Any) -> str:
    """A value on one line, for messages."""
    text = " ".join(f"{value!r:.200}".split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_image_size(value: Any, where: str) -> tuple[int, int]:
    """Width and height [px].

    Raises:
        InputError: they are not two positive whole numbers such as a sensor has.
    """
    width, height = read_numbers(value, (2,), where).tolist()
    if not 1 <= min(width, height) <= max(width, height) <= MAX_IMAGE_SIZE or width % 1 or height % 1:
        raise InputError(f"{where}: expected a width and a height in px, found {width:g}, {height:g}; correct them")
    return int(width), int(height)


def read_matrix(value: Any, where: str) -> Array:
    """An intrinsic matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] [px].

    Raises:
        InputError: the value is no such matrix.
    """
    matrix = read_numbers(value, (3, 3), where)
    below = max(abs(matrix[1, 0]), abs(matrix[2, 0]), abs(matrix[2, 1]), abs(matrix[2, 2] - 1.0))
    if not (min(matrix[0, 0], matrix[1, 1]) > 0 and below <= MATRIX_TOLERANCE * np.abs(matrix).max()):
        raise InputError(
            f"{where}: expected an intrinsic matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, "
            f"found {_shortened(matrix.tolist())}; export the calibration again"
        )
    return matrix


def read_rotation(value: Any, where: str) -> Array:
    """A rotation from world to camera, (3, 3), from a rotation vector (3) or a rotation matrix (3, 3).

    Raises:
        InputError: the value is neither.
    """
    numbers = read_numbers(value, (-1,), where)
    if len(numbers) == 3:
        result: Array = Rotation.from_rotvec(numbers).as_matrix()
        return result
    matrix = read_numbers(value, (3, 3), where)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise InputError(
            f"{where}: expected a rotation matrix or a rotation vector, found {_shortened(matrix.tolist())}, which is "
            "no rotation; export the calibration again"
        )
    return matrix


def read_distortion(value: Any, where: str) -> tuple[float, float, float, float, float]:
    """The coefficients k1, k2, p1, p2, k3 from a list in the order of OpenCV, which may be shorter or longer.

    Raises:
        InputError: further coefficients are not zero.
    """
    numbers = read_numbers(value, (-1,), where)
    further = [name for name, number in zip(FURTHER_COEFFICIENTS, numbers[5:], strict=False) if number]
    if further or len(numbers) > 5 + len(FURTHER_COEFFICIENTS):
        raise InputError(
            f"{where}: expected k1, k2, p1, p2, k3, found {len(numbers)} coefficients"
            f"{', of which ' + ', '.join(further) + ' are not 0' if further else ''}; calibrate without the rational, "
            "thin prism and tilted models"
        )
    k1, k2, p1, p2, k3 = np.pad(numbers[:5], (0, 5 - len(numbers[:5]))).tolist()
    return k1, k2, p1, p2, k3


def refuse_fisheye(flag: Any, where: str) -> None:
    """Refuse a fisheye camera.

    Raises:
        InputError: `flag` is true.
    """
    if flag:
        raise InputError(f"{where}: expected a pinhole camera, found a fisheye; calibrate it with the pinhole model")
