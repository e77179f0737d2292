"""Reading and validation of YAML files that a person writes."""

import math
import re
from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml

from rafl.common.errors import InputError
from rafl.common.files import require_file

MAX_YAML_BYTES = 1_000_000  # specimens and calibrations have thousands
MAX_YAML_NODES = 200_000  # more than a file of that size needs without aliases
LARGEST = 1e12  # of any number in any unit of any file; a larger one is damage, and its square or cube may overflow

Model = TypeVar("Model", bound=pydantic.BaseModel)


class StrictModel(pydantic.BaseModel):
    """Base class for the content of YAML files. An unknown key is an error, and so is a number that is not finite."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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
    return _validated(read_yaml_content(path, label, version), model, label, path)


def parse_yaml_text(text: str, model: type[Model], label: str, version: str, source: Path) -> Model:
    """Validate a YAML text that a file holds: `read_yaml` without the file.

    Args:
        text: to parse.
        model: class that the content is validated against.
        label: name of the text's kind in error messages.
        version: expected format, `name/number`.
        source: the file, for error messages.

    Raises:
        InputError: as for `read_yaml`.
    """
    return _validated(_parsed_content(text, label, version, source), model, label, source)


def _validated(content: dict[str, Any], model: type[Model], label: str, path: Path) -> Model:
    try:
        return model.model_validate(content)
    except pydantic.ValidationError as error:
        raise InputError(f"{label} {path}: {describe_validation(error)}; correct it") from None


def describe_validation(error: pydantic.ValidationError) -> str:
    """The first part of the content that is wrong, what was expected and found, and how many more are wrong."""
    first = error.errors()[0]
    # Where a list has entries of several kinds, the kind follows an entry's number: a tag in angle brackets.
    key = ".".join(str(part) for part in first["loc"] if not str(part).startswith("<")) or "the file"
    message = first["msg"].removeprefix("Value error, ")
    found = "" if first["type"] == "missing" or ", found " in message else f", found {first['input']!r:.80}"
    if first["type"] in ("invalid_key", "too_long"):  # `nu: 0,45` in braces, or [22,5, 0, 20]
        found += "; if a comma is a decimal sign, write a point"
    others = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return f"{key}: {message}{found}{others}"


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
    size = path.stat().st_size
    if size > MAX_YAML_BYTES:
        raise InputError(
            f"expected {label} in {path}, found {size / 1e6:.1f} MB, more than {MAX_YAML_BYTES / 1e6:g}; is it the "
            "right file?"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except ValueError as error:
        raise InputError(f"expected {label} in {path}, which is not readable as YAML: {error}; correct it") from None
    return _parsed_content(text, label, version, path)


def _parsed_content(text: str, label: str, version: str, path: Path) -> dict[str, Any]:
    """Keys and values of a YAML text of the expected format.

    Raises:
        InputError: no YAML, or another format or a newer version.
    """
    try:
        content = parse_yaml(text)
    # RecursionError: hundreds of nested brackets. ValueError: an impossible date, a number of thousands of digits.
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"expected {label} in {path}, which is not readable as YAML: {reason}; correct it") from None
    if not isinstance(content, dict):
        raise InputError(f"expected {label} in {path}, found no keys and values; is it the right file?")
    check_format(str(content.get("format", "no `format:`")), version, path)
    return content


def parse_yaml(text: str) -> Any:
    """The content of a YAML text.

    Raises:
        yaml.YAMLError: no YAML, or aliases that stand for more than `MAX_YAML_NODES` values.
        ValueError: a date or a number that does not exist, or a number beyond `LARGEST`.
        RecursionError: too deeply nested.
    """
    loader = yaml.SafeLoader(text)
    try:
        node = loader.get_single_node()  # aliases are references yet
        if node is None:
            return None
        _count_nodes(node, {})
        content = loader.construct_document(node)
    finally:
        loader.dispose()
    _check_numbers(content)
    return content


def _count_nodes(node: yaml.Node, counts: dict[int, int]) -> int:
    """Number of values that a node stands for, with those of its aliases. `counts`: of nodes seen, by identity."""
    if id(node) not in counts:
        counts[id(node)] = MAX_YAML_NODES  # until it is counted: an alias inside stands for the node itself, endlessly
        parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        children = () if isinstance(node, yaml.ScalarNode) else parts
        counts[id(node)] = 1 + sum(_count_nodes(child, counts) for child in children)
    if counts[id(node)] > MAX_YAML_NODES:
        raise yaml.YAMLError(f"aliases stand for more than {MAX_YAML_NODES} values; write the values out")
    return counts[id(node)]


def _check_numbers(content: Any, key: str = "") -> None:
    """Raise ValueError for a number that no quantity has: its square or cube could not be computed."""
    parts = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for name, part in parts:
        _check_numbers(part, f"{key}.{name}" if key else str(name))
    number = content
    if isinstance(content, str):  # YAML takes 1e300 for text, and a model then takes this text for a number
        try:
            number = float(content)
        except ValueError:
            return
    if isinstance(number, (int, float)) and abs(number) > LARGEST and number not in (math.inf, -math.inf):
        raise ValueError(f"{key}: expected numbers of at most {LARGEST:g}, found {str(content)[:20]}")


def check_format(found: str, expected: str, path: Path) -> None:
    """Check the format of a file. Formats are written `name/number`, for instance `rafl-calibration/1`.

    Raises:
        InputError: the file has another format, or a newer version of it.
    """
    name, _, version = expected.partition("/")
    found_name, _, found_version = found.partition("/")
    if found_name != name or re.fullmatch("[0-9]{1,9}", found_version) is None:
        raise InputError(f"expected format {expected} in {path}, found {found!r:.80}; is it the right file?")
    if int(found_version) > int(version):
        raise InputError(f"{path} has format {found}, newer than this program's {expected}; install a newer version")
