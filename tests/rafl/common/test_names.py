"""Names that files can be named after, and those that are refused."""

import pytest

from rafl.common.errors import InputError
from rafl.common.names import MAX_NAME_BYTES, check_distinct, check_name, check_path_inside, require_names


@pytest.mark.parametrize(
    "name", ["load060g", "take 2", "beam:L1", "a.b-c_d", "Prüfling", "钢", "=1", "x" * MAX_NAME_BYTES]
)
def test_names_of_laboratories_are_valid(name: str) -> None:
    assert check_name(name) == name


@pytest.mark.parametrize(
    "name",
    [
        *("", ".", "..", "../x", "/x", "day1/load060g", "a\\b", " a", "a ", "a.", ".a", "\u00a0a"),
        *("a\0", "a\nb", "a\tb", "a\x1b[31m", "a\u202eb", "a\u2028b", "\ud800"),
        *("x" * (MAX_NAME_BYTES + 1), "é" * (MAX_NAME_BYTES // 2 + 1)),
    ],
    ids=ascii,
)
def test_names_that_no_file_can_have_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"^expected a name") as error:
        check_name(name)
    assert str(error.value).isprintable()


@pytest.mark.parametrize(
    "names", [("a", "a"), ("Load", "load"), ("Straße", "STRASSE"), ("\u00e9", "e\u0301")], ids=ascii
)
def test_names_that_a_file_system_may_take_for_one_are_refused(names: tuple[str, str]) -> None:
    with pytest.raises(ValueError, match="more than"):
        check_distinct(names)


def test_refusal_says_where_the_name_is() -> None:
    with pytest.raises(InputError, match=r"^recordings in videos: expected a name without slashes, found 'a/b'; "):
        require_names(["good", "a/b"], "recordings in videos")


@pytest.mark.parametrize(
    "path", ["", "/body.stl", "../body.stl", "a/../../body.stl", "C:\\body.stl", "a\\..\\b", "a\0"]
)
def test_path_out_of_the_folder_is_refused(path: str) -> None:
    with pytest.raises(ValueError, match="same folder"):
        check_path_inside(path)
    assert check_path_inside("shapes/body.stl") == "shapes/body.stl"
