"""What all commands share: how errors are shown, the application's settings, progress bars."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rafl.common.errors import InputError

Command = TypeVar("Command", bound=Callable[..., Any])


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

    return wrapped


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
