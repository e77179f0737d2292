"""Code that all commands share: error reports, application settings, progress bars."""

import functools
import os
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table
from rich.text import Text
from typer.core import TyperCommand

from rafl.common.errors import InputError
from rafl.common.interruption import Terminated, interruptible

P = ParamSpec("P")
R = TypeVar("R")

MAX_WAIT = 60.0  # [s], see `_let_first_report`; imports from a slow disk take some


def report_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Wrap a command so that it reports errors in one line on standard error instead of a traceback.

    The exit code is 2 after an `InputError`, an error of the file system or too little memory, 130 after Ctrl-C, and
    143 after SIGTERM.
    """

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with interruptible():
                return command(*args, **kwargs)
        except InputError as error:
            raise failure(f"error: {error}", 2) from None
        except OSError as error:
            path = error.filename or "a file"
            reason = error.strerror or error
            message = f"error: {path}: {reason}; check the path, its permissions and the space on the disk"
            raise failure(message, 2, shared=False) from None
        except MemoryError:
            message = "error: expected more free memory; end other programs, or use fewer recordings or a coarser mesh"
            raise failure(message, 2, shared=False) from None
        except KeyboardInterrupt as error:
            if _is_first():
                typer.echo("interrupted; no incomplete file was left", err=True)
            raise typer.Exit(143 if isinstance(error, Terminated) else 130) from None

    return wrapped


def failure(message: str, code: int, shared: bool = True) -> typer.Exit:
    """Report an error in one line on standard error.

    Of the processes that torchrun started on this machine, the first reports an error that all raise.

    Args:
        message: to report.
        code: for the exit.
        shared: whether all processes may raise the error.

    Returns:
        The exit, to be raised.
    """
    if shared:
        _let_first_report()
    typer.echo(one_line(message), err=True)
    return typer.Exit(code)


class SharedCommand(TyperCommand):
    """A command for torchrun: of its processes on this machine, the first reports arguments that cannot be read."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Read the arguments."""
        try:
            return super().make_context(*args, **kwargs)
        except typer.Exit:  # after --help
            raise
        except Exception:
            _let_first_report()
            raise


def _let_first_report() -> None:
    """Wait in all but the first of the processes that torchrun started on this machine, before an error of all.

    torchrun ends them once the first has ended; if one of them ended sooner, torchrun would not let the first report.
    Whoever waits in vain has an error of its own, and reports it.
    """
    if not _is_first():
        time.sleep(MAX_WAIT)


def _is_first() -> bool:
    """Whether this is the first of the processes that torchrun started on this machine, or the only one."""
    return os.environ.get("LOCAL_RANK", "0") == "0"


def one_line(text: str) -> str:
    """A text in one line of visible characters; others, as names from files may have, as escape sequences."""
    parts = (part if part.isprintable() else part.encode("unicode_escape").decode() for part in " ".join(text.split()))
    return "".join(parts)


def next_command(name: str, *arguments: object, remark: str = "") -> str:
    """A line that says which command comes next, with arguments quoted as a shell needs them.

    Args:
        name: of the command.
        arguments: options, paths and other values; a path that begins like an option gets `./` before it.
        remark: put after the command.
    """
    given = [
        f"./{argument}" if isinstance(argument, Path) and str(argument).startswith("-") else str(argument)
        for argument in arguments
    ]
    return f"next: {shlex.join([name, *given])}" + (f" {remark}" if remark else "")


def create_app(help_text: str) -> typer.Typer:
    """A typer application with the settings that all commands share."""
    return typer.Typer(
        help=help_text,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def progress(shown: bool = True) -> Progress:
    """A progress bar on standard error, so that standard output holds results only."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True, markup=False),
        transient=True,
        disable=not shown,
    )


class _PlainTable(Table):
    """A table whose text is shown as it is: rich would take `[px]` for a style and `:eye:` for a picture."""

    def add_row(self, *cells: str) -> None:  # type: ignore[override]  # of text only
        super().add_row(*map(Text, cells))


def create_table(*headings: str, title: str | None = None) -> _PlainTable:
    """A table for the terminal. Headings, cells and title are shown as they are."""
    return _PlainTable(*(Column(Text(heading)) for heading in headings), title=None if title is None else Text(title))
