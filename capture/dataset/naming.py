"""Markers of a recording in the order of the specimen's layout, by their names."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from rafl.capture.registration.recording import Recording
from rafl.capture.registration.registration import combined_layout
from rafl.capture.registration.rigid import MIN_MARKERS
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.common.text_tables import read_table_text

WRONG_UNIT = 4.0  # times too large or small: units differ by 10 or more, bending changes distances by less than this


def read_marker_names(path: Path) -> dict[str, str]:
    """Names of markers in the specimen by their names in the files, from a table with the columns `file,specimen`.

    Raises:
        InputError: no such file, no such table, or a name twice.
    """
    require_file(path, "a table of marker names")
    text, separator, _ = read_table_text(path)
    try:
        lines = list(csv.reader(text.splitlines(), delimiter=separator))
    except csv.Error as error:
        raise InputError(f"expected a table in {path}, found: {error}; save it as CSV UTF-8") from None
    rows = [[cell.strip() for cell in row] for row in lines if any(row)]
    if not rows or rows[0] != ["file", "specimen"] or any(len(row) != 2 for row in rows):
        raise InputError(f"{path}: expected a table with the columns file,specimen; found other ones")
    names = dict(row for row in rows[1:])
    if len(names) < len(rows) - 1 or len(set(names.values())) < len(names):
        raise InputError(f"{path}: expected every name once in a column, found one twice; remove a row")
    return names


def in_layout_order(recording: Recording, specimen: Specimen, name: str, names: dict[str, str]) -> Recording:
    """The recording with its markers in the order of `combined_layout`.

    Args:
        recording: as read.
        specimen: its description.
        name: of the recording, for messages.
        names: of markers in the specimen, by their names in the file, where they differ.

    Raises:
        InputError: other markers than those of the specimen, or far wider or narrower apart.
    """
    if recording.names is not None:
        recording = replace(recording, names=tuple(names.get(marker, marker) for marker in recording.names))
    ordered = _ordered(recording, specimen, name)
    _check_size(ordered, specimen, name)
    return ordered


def _check_size(recording: Recording, specimen: Specimen, name: str) -> None:
    """Raise InputError if the markers are far wider or narrower apart than described, as with a wrong unit."""
    positions = recording.position[:, : len(specimen.layout.names)]
    measured = np.isfinite(positions[..., 0])
    frame = int(measured.sum(axis=1).argmax())
    seen = measured[frame]
    if seen.sum() < MIN_MARKERS:
        return
    found, expected = (
        float(np.linalg.norm(points[seen] - points[seen].mean(axis=0), axis=1).max())
        for points in (positions[frame], specimen.layout.positions)
    )
    if not 1.0 / WRONG_UNIT < found / expected < WRONG_UNIT:
        raise InputError(
            f"recording {name}: expected markers up to {2e3 * expected:.3g} mm apart as in the specimen, found "
            f"{2e3 * found:.3g} mm; at_mm in the specimen file are not in mm, or the unit of "
            f"{recording.source.partition(' ')[0]} is wrong (m, cm or mm): correct the one or export the other again"
        )


def _ordered(recording: Recording, specimen: Specimen, name: str) -> Recording:
    layout_names, _ = combined_layout(specimen)
    if recording.names is None:
        if recording.position.shape[1] != len(layout_names):
            raise InputError(
                f"recording {name}: expected {len(layout_names)} markers as in the specimen, found "
                f"{recording.position.shape[1]}; the file has no names, so its order must be that of the specimen"
            )
        return recording
    for marker in layout_names:
        if recording.names.count(marker) > 1:
            raise InputError(f"recording {name}: expected one marker {marker}, found several; rename the others")
    missing = [marker for marker in layout_names if marker not in recording.names]
    present = [marker for marker in specimen.layout.names if marker in recording.names]
    if len(present) < MIN_MARKERS:
        raise InputError(
            f"recording {name}: expected at least {MIN_MARKERS} of the specimen's markers, found "
            f"{len(present)} (the file has {', '.join(recording.names[:6])}...); use the same names in both"
        )
    order = [recording.names.index(marker) if marker in recording.names else -1 for marker in layout_names]
    position, sigma = recording.position[:, order].copy(), recording.sigma[:, order].copy()
    position[:, [layout_names.index(marker) for marker in missing]] = np.nan
    views = {camera: view.select_markers(np.array(order)) for camera, view in recording.views.items()}
    return replace(recording, names=tuple(layout_names), position=position, sigma=sigma, views=views)
