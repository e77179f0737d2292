import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from rafl.common.errors import InputError
from rafl.common.files import (
    atomic_file,
    find_copies,
    new_content,
    require_writable,
    sha256,
    write_bytes,
    written_files,
)
from rafl.common.yaml_files import StrictModel, check_format, read_yaml


class Sample(StrictModel):
    format: str
    length_mm: float


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail_while_writing() -> None:
        with atomic_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_while_writing()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_successful_write_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    with atomic_file(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o044


def test_folder_instead_of_a_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found a folder"), atomic_file(tmp_path):
        pass
    assert not list(tmp_path.parent.glob(f".{tmp_path.name}*"))


def test_full_disk_is_told_with_what_was_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_500_000))
    with pytest.raises(OSError, match=r"expected 2.00 MB of free space to write it, found 1.50 MB") as error:
        write_bytes(tmp_path / "new" / "a.h5", bytes(2_000_000))
    assert error.value.filename == str(tmp_path / "new" / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_files_of_one_content_are_found(tmp_path: Path) -> None:
    contents = {"a": "one", "b": "two", "c": "three", "d": "two"}
    paths = [tmp_path / name for name in (*contents, "folder")]
    for path, content in zip(paths, contents.values(), strict=False):
        path.write_text(content)
    paths[-1].mkdir()
    assert find_copies(paths) == (tmp_path / "b", tmp_path / "d")
    assert find_copies(paths[:3]) is None


def test_files_take_their_places_together(tmp_path: Path) -> None:
    old, new, folder = tmp_path / "a.csv", tmp_path / "out" / "b.csv", tmp_path / "c.csv"
    old.write_text("old")
    with written_files({old: "new", new: "new"}):
        assert old.read_text() == "old"
    assert (old.read_text(), new.read_text()) == ("new", "new")
    folder.mkdir()
    with pytest.raises(InputError, match="found a folder"), written_files({old: "newer", folder: "newer"}):
        pass
    with pytest.raises(ZeroDivisionError), written_files({old: "newer", tmp_path / "more" / "d.csv": "newer"}):
        raise ZeroDivisionError
    assert old.read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "c.csv", "out"]


def test_content_that_fails_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("")

    def film(folder: Path) -> None:
        with new_content(folder):
            (folder / "video").mkdir()
            (folder / "video" / "left.mp4").write_text("")
            raise ZeroDivisionError

    for folder in (tmp_path, tmp_path / "a" / "b"):
        with pytest.raises(ZeroDivisionError):
            film(folder)
    assert [path.name for path in tmp_path.rglob("*")] == ["kept"]


def test_place_that_cannot_be_written_to_is_found_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    require_writable(tmp_path / "file")
    require_writable(tmp_path / "new" / "run")
    with pytest.raises(InputError, match=r"expected a folder at .*file, found a file"):
        require_writable(tmp_path / "file" / "run")

    def refuse(*_: object, **__: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError, match="run: expected to be able to write there, found: Permission denied"):
        require_writable(tmp_path / "run")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("length_mm: [", "not readable as YAML"),
        ("a: " + 500 * "[" + 500 * "]", "not readable as YAML"),
        ("- 1", "no keys and values"),
        ("length_mm: 1", "rafl-sample/1"),
        ("format: rafl-other/1", "rafl-other/1"),
        ("format: rafl-sample/2", "newer"),
        ("format: rafl-sample/1\nlength_m: 3", "length_mm: Field required"),
        ("format: rafl-sample/1\nlength_mm: long", "found 'long'"),
        ("{format: rafl-sample/1, length_mm: 1, width: 2}", "width"),
    ],
)
def test_yaml_error_names_file_and_key(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "sample.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"sample\.yaml") as error:
        read_yaml(path, Sample, "a sample", "rafl-sample/1")
    assert part in str(error.value)
    assert "\n" not in str(error.value)


def test_other_and_newer_formats_are_errors(tmp_path: Path) -> None:
    check_format("rafl-sample/1", "rafl-sample/2", tmp_path)
    with pytest.raises(InputError, match="newer"):
        check_format("rafl-sample/3", "rafl-sample/2", tmp_path)
    for other in ("rafl-other/1", "", "rafl-sample/x"):
        with pytest.raises(InputError, match="right file"):
            check_format(other, "rafl-sample/2", tmp_path)


def test_sha256_of_known_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256(tmp_path / "a") == known
    assert sha256(tmp_path) == known
