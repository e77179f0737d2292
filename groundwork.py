"""What every room stands on: errors a user can mend, files written whole, YAML read with care.

Knows nothing of cameras, meshes or physics.
"""

import functools
import glob
import hashlib
import os
import platform
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pydantic
import typer
import yaml
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

VERSION = "0.1.0"

Model = TypeVar("Model", bound=pydantic.BaseModel)
Command = TypeVar("Command", bound=Callable[..., Any])


class InputError(Exception):
    """A mistake in what the user gave: says what was expected, what was found and what to do."""


class StrictModel(pydantic.BaseModel):
    """Base of every file a person writes: an unknown key is an error, not a silent no-op."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


def user_command(command: Command) -> Command:
    """Turn an `InputError`, or a file system's refusal, into one line on standard error and exit code 2."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except InputError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(2) from None
        except OSError as error:
            where = error.filename or "a file"
            typer.echo(f"error: {where}: {error.strerror or error}; check the path, its rights and the disk", err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            typer.echo("stopped; nothing half-written was left behind", err=True)
            raise typer.Exit(130) from None

    return wrapped  # type: ignore[return-value]


def command_line(help_text: str) -> typer.Typer:
    """A typer application with the settings all commands share."""
    return typer.Typer(
        help=help_text,
        add_completion=False,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def progress() -> Progress:
    """A progress bar on standard error that leaves standard output clean."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success flush it to disk and rename it over `path`.

    On any failure the temporary file is removed and what stood at `path` is untouched. Temporary files of
    programs that were killed are removed too.

    Raises:
        InputError: a folder stands at `path`.
    """
    if path.is_dir():
        raise InputError(f"expected a file to write at {path}, found a folder; name a file in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(path)
    prefix = f".{path.stem}-{platform.node()}-{os.getpid()}-"
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        descriptor = os.open(temporary, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _remove_abandoned(path: Path) -> None:
    """Removes temporary files for `path` whose program, of this machine, is no longer there."""
    own = f".{path.stem}-{platform.node()}-"
    for temporary in path.parent.glob(f"{glob.escape(own)}*-*{glob.escape(path.suffix)}"):
        pid = temporary.name.removeprefix(own).split("-")[0]
        if not pid.isdecimal() or os.name == "nt":
            continue
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            temporary.unlink(missing_ok=True)
        except OSError:  # there, and another user's
            continue


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def require_file(path: Path, what: str) -> Path:
    """Return `path` where it is a readable file; else say what was expected there."""
    if not path.exists():
        raise InputError(f"expected {what} at {path}, found nothing there; check the path")
    if not path.is_file():
        raise InputError(f"expected {what} at {path}, found a folder; name the file itself")
    return path


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


def sha256(path: Path) -> str:
    """SHA-256 of a file's content; of a folder's files one after another, by name."""
    digest = hashlib.sha256()
    for part in sorted(path.iterdir()) if path.is_dir() else [path]:
        if part.is_file():
            with part.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()
