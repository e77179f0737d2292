"""Reading and validation of YAML files that a person writes."""

from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml

from rafl.common.errors import InputError
from rafl.common.files import require_file

Model = TypeVar("Model", bound=pydantic.BaseModel)


class StrictModel(pydantic.BaseModel):
    """Base class for the content of YAML files. An unknown key is an error."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


def read_yaml(path: Path, model: type[Model], label: str, version: str) -> Model:
    """Read and validate a YAML file.

    Args:
        path: of the file.
        model: class that the content is validated against.
        label: name of the file's kind in error messages.
        version: expected format, `name/number`.

    Raises:
        InputError: the file does not exist, is not YAML, has another format or a newer version, has an unknown or
            missing key, or has a value of the wrong type.
    """
    content = read_yaml_content(path, label, version)
    try:
        return model.model_validate(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        # Where a list has entries of several kinds, the kind follows an entry's number: a tag in angle brackets.
        key = ".".join(str(part) for part in first["loc"] if not str(part).startswith("<")) or "the file"
        found = "" if first["type"] == "missing" else f", found {first['input']!r:.80}"
        others = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        message = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{label} {path}: {key}: {message}{found}; correct that key{others}") from None


def read_yaml_content(path: Path, label: str, version: str) -> dict[str, Any]:
    """Read a YAML file without validation: all its keys and values, including `format`.

    Args:
        path: of the file.
        label: name of the file's kind in error messages.
        version: expected format, `name/number`.

    Raises:
        InputError: the file does not exist, is not YAML, has another format or a newer version.
    """
    require_file(path, label)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:  # RecursionError: hundreds of nested brackets
        reason = " ".join(str(error).split())
        raise InputError(f"expected {label} in {path}, which is not readable as YAML: {reason}") from None
    if not isinstance(content, dict):
        raise InputError(f"expected {label} in {path}, found no keys and values; is it the right file?")
    check_format(str(content.get("format", "no `format:`")), version, path)
    return content


def check_format(found: str, expected: str, path: Path) -> None:
    """Check the format of a file. Formats are written `name/number`, for instance `rafl-calibration/1`.

    Raises:
        InputError: the file has another format, or a newer version of it.
    """
    name, _, version = expected.partition("/")
    found_name, _, found_version = found.partition("/")
    if found_name != name or not found_version.isdigit():
        raise InputError(f"expected format {expected} in {path}, found {found!r}; is it the right file?")
    if int(found_version) > int(version):
        raise InputError(f"{path} has format {found}, newer than this program's {expected}; install a newer version")
