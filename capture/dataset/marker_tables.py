"""Readers of marker trajectories in text tables, our own and those of other programs.

Known are the CSV and TRC exports of `rafl-track`, TRC of other programs, the tables of OptiTrack Motive, Vicon Nexus
and Qualisys (QTM), and the 3-D tables of DLTdv, anipose and DeepLabCut.
"""

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.common.text_tables import cell_text, read_table_text
from rafl.tracking.reconstruction.export import SPECIMEN_FRAME

Array = NDArray[Any]

Rows = list[list[str]]
MAX_TABLE_BYTES = 1_000_000_000
KNOWN = "CSV or TRC of rafl-track, Motive, Vicon, Qualisys, DLTdv, anipose or DeepLabCut"


@dataclass(frozen=True)
class MarkerTable:
    """Content of a table.

    Attributes:
        names: of the markers, (M); None if the file only numbers them.
        position: in the unit of the file, (T, M, 3), NaN where missing.
        time: [s], (T); None if the file has no frame rate.
        unit: of the positions; None if the file does not say.
        sigma: in the same unit, (T, M, 3), or None.
        in_specimen_frame: whether the positions are in the specimen frame.
    """

    names: tuple[str, ...] | None
    position: Array
    time: Array | None
    unit: str | None
    sigma: Array | None = None
    in_specimen_frame: bool = False


def read_marker_table(path: Path) -> MarkerTable:
    """Read a table; its kind follows from its first lines.

    Raises:
        InputError: no table of a known kind, or a damaged one.
    """
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise InputError(f"{path}: expected a table of at most {MAX_TABLE_BYTES / 1e9:g} GB; export it as C3D")
    text, separator, _ = read_table_text(path)
    first = text.partition("\n")[0]
    if path.suffix.lower() in (".tsv", ".trc"):
        separator = "\t"
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator)]
    except csv.Error as error:
        raise InputError(f"expected a table in {path}, found: {error}; export it again") from None
    for recognised, read in KINDS:
        if rows and recognised(rows):
            try:
                table = read(rows)
            except (IndexError, KeyError, StopIteration):
                raise InputError(
                    f"{path}: expected the header of a table of {KNOWN}, found an incomplete one; export it again"
                ) from None
            except ValueError as error:
                raise InputError(f"{path}: {error}; export it again") from None
            if not table.position.size:
                raise InputError(f"{path}: expected frames and markers, found none; export it again")
            return table
    raise InputError(f"{path}: expected a table of {KNOWN}, found one that begins {first[:60]!r}; export it as C3D")


def _numbers(rows: Rows, columns: list[int], first: int) -> Array:
    """Numbers of some columns of all rows (T, C); NaN where a cell is empty or missing. `first`: of the rows' lines."""
    values = np.full((len(rows), len(columns)), np.nan)
    for k, row in enumerate(rows):
        for j, column in enumerate(columns):
            cell = row[column] if column < len(row) else ""
            if cell and cell.upper() not in ("NULL", "NAN"):
                try:
                    values[k, j] = float(cell)
                except ValueError:
                    raise ValueError(
                        f"line {first + k + 1}, column {column + 1}: expected a number, found {cell!r}"
                    ) from None
    return values


def _positions(rows: Rows, columns: list[int], first: int) -> Array:
    """Positions (T, M, 3) from columns in threes; a marker at exactly zero, or with a missing part, is missing."""
    found = _numbers(rows, columns, first).reshape(len(rows), len(columns) // 3, 3)
    missing = ~np.isfinite(found).all(axis=2) | (found == 0.0).all(axis=2)
    found[missing] = np.nan
    return found


def _filled(rows: Rows, first: int) -> Rows:
    """The rows from `first` on, up to the next empty one."""
    found = []
    for row in rows[first:]:
        if not any(row):
            break
        found.append(row)
    return found


def _short(names: list[str]) -> tuple[str, ...]:
    """Marker names without the name of their subject, as in `beam:L1`."""
    return tuple(name.rpartition(":")[2] for name in names)


def _frame_time(rows: Rows, column: int, rate: float, first: int) -> Array:
    """Times [s], (T), from the frame numbers of a column."""
    if not rate > 0.0:
        raise ValueError(f"expected a frame rate above 0, found {rate:g}")
    frames = _numbers(rows, [column], first)[:, 0]
    return np.asarray((frames - frames[0]) / rate)


def _read_own_csv(rows: Rows) -> MarkerTable:
    column = {name: k for k, name in enumerate(rows[0])}
    data = [row for row in rows[1:] if any(row)]
    names = tuple(dict.fromkeys(cell_text(row[column["marker"]]) for row in data))
    keys = [f"{axis}_mm" for axis in "xyz"]
    sigma_keys = [f"sigma_{axis}_mm" for axis in "xyz"]
    values = _numbers(data, [column[key] for key in ("frame", "time_s", *keys, *sigma_keys)], 1)
    if not np.isfinite(values[:, :2]).all():
        raise ValueError("expected a frame and a time in every line, found an empty cell")
    frames, index = np.unique(values[:, 0], return_inverse=True)
    marker = np.array([names.index(cell_text(row[column["marker"]])) for row in data])
    position, sigma = (np.full((len(frames), len(names), 3), np.nan) for _ in range(2))
    position[index, marker], sigma[index, marker] = values[:, 2:5], values[:, 5:8]
    time = np.full(len(frames), np.nan)
    time[index] = values[:, 1]
    return MarkerTable(names, position, time, "mm", sigma, in_specimen_frame=True)


def _read_trc(rows: Rows) -> MarkerTable:
    values = dict(zip(rows[1], rows[2], strict=False))
    names = [name for name in rows[3][2:] if name]
    first = next(k for k in range(5, len(rows)) if any(rows[k]))
    data = _filled(rows, first)
    columns = list(range(2, 2 + 3 * len(names)))
    time = _frame_time(data, 0, float(values["DataRate"]), first)
    own = rows[0][-1].endswith(SPECIMEN_FRAME)
    return MarkerTable(_short(names), _positions(data, columns, first), time, values["Units"], None, own)


def _read_motive(rows: Rows) -> MarkerTable:
    values = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    header = next(k for k, row in enumerate(rows) if row and row[0] == "Frame")
    kinds = next(k for k in range(header) if "Marker" in rows[k])
    quantity = next(row for row in rows[:header] if "Position" in row)
    columns = [
        k
        for k, (kind, what, axis) in enumerate(zip(rows[kinds], quantity, rows[header], strict=False))
        if kind == "Marker" and what == "Position" and axis in ("X", "Y", "Z")
    ]
    names = [rows[kinds + 1][k] for k in columns[::3]]
    data = _filled(rows, header + 1)
    rate = float(values.get("Export Frame Rate") or values["Capture Frame Rate"])
    time = _frame_time(data, 0, rate, header + 1)
    return MarkerTable(_short(names), _positions(data, columns, header + 1), time, values["Length Units"])


def _read_vicon(rows: Rows) -> MarkerTable:
    begin = next(k for k, row in enumerate(rows) if row and row[0] == "Trajectories")
    rate, names = float(rows[begin + 1][0]), [name for name in rows[begin + 2] if name]
    unit = next(cell for cell in rows[begin + 4] if cell)
    data = _filled(rows, begin + 5)
    columns = list(range(2, 2 + 3 * len(names)))
    time = _frame_time(data, 0, rate, begin + 5)
    return MarkerTable(_short(names), _positions(data, columns, begin + 5), time, unit)


def _read_qualisys(rows: Rows) -> MarkerTable:
    values = {row[0]: row[1:] for row in rows if row and re.fullmatch(r"[A-Z_]+", row[0])}
    names = [name for name in values["MARKER_NAMES"] if name]
    first = next(k for k, row in enumerate(rows) if row and re.fullmatch(r"[-+0-9.eE]*", row[0]) and any(row))
    data = _filled(rows, first)
    before = len(data[0]) - 3 * len(names)  # columns of frame and time, in some exports
    columns = list(range(before, before + 3 * len(names)))
    rate = float(values["FREQUENCY"][0])
    if not rate > 0.0:
        raise ValueError(f"expected a frequency above 0, found {rate:g}")
    time = np.arange(len(data)) / rate
    return MarkerTable(_short(names), _positions(data, columns, first), time, "mm")


def _read_deeplabcut(rows: Rows) -> MarkerTable:
    head = {row[0]: row for row in rows[:4] if row}
    if "individuals" in head:
        raise ValueError("expected the markers of one specimen, found several individuals")
    names = list(dict.fromkeys(head["bodyparts"][1:]))
    place = {pair: k for k, pair in enumerate(zip(head["bodyparts"], head["coords"], strict=False))}
    columns = [place[name, axis] for name in names for axis in "xyz"]
    return MarkerTable(tuple(names), _positions(rows[3:], columns, 3), None, None)


def _read_columns(rows: Rows) -> MarkerTable:
    """Columns NAME_x, NAME_y, NAME_z, as of anipose (with others beside them) and DLTdv (numbered points)."""
    place = {cell.lower(): k for k, cell in enumerate(rows[0])}
    names = [cell[:-2] for cell in rows[0] if cell.lower().endswith("_x")]
    names = [name for name in names if all(f"{name.lower()}_{axis}" in place for axis in "yz")]
    columns = [place[f"{name.lower()}_{axis}"] for name in names for axis in "xyz"]
    numbered = all(re.fullmatch(r"pt\d+", name) for name in names)
    data = [row for row in rows[1:] if any(row)]
    return MarkerTable(None if numbered else tuple(names), _positions(data, columns, 1), None, None)


KINDS: list[tuple[Callable[[Rows], bool], Callable[[Rows], MarkerTable]]] = [
    (lambda rows: rows[0][:3] == ["frame", "time_s", "marker"], _read_own_csv),
    (lambda rows: rows[0][:1] == ["PathFileType"], _read_trc),
    (lambda rows: rows[0][:1] == ["Format Version"], _read_motive),
    (lambda rows: any(row[:1] == ["Trajectories"] for row in rows), _read_vicon),
    (lambda rows: any(row[:1] == ["MARKER_NAMES"] for row in rows[:20]), _read_qualisys),
    (lambda rows: rows[0][:1] == ["scorer"], _read_deeplabcut),
    (lambda rows: sum(cell.lower().endswith("_x") for cell in rows[0]) > 0, _read_columns),
]
