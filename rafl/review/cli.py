"""The command `rafl-review`: its options, and the checks that need no heavy import."""

import getpass
from pathlib import Path
from typing import Annotated

import typer

from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_folder
from rafl.common.names import check_visible

review_app = create_app("Review and correct tracks.")


@review_app.command()
@report_errors
def review(
    tracks: Annotated[Path, typer.Argument(help="Folder of tracks, written by rafl-track.")],
    videos: Annotated[
        Path | None, typer.Option(help="Folder of the videos, if they were moved [where rafl-track found them].")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Your name, for the corrections [your login].")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine [a free one].")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show tracks over their videos in a browser, and let you correct them. Ctrl-C ends it.

    Corrections are written to TRACKS/<recording>.corrections.yaml. The tracks files stay as they are. rafl-capture uses
    the corrections, and rafl-track applies them again.

    Example: rafl-review tracks/
    """
    require_folder(tracks, "a folder of tracks")
    if videos is not None:
        require_folder(videos, "a folder of videos")
    try:
        who = check_visible(name or getpass.getuser())
    except (ValueError, OSError, KeyError) as error:
        raise InputError(f"--name: {error}; give your name with --name") from None
    from rafl.review import commands

    commands.serve(commands.open_tracks(tracks, videos, who), port, browser)
