"""The command `rafl-review`: its options, and the checks that need no heavy import."""

import getpass
from pathlib import Path
from typing import Annotated

import typer

from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file, require_folder
from rafl.common.names import check_visible
from rafl.review.kinds import CALIBRATION, TRACKS, check_options

review_app = create_app("Review and correct tracks; look at a calibration, or at results.")


@review_app.command()
@report_errors
def review(
    path: Annotated[
        Path,
        typer.Argument(help="Folder of tracks, calib.yaml, run folder that rafl-eval has evaluated, or dataset (.h5)."),
    ],
    videos: Annotated[
        Path | None,
        typer.Option(help="Of tracks: folder of the videos, if they were moved [where rafl-track found them]."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Of tracks: your name, for the corrections [your login].")] = None,
    images: Annotated[
        Path | None,
        typer.Option(help="Of a calibration: folder of board images [those that it was made from]."),
    ] = None,
    board: Annotated[
        Path | None, typer.Option(help="Of a calibration: board description [as for rafl-calibrate].")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine [a free one].")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show tracks over their videos in a browser, and let you correct them. Ctrl-C ends it.

    Corrections are written to TRACKS/<recording>.corrections.yaml. The tracks files stay as they are. rafl-capture uses
    the corrections, and rafl-track applies them again. From a recording at rest, the page makes specimen.yaml, in the
    folder in which this command was started.

    Of a calibration, the board images are shown with what was found in them, its residuals, and the world. Of a run
    folder, recorded markers and simulated bodies are shown over time, with their errors; of a dataset, the markers.

    Example: rafl-review tracks/

    Example: rafl-review calib.yaml

    Example: rafl-review runs/thick
    """
    given: dict[str, tuple[object, str]] = {
        "--videos": (videos, TRACKS),
        "--name": (name, TRACKS),
        "--images": (images, CALIBRATION),
        "--board": (board, CALIBRATION),
    }
    kind = check_options(path, given)
    for folder, content in ((videos, "a folder of videos"), (images, "a folder of board images")):
        if folder is not None:
            require_folder(folder, content)
    if board is not None:
        require_file(board, "a board description (board.yaml)")
    try:
        who = check_visible(name or getpass.getuser()) if kind == TRACKS else ""
    except (ValueError, OSError, KeyError) as error:
        raise InputError(f"--name: {error}; give your name with --name") from None
    from rafl.review import commands

    commands.serve(commands.open_view(path, videos, who, images, board), port, browser)
