"""`recordings.csv`: which recordings a dataset is made of, and how."""

from pathlib import Path
from typing import Literal

import pandas as pd
import pydantic

from groundwork import InputError, StrictModel, require_file


class RecordingRow(StrictModel):
    """A row of recordings.csv.

    `load` says whether the load was cut off at the start (`released`) or hangs on during the motion
    (`hanging`); frames count from 0 and `last_frame` is included. Without `first_frame` the motion shows it.
    """

    recording: str = pydantic.Field(min_length=1)
    load_g: float = pydantic.Field(ge=0)
    split: Literal["train", "val", "test"]
    load: Literal["released", "hanging"] = "released"
    first_frame: int | None = pydantic.Field(None, ge=0)
    last_frame: int | None = pydantic.Field(None, ge=1)


def read_recording_rows(path: Path, complete: bool = True) -> list[RecordingRow]:
    """Read recordings.csv; a `complete` one has recordings to train on.

    Raises:
        InputError: missing, or a row that does not fit; names the line.
    """
    require_file(path, "a table of recordings (recordings.csv)")
    try:
        table = pd.read_csv(path, dtype=str, skipinitialspace=True)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise InputError(f"expected a table with commas in {path}, found: {error}; save it as CSV") from None
    rows = []
    for line, record in enumerate(table.to_dict("records"), start=2):
        given = {str(key).strip(): value.strip() for key, value in record.items() if isinstance(value, str)}
        try:
            rows.append(RecordingRow.model_validate(given))
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            column = ".".join(map(str, first["loc"]))
            raise InputError(f"{path} line {line}, column {column}: {first['msg']}; correct it") from None
    if not rows:
        raise InputError(f"expected at least one recording in {path}, found none; add a row")
    twice = [name for name, count in pd.Series([row.recording for row in rows]).value_counts().items() if count > 1]
    if twice:
        raise InputError(f"{path}: expected each recording once, {twice[0]} stands there twice; remove one row")
    if complete and not any(row.split == "train" for row in rows):
        raise InputError(f"{path}: expected a recording with split `train`, found none; set one")
    return rows
