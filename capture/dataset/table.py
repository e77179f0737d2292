"""`recordings.csv`: the recordings of a dataset, with load, split and frames."""

import csv
import io
from pathlib import Path
from typing import Literal

import pydantic

from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.common.names import Name, require_names
from rafl.common.text_tables import read_table_text
from rafl.common.yaml_files import StrictModel, describe_validation


class RecordingRow(StrictModel):
    """A row of recordings.csv.

    The load is either removed at the start (`released`) or stays during the motion (`hanging`). Frames count from 0,
    `last_frame` included. Without `first_frame` the start is found from the motion.
    """

    recording: Name
    load_g: float = pydantic.Field(ge=0)
    split: Literal["train", "val", "test"]
    load: Literal["released", "hanging"] = "released"
    first_frame: int | None = pydantic.Field(None, ge=0)
    last_frame: int | None = pydantic.Field(None, ge=1)


def read_recording_rows(path: Path) -> list[RecordingRow]:
    """Read recordings.csv.

    Cells are separated by commas, semicolons or tabs, as spreadsheets of different countries save them. Unless commas
    separate the cells, a comma in a number is a decimal comma.

    Raises:
        InputError: the file is missing or no table, or a row is invalid; the message names the line.
    """
    require_file(path, "a table of recordings (recordings.csv)")
    text, separator, skipped = read_table_text(path)
    try:
        table = csv.DictReader(io.StringIO(text), delimiter=separator, skipinitialspace=True)
        records = [(table.line_num + skipped, record) for record in table]
    except csv.Error as error:
        raise InputError(f"expected a table in {path}, found: {error}; save it as CSV UTF-8") from None
    if not table.fieldnames:
        raise InputError(f"expected a table in {path}, found an empty file; save it as CSV UTF-8")
    columns = [name.strip() for name in table.fieldnames]
    _check_columns(columns, path)
    rows, loads = [], []
    for line, record in records:
        if any(record.pop(None, [])):
            raise InputError(
                f"{path} line {line}: expected {len(table.fieldnames)} cells as in the first line, found more; "
                "put quotes around a cell that contains a separator"
            )
        cells = {key.strip(): (value or "").strip() for key, value in record.items()}
        given = {key: value for key, value in cells.items() if value}
        if not given:  # an empty row of a spreadsheet
            continue
        if separator != "," and "load_g" in given:
            loads.append(given["load_g"])
            given["load_g"] = given["load_g"].replace(",", ".")
        try:
            rows.append(RecordingRow.model_validate(given))
        except pydantic.ValidationError as error:
            raise InputError(f"{path} line {line}, column {describe_validation(error)}; correct it") from None
    _check_decimal_sign(loads, path)
    if not rows:
        raise InputError(f"expected at least one recording in {path}, found none; add a row")
    require_names((row.recording for row in rows), f"{path}, column recording")
    return rows


def _check_columns(columns: list[str], path: Path) -> None:
    """Raise InputError unless the columns of a row are there, each once."""
    found = ", ".join(column or "one without a name" for column in columns)
    for column in columns:
        if columns.count(column) > 1 and column:
            raise InputError(f"{path}: expected every column once, found {column} twice; remove one")
    required = [name for name, field in RecordingRow.model_fields.items() if field.is_required()]
    if not set(required) <= set(columns):
        raise InputError(
            f"{path}: expected the columns {', '.join(required)} in the first line, found {found}; correct that line"
        )


def _check_decimal_sign(loads: list[str], path: Path) -> None:
    """Raise InputError if a point may separate thousands, where commas separate decimals."""
    comma, point = (next((load for load in loads if sign in load), None) for sign in ",.")
    if comma and point:
        raise InputError(
            f"{path}, column load_g: expected one decimal sign, found {comma} and {point}; write all loads alike, "
            "without a sign between thousands"
        )
