"""Coefficients of the direct linear transformation (DLT), as DLTdv, easyWand and Argus write them."""

from pathlib import Path

import numpy as np
from scipy.linalg import rq

from rafl.calibration.foreign.camera import ForeignCamera, read_numbers
from rafl.common.errors import InputError
from rafl.common.text_tables import read_table_text

COEFFICIENTS = 11
# These programs count pixels from 1. Ours start at 0.
TO_ZERO_BASED = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]])


def read_dlt(path: Path) -> list[ForeignCamera]:
    """Read a table of 11 rows with one column of coefficients for every camera.

    u = (L1 x + L2 y + L3 z + L4) / (L9 x + L10 y + L11 z + 1), v = (L5 x + L6 y + L7 z + L8) / (the same); Abdel-Aziz
    and Karara, 1971, eq. 10. The 3 x 4 matrix P of the coefficients is K [R t] up to its scale, with an upper
    triangular K from the RQ decomposition.

    The lower left pixel is (1, 1), and v is counted upwards. If the origin of the world is in front of a camera, the
    determinant of K R is then negative. If it is positive for every camera, v is counted downwards, from the upper
    left pixel.

    Raises:
        InputError: the file is damaged, or the coefficients are not those of pinhole cameras.
    """
    text, separator, _ = read_table_text(path)
    rows = [line.split(separator) for line in text.splitlines() if line.strip()]
    columns = max(map(len, rows), default=0)
    if len(rows) != COEFFICIENTS or any(len(row) != columns for row in rows):
        raise InputError(
            f"{path}: expected {COEFFICIENTS} rows of DLT coefficients with a column for every camera, found "
            f"{len(rows)} rows of {min(map(len, rows), default=0)} to {columns} columns; export the coefficients again"
        )
    coefficients = read_numbers(rows, (COEFFICIENTS, columns), path.as_posix())
    projections = np.vstack([coefficients, np.ones(columns)]).T.reshape(columns, 3, 4)
    downwards = bool((np.linalg.det(projections[:, :, :3]) > 0).all())
    return [_camera(projection, downwards, f"{path}, camera {k + 1}") for k, projection in enumerate(projections)]


def _camera(projection: np.ndarray, downwards: bool, where: str) -> ForeignCamera:
    left = projection[:, :3]
    lengths = np.linalg.norm(left, axis=1, keepdims=True)
    if not lengths.all() or np.linalg.matrix_rank(left / lengths) < 3:
        raise InputError(
            f"{where}: expected the coefficients of a pinhole camera, found some that are linearly dependent; only a "
            "lens with perspective has DLT coefficients"
        )
    matrix, rotation = rq(left)
    # Focal lengths are positive, and upwards counted v makes that of v negative.
    signs = np.sign(np.diag(matrix)) * [1.0, 1.0 if downwards else -1.0, 1.0]
    matrix, rotation = matrix * signs, signs[:, None] * rotation
    translation = np.linalg.solve(matrix, projection[:, 3])
    if np.linalg.det(rotation) < 0:  # P and -P are the same camera
        rotation, translation = -rotation, -translation
    matrix = matrix / matrix[2, 2]
    if downwards:
        matrix = TO_ZERO_BASED @ matrix
    else:
        # The lower left pixel (1, 1) has u - 1 = 0 and height - v = height - 1 in ours.
        matrix[0] -= matrix[2]
    return ForeignCamera(None, matrix, rotation, translation, from_bottom=not downwards)
