"""Code that all commands share: error reports, application settings, progress bars."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rafl.common.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


def report_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Wrap a command so that it reports errors in one line on standard error instead of a traceback.

    The exit code is 2 after an `InputError` or an error of the file system, and 130 after an interruption.
    """

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except InputError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(2) from None
        except OSError as error:
            path = error.filename or "a file"
            reason = error.strerror or error
            typer.echo(f"error: {path}: {reason}; check the path, its permissions and the disk", err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            typer.echo("interrupted; no incomplete file was left", err=True)
            raise typer.Exit(130) from None

    return wrapped


def create_app(help_text: str) -> typer.Typer:
    """A typer application with the settings that all commands share."""
    return typer.Typer(
        help=help_text,
        add_completion=False,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def progress() -> Progress:
    """A progress bar on standard error, so that standard output holds results only."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


def create_table(*headings: str, title: str | None = None) -> Table:
    """A table for the terminal. Headings and title are shown as they are: rich takes "[px]" for a style."""
    return Table(*map(escape, headings), title=title and escape(title))
