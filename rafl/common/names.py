"""Names of recordings, cameras, markers and specimens: what they may be, so that files can be named after them."""

import unicodedata
from collections.abc import Iterable
from pathlib import PurePosixPath, PureWindowsPath
from typing import Annotated

from pydantic import AfterValidator

from rafl.common.errors import InputError

MAX_NAME_BYTES = 120  # in UTF-8: two names and `_overlay.mp4` fit into the 255 bytes of a file name
# Unicode categories of characters that cannot be seen or end a line: control, format, surrogate, separators.
INVISIBLE = ("Cc", "Cf", "Cs", "Zl", "Zp")


def check_visible(name: str) -> str:
    """Return a name that can be printed.

    Raises:
        ValueError: the name is empty, or has a character that cannot be seen. The message begins with `expected`.
    """
    if not isinstance(name, str) or not name:
        raise ValueError("expected a name, found an empty one")
    if any(unicodedata.category(character) in INVISIBLE for character in name):
        raise ValueError(f"expected a name of visible characters in one line, found {name!a:.80}")
    return name


def check_name(name: str) -> str:
    """Return a name that can be part of a file's name and of a path in HDF5.

    Raises:
        ValueError: the name is empty or too long, has a slash, a character that cannot be seen, or a space or a dot at
            an end. The message begins with `expected`.
    """
    check_visible(name)
    if "/" in name or "\\" in name:
        raise ValueError(f"expected a name without slashes, found {name!r:.80}")
    if name != name.strip() or name.strip(".") != name:
        raise ValueError(f"expected a name without spaces and dots at its ends, found {name!r:.80}")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise ValueError(f"expected a name of at most {MAX_NAME_BYTES} bytes, found {len(name.encode())}")
    return name


def check_distinct(names: Iterable[str]) -> None:
    """Check names that stand beside each other; file systems differ in whether `A` and `a` are the same.

    Raises:
        ValueError: two names are equal but for upper and lower case. The message begins with `expected`.
    """
    seen: dict[str, str] = {}
    for name in names:
        key = unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
        if key in seen:
            other = seen[key]
            found = f"{name!r:.80} more than once" if name == other else f"{other!r:.80} and {name!r:.80}"
            raise ValueError(f"expected names that differ in more than upper and lower case, found {found}")
        seen[key] = name


def check_names(names: Iterable[str]) -> None:
    """Check names that stand beside each other: each of them, and that they are distinct.

    Raises:
        ValueError: a name is invalid, or two are equal but for upper and lower case.
    """
    names = list(names)
    for name in names:
        check_name(name)
    check_distinct(names)


def require_names(names: Iterable[str], label: str) -> None:
    """`check_names` for names that a user has given.

    Args:
        names: to check.
        label: what they name and where, for the error message.

    Raises:
        InputError: a name is invalid, or two are equal but for upper and lower case.
    """
    try:
        check_names(names)
    except ValueError as error:
        raise InputError(f"{label}: {error}; choose another name") from None


def check_path_inside(path: str) -> str:
    """Return the path of a file that a folder's file names, if it stays in that folder.

    Raises:
        ValueError: the path is absolute, or leads out of the folder. The message begins with `expected`.
    """
    parts = PureWindowsPath(path)
    if parts.anchor or ".." in parts.parts or PurePosixPath(path).is_absolute() or "\0" in path or not path:
        raise ValueError("expected the name of a file in the same folder")
    return path


Name = Annotated[str, AfterValidator(check_name)]
PathInside = Annotated[str, AfterValidator(check_path_inside)]
