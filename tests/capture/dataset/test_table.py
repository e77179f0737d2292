"""The table of recordings, as spreadsheets write it."""

from pathlib import Path

import pytest

from rafl.capture.dataset.table import read_recording_rows
from rafl.common.errors import InputError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("recording,load_g,split\na,50,training\n", "line 2, column split"),
        ("recording,load_g,split\na,50,train\nb,heavy,test\n", "line 3, column load_g"),
        ("recording,load,split\na,50,train\n", "expected the columns recording, load_g, split"),
        ("recording,load_g,load_g,split\na,60,70,train\n", "found load_g twice"),
        ("recording;load_g;split\na;60,5;train\nb;1.500;train\n", "found 60,5 and 1.500"),
        ("PK\x03\x04recording,load_g,split\n", "found an Excel workbook"),
        ("recording,load_g,split\n", "at least one recording"),
        ("recording,load_g,split\n\na,50,train\n,,\nb,heavy,test\n", "line 5, column load_g"),
        ("recording,load_g,split\na,60,5,train\n", "line 2: expected 3 cells"),
        ('recording,load_g,split\na,"1,234",train\n', "line 2, column load_g"),  # ambiguous: a thousand, or one
        ("recording,load_g,split\na,50,train\na,60,test\n", "found 'a' more than once"),
        ("", "save it as CSV"),
    ],
)
def test_bad_tables_name_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "recordings.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_recording_rows(path)


def test_spreadsheet_quirks_are_accepted(tmp_path: Path) -> None:
    """A byte-order mark, spaces after commas, empty optional cells and empty cells beyond the last column."""
    path = tmp_path / "recordings.csv"
    path.write_bytes(b"\xef\xbb\xbfrecording, load_g, split, first_frame\r\na, 50, train,,\r\nb, 60, test, 3\r\n")
    rows = read_recording_rows(path)
    assert [(row.recording, row.load_g, row.first_frame) for row in rows] == [("a", 50, None), ("b", 60, 3)]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_tables_with_other_separators_and_decimal_commas_are_read(separator: str, tmp_path: Path) -> None:
    path = tmp_path / "recordings.csv"
    text = "recording|load_g|split|first_frame\r\na|60,5|train|\r\n|||\r\nb|70|test|3\r\n"
    path.write_text(text.replace("|", separator))
    rows = read_recording_rows(path)
    assert [(row.recording, row.load_g, row.first_frame) for row in rows] == [("a", 60.5, None), ("b", 70, 3)]


def test_a_table_in_another_encoding_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "recordings.csv"
    path.write_text("recording,load_g,split\nMärz,50,train\n", encoding="utf-16")
    with pytest.raises(InputError, match="save it as CSV UTF-8"):
        read_recording_rows(path)
