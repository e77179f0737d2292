"""JSON files: what programs write for themselves about their units."""

import json
from pathlib import Path
from typing import TypeVar

import pydantic

from rafl.common.errors import InputError
from rafl.common.files import require_file, write_text
from rafl.common.yaml_files import StrictModel, check_format, describe_validation

Model = TypeVar("Model", bound=StrictModel)


def read_json(path: Path, model: type[Model], label: str, version: str, largest: int) -> Model:
    """Read and validate a JSON file.

    Args:
        path: of the file.
        model: class that the content, without its format, is validated against.
        label: name of the file's kind in error messages.
        version: expected format, `name/number`.
        largest: size beyond which it is refused [bytes].

    Raises:
        InputError: the file does not exist, is too large or no JSON, has another format or a newer version, or has a
            value of the wrong type.
    """
    require_file(path, label)
    size = path.stat().st_size
    if size > largest:
        raise InputError(
            f"expected {label} in {path}, found {size / 1e6:.1f} MB, more than {largest / 1e6:g}; is it the right file?"
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected {label} in {path}, which is not readable as JSON: {error!s:.120}") from None
    if not isinstance(content, dict):
        raise InputError(f"expected {label} in {path}, found no keys and values; is it the right file?")
    check_format(str(content.pop("format", "no `format`")), version, path)
    try:
        return model.model_validate(content)
    except pydantic.ValidationError as error:
        raise InputError(f"{label} {path}: {describe_validation(error)}; remove the file") from None


def write_json(path: Path, content: StrictModel, version: str) -> None:
    """Write a JSON file of a format, completely or not at all.

    Raises:
        InputError: as `rafl.common.files.atomic_file` says.
        OSError: likewise.
    """
    text = json.dumps({"format": version, **content.model_dump(mode="json")}, indent=1, ensure_ascii=False)
    write_text(path, text + "\n")
