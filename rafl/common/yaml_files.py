"""YAML files that a person writes: read, validated and refused with a clear message."""

from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml

from rafl.common.errors import InputError
from rafl.common.files import require_file

Model = TypeVar("Model", bound=pydantic.BaseModel)


class StrictModel(pydantic.BaseModel):
    """Base of every file a person writes: an unknown key is an error, not a silent no-op."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


def read_yaml(path: Path, model: type[Model], what: str, version: str) -> Model:
    """Read and validate a YAML file a person wrote, of format `version` (`name/number`).

    Raises:
        InputError: no such file, not YAML, of another format or a newer version, an unknown or missing
            key, a value of another kind.
    """
    content = yaml_content(path, what, version)
    try:
        return model.model_validate(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        found = "" if first["type"] == "missing" else f", found {first['input']!r:.80}"
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        message = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{what} {path}: {key}: {message}{found}; correct that key{more}") from None


def yaml_content(path: Path, what: str, version: str) -> dict[str, Any]:
    """The keys and values of a YAML file of format `version` (`name/number`), `format` among them.

    Raises:
        InputError: no such file, not YAML, of another format or a newer version.
    """
    require_file(path, what)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:  # the last of brackets hundreds deep
        reason = " ".join(str(error).split())
        raise InputError(f"expected {what} in {path}, which is not readable as YAML: {reason}") from None
    if not isinstance(content, dict):
        raise InputError(f"expected {what} in {path}, found no keys and values; is it the right file?")
    check_format(str(content.get("format", "no `format:`")), version, path)
    return content


def check_format(found: str, expected: str, path: Path) -> None:
    """Refuse a file of another kind, or of a newer version, by name.

    `expected` is `name/version`, for instance `rafl-calibration/1`.
    """
    name, _, version = expected.partition("/")
    found_name, _, found_version = found.partition("/")
    if found_name != name or not found_version.isdigit():
        raise InputError(f"expected format {expected} in {path}, found {found!r}; is it the right file?")
    if int(found_version) > int(version):
        raise InputError(f"{path} has format {found}, newer than this program's {expected}; install a newer version")
