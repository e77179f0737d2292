"""Names of dots by the face of the body that they are on, by row and column."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.tracking.linking.layout import GRID_DIRECTIONS
from rafl.tracking.linking.naming import rows_and_columns

Array = NDArray[Any]

# First letters of the names: left and right, top and bottom, end (the tip) and clamp.
LETTERS = {"y-min": "L", "y-max": "R", "z-max": "T", "z-min": "B", "x-max": "E", "x-min": "C"}


def faces_of(normal: Array) -> list[str]:
    """The face `x-min` ... `z-max` that each outward normal (M, 3) points to most."""
    axis = np.abs(normal).argmax(axis=1)
    outwards = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0]
    return [f"{'xyz'[k]}-{'max' if value > 0 else 'min'}" for k, value in zip(axis, outwards, strict=True)]


def on_face(face: str, points: Array) -> Array:
    """Coordinates (M, 2) of points (M, 3) along the columns and the rows of grids on a face."""
    return np.asarray(points @ np.array(GRID_DIRECTIONS[face[0]]).T)


def dots_by_row(faces: list[str], places: Array) -> list[NDArray[np.int64]]:
    """The dots of every row on every face, in the order of `LETTERS`, from the first row on, in the order of columns.

    Args:
        faces: of each dot, (M).
        places: on the undeformed body [m], (M, 3).
    """
    rows = []
    for face in LETTERS:
        own = np.flatnonzero([other == face for other in faces])
        if len(own):
            row, column = rows_and_columns(on_face(face, places[own])).T
            rows += [own[row == k][np.argsort(column[row == k])] for k in np.unique(row)]
    return rows


def name_dots(faces: list[str], places: Array) -> tuple[str, ...]:
    """Names L1, L2, ..., R1, ...: the letter of the face, and numbers row by row."""
    names, count = [""] * len(faces), dict.fromkeys(LETTERS, 0)
    for row in dots_by_row(faces, places):
        for dot in row:
            count[faces[dot]] += 1
            names[dot] = f"{LETTERS[faces[dot]]}{count[faces[dot]]}"
    return tuple(names)
