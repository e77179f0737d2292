"""The command line of a unit, from the function that declares the command's options."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import UnionType
from typing import Annotated, Any, get_args, get_origin

from typer.models import ArgumentInfo, ParameterInfo

from rafl.batch.options import OWN


@dataclass(frozen=True)
class Parameter:
    """One parameter of a command.

    Attributes:
        option: as it is typed, for instance `--warm-start`; empty for an argument without a name.
        off: what is typed for False; empty if that cannot be typed.
        kind: type of a value.
        default: value if nothing is typed.
        least: smallest number allowed; None for any.
    """

    option: str
    off: str
    kind: type
    default: Any
    least: float | None


def parameters(command: Callable[..., None]) -> dict[str, Parameter]:
    """The parameters of a command, from its signature, by their names in Python."""
    return {name: _parameter(item) for name, item in inspect.signature(command).parameters.items()}


def _parameter(item: inspect.Parameter) -> Parameter:
    assert get_origin(item.annotation) is Annotated
    kind, info = get_args(item.annotation)[:2]
    assert isinstance(info, ParameterInfo)
    if isinstance(kind, UnionType):
        kind = next(part for part in get_args(kind) if part is not type(None))
    if get_origin(kind) is list:
        kind = get_args(kind)[0]
    if isinstance(info, ArgumentInfo):
        return Parameter("", "", kind, item.default, None)
    declared = (info.default, *(info.param_decls or ()))  # in an annotation, typer takes the first name for a default
    words = [word for word in declared if isinstance(word, str) and word.startswith("--")]
    own = f"--{item.name.replace('_', '-')}"
    option, _, off = (words[0] if words else f"{own}/--no-{own[2:]}" if kind is bool else own).partition("/")
    return Parameter(option, off, kind, item.default, info.min)


def plain_command(program: str, command: Callable[..., None], values: Mapping[str, Any]) -> tuple[str, ...]:
    """The line that gives a command some values.

    Args:
        program: name of the command.
        command: function that declares its options.
        values: by the names of its parameters. Defaults are left out, and so are the options of
            `rafl.batch.options`.
    """
    arguments: list[str] = []
    options: list[str] = []
    for name, parameter in parameters(command).items():
        value = values.get(name, parameter.default)
        if value == parameter.default or value is None or name in OWN:
            continue
        if not parameter.option:
            arguments += [path_argument(_text(part)) for part in _parts(value)]
        elif parameter.kind is bool:
            options.append(parameter.option if value else parameter.off)
        else:
            for text in map(_text, _parts(value)):
                options += [f"{parameter.option}={text}"] if text.startswith("-") else [parameter.option, text]
    return (program, *arguments, *options)


def path_argument(path: str) -> str:
    """A path as an argument that no command takes for an option."""
    return f"./{path}" if path.startswith("-") else path


def _parts(value: Any) -> Sequence[Any]:
    return value if isinstance(value, list | tuple) else [value]


def _text(value: Any) -> str:
    return str(value.value) if isinstance(value, Enum) else str(value)
