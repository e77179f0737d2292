"""YAML files that a stranger may have made: refused in one line, before they take time or memory."""

import time
from pathlib import Path

import pytest
from pydantic import Field

from rafl.common.errors import InputError
from rafl.common.yaml_files import StrictModel, read_yaml, read_yaml_content


class Content(StrictModel):
    format: str
    number: float = 0.0
    names: list[str] = Field(default_factory=list)


def bomb(levels: int) -> str:
    """A list whose aliases stand for 8^levels texts."""
    lines = ["x0: &x0 [a, a, a, a, a, a, a, a]"]
    lines += [f"x{k}: &x{k} [{', '.join([f'*x{k - 1}'] * 8)}]" for k in range(1, levels)]
    return "\n".join(lines)


REFUSED = {
    "aliases": (bomb(12), "aliases stand for"),
    "endless": ("names: &a [*a]", "aliases stand for"),
    "nested": ("names: " + "[" * 5000 + "]" * 5000, "not readable"),
    "date": ("taken: 2026-02-30", "day is out of range"),
    "digits": ("number: " + "9" * 5000, "4300 digits"),
    "nan": ("number: .nan", "number: Input should be a finite number, found nan"),
    "inf": ("number: -.inf", "found -inf"),
    "huge": ("number: 1.0e+300", "number: expected numbers of at most 1e+12, found 1e+300"),
    "huge as text": ("number: 1e300", "number: expected numbers of at most 1e+12, found 1e300"),
    "huge integer": ("number: " + "9" * 900, "number: expected numbers of at most 1e+12, found 99999999999999999999"),
    "text": ("number: wide", "found 'wide'"),
    "tag": ("number: !!python/object/apply:os.system [exit]", "not readable"),
    "unknown": ("nuber: 1", "nuber"),
    "control": ("number: 1\x07", "not readable"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_at_once_in_one_line(tmp_path: Path, name: str) -> None:
    text, part = REFUSED[name]
    path = tmp_path / "file.yaml"
    path.write_text(f"format: rafl-test/1\n{text}\n")
    start = time.perf_counter()
    with pytest.raises(InputError) as error:
        read_yaml(path, Content, "a file", "rafl-test/1")
    assert time.perf_counter() - start < 5.0
    assert part in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("version", ["²", "9" * 5000, "-1", "", "1.0", "0x1", "१"])
def test_strange_version_is_refused(tmp_path: Path, version: str) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(f"format: rafl-test/{version}\n")
    with pytest.raises(InputError, match=r"^expected format rafl-test/1 .{0,400}$"):
        read_yaml(path, Content, "a file", "rafl-test/1")


def test_large_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    with path.open("wb") as stream:
        stream.truncate(10_000_000_000)  # no disk holds it
    with pytest.raises(InputError, match=r"found 10000\.0 MB"):
        read_yaml_content(path, "a file", "rafl-test/1")


def test_few_aliases_are_values(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("format: rafl-test/1\nnames: [&a left, *a]\n")
    assert read_yaml(path, Content, "a file", "rafl-test/1").names == ["left", "left"]
