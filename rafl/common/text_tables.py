"""Text of tables that spreadsheets and other programs write."""

import re
from pathlib import Path

from rafl.common.errors import InputError

SEPARATORS = ",;\t"


def read_table_text(path: Path) -> tuple[str, str, int]:
    """The text of a table, the separator of its cells, and the number of lines left out before it.

    The separator is the most frequent one of the first line. A first line `sep=;` tells it to spreadsheets and is left
    out.

    Raises:
        InputError: the file is not text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"expected a table in {path}, found: {error}; save it as CSV UTF-8") from None
    named = re.match(rf'"?sep=(?P<separator>[{SEPARATORS}])"?\r?\n', text)
    if named:
        return text[named.end() :], named["separator"], 1
    return text, max(SEPARATORS, key=text.partition("\n")[0].count), 0
