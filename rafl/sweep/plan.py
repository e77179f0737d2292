"""`plan.yaml`: what a sweep fits, and what it evaluates."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from rafl import cli
from rafl.batch.options import OWN
from rafl.batch.plain_command import Parameter, parameters
from rafl.capture import cli as capture_cli
from rafl.common.errors import InputError
from rafl.common.names import Name, check_names, check_visible
from rafl.common.yaml_files import StrictModel, read_yaml

FORMAT = "rafl-sweep/1"
LABEL = "a plan of a sweep"
SEEDED = ("rafl", "srl")  # methods that start from random weights
# Options that the plan sets elsewhere, or that make no difference to a dataset or a model.
NOT_VARIED = (
    *("method", "seed", "out", "resume", "each", "tensorboard"),
    *("recordings", "update", "names", "inspect", "verify"),
)
START = "from"

Value = bool | int | float | str
Values = dict[str, Value | list[Value]]


class Method(StrictModel):
    """A method with options. An option with a list of values gives a variant for each.

    Attributes:
        method: of rafl-fit.
        name: in names of runs and in tables; the method's if empty.
        options: of rafl-fit, without the dashes before them.
    """

    method: str
    name: Name = ""
    options: Values = Field(default_factory=dict)

    @field_validator("method")
    @classmethod
    def _check_method(cls, method: str) -> str:
        if method not in cli.METHODS:
            raise ValueError(f"expected {', '.join(cli.METHODS)}")
        return method

    @field_validator("options")
    @classmethod
    def _check_options(cls, options: Values) -> Values:
        check_options(options, "rafl-fit", fit_options())
        return options

    @property
    def label(self) -> str:
        """Its name."""
        return self.name or self.method


class Plan(StrictModel):
    """Content of `plan.yaml`.

    Attributes:
        datasets: files, or patterns such as `datasets/*.h5`, relative to the plan.
        specimens: folders with specimen.yaml, recordings.csv and tracks/, or patterns, of which datasets are built.
        capture: options of rafl-capture for them.
        methods: to fit.
        seeds: of methods that start from random weights; others are fitted once.
        options: of every method that does not set them itself.
        train: `each` dataset by itself, `all` together, or `folds`: all datasets but those of one fold.
        folds: number of folds; one for each dataset if None.
        evaluate: each model on the datasets that it was trained on (`own`), on the others (`left-out`), or on `all`.
    """

    format: str
    datasets: tuple[str, ...] = ()
    specimens: tuple[str, ...] = ()
    capture: dict[str, Value] = Field(default_factory=dict)
    methods: tuple[Method, ...] = Field(min_length=1)
    seeds: tuple[int, ...] = Field((0,), min_length=1)
    options: Values = Field(default_factory=dict)
    train: Literal["each", "all", "folds"] = "each"
    folds: int | None = Field(None, ge=2)
    evaluate: Literal["own", "left-out", "all"] = "own"

    @field_validator("datasets", "specimens")
    @classmethod
    def _check_paths(cls, paths: tuple[str, ...]) -> tuple[str, ...]:
        for path in paths:
            check_visible(path)
        return paths

    @field_validator("capture")
    @classmethod
    def _check_capture(cls, options: dict[str, Value]) -> dict[str, Value]:
        check_options(options, "rafl-capture", capture_options())
        return options

    @field_validator("methods", mode="before")
    @classmethod
    def _expand_names(cls, methods: Any) -> Any:
        if not isinstance(methods, list):
            return methods
        return [{"method": entry} if isinstance(entry, str) else entry for entry in methods]

    @field_validator("methods")
    @classmethod
    def _check_labels(cls, methods: tuple[Method, ...]) -> tuple[Method, ...]:
        try:
            check_names(method.label for method in methods)
        except ValueError as error:
            raise ValueError(f"{error}; give each a `name`") from None
        return methods

    @field_validator("seeds")
    @classmethod
    def _check_seeds(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds):
            raise ValueError("expected different numbers")
        return seeds

    @field_validator("options")
    @classmethod
    def _check_options(cls, options: Values) -> Values:
        check_options(options, "rafl-fit", fit_options())
        return options

    @model_validator(mode="after")
    def _check_together(self) -> "Plan":
        if not (self.datasets or self.specimens):
            raise ValueError("datasets: expected at least one dataset, or `specimens`, found none")
        if self.folds is not None and self.train != "folds":
            raise ValueError(f"folds: expected `train: folds` beside it, found `train: {self.train}`")
        if self.evaluate == "left-out" and self.train == "all":
            raise ValueError(
                "evaluate: expected `own` or `all`, for `train: all` leaves no dataset out, found 'left-out'"
            )
        return self


Options = Mapping[str, tuple[str, Parameter]]  # name in Python and parameter, by the name without dashes


def check_options(options: Mapping[str, Value | list[Value]], command: str, known: Options) -> None:
    """Check options against those of a command.

    Raises:
        ValueError: an unknown option, or a value that the command refuses. The message names it.
    """
    for name, value in options.items():
        if name not in known:
            raise ValueError(f"{name}: expected an option of {command} ({', '.join(known)}), found {name!r:.80}")
        values = value if isinstance(value, list) else [value]
        if not values:
            raise ValueError(f"{name}: expected a value, found an empty list")
        for each in values:
            _check_value(known[name][1], name, each)


def fit_options() -> Options:
    """Options of rafl-fit that a plan may set."""
    return _options(cli.fit)


def capture_options() -> Options:
    """Options of rafl-capture that a plan may set."""
    return _options(capture_cli.capture)


def _options(command: Callable[..., None]) -> Options:
    return {
        item.option.removeprefix("--"): (name, item)
        for name, item in parameters(command).items()
        if item.option and name not in (*NOT_VARIED, *OWN)
    }


def _check_value(option: Parameter, name: str, value: Value) -> None:
    expected = {bool: "true or false", int: "a whole number", float: "a number"}.get(option.kind, "a text")
    if option.kind is float and not isinstance(value, bool):
        with suppress(ValueError):
            value = float(value)  # YAML takes 1e-3 for a text
    kinds = {float: (int, float), bool: (bool,), int: (int,)}.get(option.kind, (str,))
    if not isinstance(value, kinds) or isinstance(value, bool) != (option.kind is bool):
        raise ValueError(f"{name}: expected {expected}, found {value!r:.80}")
    if option.least is not None and isinstance(value, int | float) and value < option.least:
        raise ValueError(f"{name}: expected at least {option.least:g}, found {value:g}")
    allowed = [str(item.value) for item in option.kind] if issubclass(option.kind, Enum) else []
    if name == "integrator":
        allowed = list(cli.INTEGRATORS)
    if allowed and value not in allowed:
        raise ValueError(f"{name}: expected {' or '.join(allowed)}, found {value!r:.80}")


def read_plan(path: Path) -> Plan:
    """Read `plan.yaml`.

    Raises:
        InputError: as `rafl.common.yaml_files.read_yaml` says.
    """
    return read_yaml(path, Plan, LABEL, FORMAT)


@dataclass(frozen=True)
class Variant:
    """A method with one value for every option.

    Attributes:
        label: in names of runs and in tables.
        method: of rafl-fit.
        options: of rafl-fit.
    """

    label: str
    method: str
    options: Mapping[str, Value]


def variants(plan: Plan) -> list[Variant]:
    """All methods with all combinations of the values of their options."""
    found = []
    for method in plan.methods:
        options = {**plan.options, **method.options}
        several = {name: value for name, value in options.items() if isinstance(value, list)}
        for chosen in itertools.product(*several.values()):
            values = dict(zip(several, chosen, strict=True))
            label = "-".join([method.label, *(f"{name}={value}" for name, value in values.items())])
            single = {name: values.get(name, value) for name, value in options.items()}
            found.append(Variant(label.replace("/", "-"), method.method, single))  # type: ignore[arg-type]
    return found


def training_sets(plan: Plan, datasets: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """The label and the datasets of every set that is trained on.

    Raises:
        InputError: more folds than datasets, or one dataset and folds.
    """
    if plan.train == "each":
        yield from ((name, [name]) for name in datasets)
    elif plan.train == "all":
        yield "all", list(datasets)
    else:
        count = plan.folds or len(datasets)
        if not 2 <= count <= len(datasets):
            raise InputError(
                f"folds: expected from 2 to {len(datasets)}, the number of datasets, found {count}; change it"
            )
        for number in range(count):
            left_out = list(datasets[number::count])
            label = f"without-{left_out[0]}" if len(left_out) == 1 else f"fold-{number + 1}"
            yield label, [name for name in datasets if name not in left_out]
