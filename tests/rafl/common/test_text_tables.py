"""Separators of tables, as spreadsheets of different countries write them."""

from pathlib import Path

import pytest

from rafl.common.errors import InputError
from rafl.common.text_tables import read_table_text


@pytest.mark.parametrize(
    ("content", "separator", "skipped"),
    [
        ("a,b;c,d\n", ",", 0),
        ("a;b\n1,5;2\n", ";", 0),
        ("a\tb\n", "\t", 0),
        ("\ufeffsep=;\r\na;b\r\n", ";", 1),
        ('"sep=,"\na;b;c\n', ",", 1),
    ],
)
def test_separator(content: str, separator: str, skipped: int, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(content, encoding="utf-8", newline="")
    text, found, left_out = read_table_text(tmp_path / "a.csv")
    assert (found, left_out) == (separator, skipped)
    assert text.startswith("a")


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00a")
    with pytest.raises(InputError, match=r"a\.csv.*save it as CSV UTF-8"):
        read_table_text(tmp_path / "a.csv")
