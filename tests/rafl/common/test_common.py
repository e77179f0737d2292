from pathlib import Path

import pytest

from rafl.common.errors import InputError
from rafl.common.files import sha256, whole_file
from rafl.common.yaml_files import StrictModel, check_format, read_yaml


class Thing(StrictModel):
    format: str
    length_mm: float


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail_half_way() -> None:
        with whole_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_whole_write_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o044


def test_a_folder_in_the_place_of_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found a folder"), whole_file(tmp_path):
        pass
    assert not list(tmp_path.parent.glob(f".{tmp_path.name}*"))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("length_mm: [", "not readable as YAML"),
        ("a: " + 500 * "[" + 500 * "]", "not readable as YAML"),
        ("- 1", "no keys and values"),
        ("length_mm: 1", "rafl-thing/1"),
        ("format: rafl-other/1", "rafl-other/1"),
        ("format: rafl-thing/2", "newer"),
        ("format: rafl-thing/1\nlength_m: 3", "length_mm: Field required"),
        ("format: rafl-thing/1\nlength_mm: long", "found 'long'"),
        ("{format: rafl-thing/1, length_mm: 1, width: 2}", "width"),
    ],
)
def test_yaml_errors_name_file_and_key(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "thing.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"thing\.yaml") as error:
        read_yaml(path, Thing, "a thing", "rafl-thing/1")
    assert part in str(error.value)
    assert "\n" not in str(error.value)


def test_formats(tmp_path: Path) -> None:
    check_format("rafl-thing/1", "rafl-thing/2", tmp_path)
    with pytest.raises(InputError, match="newer"):
        check_format("rafl-thing/3", "rafl-thing/2", tmp_path)
    for other in ("rafl-other/1", "", "rafl-thing/x"):
        with pytest.raises(InputError, match="right file"):
            check_format(other, "rafl-thing/2", tmp_path)


def test_hash_of_a_known_text(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256(tmp_path / "a") == known
    assert sha256(tmp_path) == known
