"""How commands end: one line for every error, whatever names are in it, and no trace of an interrupted run."""

import io
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from rafl.common.command_line import create_table, next_command, one_line, report_errors
from rafl.common.errors import InputError
from rafl.common.files import atomic_file


def end(command: Callable[[], object]) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(report_errors(command))
    result = CliRunner().invoke(app, [])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stderr


def fail(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (InputError("expected a\nb"), 2, "error: expected a b\n"),
        (InputError("name \x1b[31m\u202e\ud800"), 2, "error: name \\x1b[31m\\u202e\\ud800\n"),
        (OSError(28, "No space left on device", "x.h5"), 2, "error: x.h5: No space left on device; check the path, "),
        (MemoryError(), 2, "error: expected more free memory; "),
        (KeyboardInterrupt(), 130, "interrupted; "),
    ],
)
def test_every_error_is_one_line(error: BaseException, code: int, message: str) -> None:
    found, text = end(fail(error))
    assert found == code
    assert text.startswith(message)
    assert text.count("\n") == 1


def test_sigterm_removes_temporary_files(tmp_path: Path) -> None:
    def command() -> None:
        with atomic_file(tmp_path / "new" / "a.h5") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(30.0)

    before = signal.getsignal(signal.SIGTERM)
    code, text = end(command)
    assert code == 143
    assert text.startswith("interrupted; ")
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interruption_inside_a_destructor_ends_the_command(number: int, code: int) -> None:
    class Waiting:
        def __del__(self) -> None:
            os.kill(os.getpid(), number)
            time.sleep(0.1)  # the signal is handled here, where Python drops what is raised

    def command() -> None:
        waiting = Waiting()
        del waiting
        time.sleep(30.0)

    before, hook = signal.signal(signal.SIGINT, signal.default_int_handler), sys.unraisablehook
    try:
        start = time.monotonic()
        assert end(command)[0] == code
        assert time.monotonic() - start < 10.0
    finally:
        signal.signal(signal.SIGINT, before)
    assert sys.unraisablehook == hook


def test_text_is_unchanged_where_it_can_be_seen() -> None:
    assert one_line("Prüfling [px] = 钢 \N{EYE}") == "Prüfling [px] = 钢 \N{EYE}"
    assert one_line("a\tb\r\n c\0") == "a b c\\x00"


def test_table_shows_names_as_they_are() -> None:
    names = ["[red]x[/red]", "[/b]", ":eye:", "[link=file:///etc]a[/link]", "\\[b]"]
    table = create_table("error [px]", *names, title="[/b] of all")
    table.add_row("a", *names)
    text = io.StringIO()
    Console(file=text, width=200).print(table)
    for name in ("error [px]", "[/b] of all", *names):
        assert name in text.getvalue()


def test_next_command_can_be_pasted() -> None:
    line = next_command("rafl-eval", Path("-run"), Path("a b") / "\u00fc.h5", "--out", "x", remark="(if at rest)")
    assert line == "next: rafl-eval ./-run 'a b/\u00fc.h5' --out x (if at rest)"
