"""The command `rafl-review`: its options, and the checks that need no heavy import."""

import getpass
from pathlib import Path
from typing import Annotated

import typer

from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file, require_folder
from rafl.common.names import check_visible

review_app = create_app("Look at results, and review and correct tracks.")


@review_app.command()
@report_errors
def review(
    path: Annotated[
        Path, typer.Argument(help="Folder of tracks, run folder that rafl-eval has evaluated, or dataset (.h5).")
    ],
    videos: Annotated[
        Path | None, typer.Option(help="Folder of the videos, if they were moved [where rafl-track found them].")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Your name, for the corrections [your login].")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine [a free one].")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show tracks over their videos in a browser, and let you correct them; or show results in 3-D. Ctrl-C ends it.

    Of a run folder it shows recorded markers and simulated bodies over time, with their errors; of a dataset, the
    markers. Of a folder of tracks it shows the videos with the markers. Corrections are written to
    TRACKS/<recording>.corrections.yaml. The tracks files stay as they are. rafl-capture uses the corrections, and
    rafl-track applies them again.

    Example: rafl-review tracks/
    """
    if path.suffix == ".h5":
        require_file(path, "a dataset (.h5, written by rafl-capture)")
    else:
        require_folder(path, "a folder of tracks, a run folder or a dataset (.h5)")
    if videos is not None:
        require_folder(videos, "a folder of videos")
    try:
        who = check_visible(name or getpass.getuser())
    except (ValueError, OSError, KeyError) as error:
        raise InputError(f"--name: {error}; give your name with --name") from None
    from rafl.review import commands

    commands.serve(commands.open_view(path, videos, who), port, browser)
