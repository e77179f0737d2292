"""Text of tables that spreadsheets and other programs write."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from rafl.common.errors import InputError

if TYPE_CHECKING:  # the import takes a second, which commands that refuse their options need not wait for
    import pandas as pd

SEPARATORS = ",;\t"
WORKBOOK_START = b"PK\x03\x04"  # of .xlsx and .ods files
FORMULA_STARTS = ("=", "+", "-", "@")


def read_table_text(path: Path) -> tuple[str, str, int]:
    """The text of a table, the separator of its cells, and the number of lines left out before it.

    The separator is the most frequent one of the first line. A first line `sep=;` tells it to spreadsheets and is left
    out.

    Raises:
        InputError: the file is not text.
    """
    with path.open("rb") as file:
        if file.read(len(WORKBOOK_START)) == WORKBOOK_START:
            raise InputError(f"expected a table in {path}, found an Excel workbook; save it as CSV UTF-8")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"expected a table in {path}, found: {error}; save it as CSV UTF-8") from None
    named = re.match(rf'"?sep=(?P<separator>[{SEPARATORS}])"?\r?\n', text)
    if named:
        return text[named.end() :], named["separator"], 1
    return text, max(SEPARATORS, key=text.partition("\n")[0].count), 0


def spreadsheet_text(text: str) -> str:
    """A cell's text that no spreadsheet takes for a formula: one that begins like a formula gets an apostrophe."""
    return f"'{text}" if text.startswith(FORMULA_STARTS) else text


def spreadsheet_csv(table: "pd.DataFrame") -> str:
    """A table as CSV with six decimals; no name in it is a formula."""
    names = table.select_dtypes(exclude="number")
    safe = table.assign(**{key: names[key].map(spreadsheet_text) for key in names})
    return str(safe.to_csv(index=False, float_format="%.6f"))


def cell_text(text: str) -> str:
    """The text from which `spreadsheet_text` made a cell."""
    return text[1:] if text.startswith("'") and text[1:].startswith(FORMULA_STARTS) else text
