from pathlib import Path

import pytest

from rafl.common.errors import InputError
from rafl.common.files import atomic_file, sha256
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
