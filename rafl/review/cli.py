"""The command `rafl-review`: its options, and the checks that need no heavy import."""

import getpass
from pathlib import Path
from typing import Annotated

import typer

from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file, require_folder
from rafl.common.names import check_visible

CALIBRATION_SUFFIXES = (".yaml", ".yml")

review_app = create_app("Review and correct tracks, and look at a calibration.")


@review_app.command()
@report_errors
def review(
    path: Annotated[
        Path, typer.Argument(help="Folder of tracks, written by rafl-track, or a calibration, calib.yaml.")
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

    Of a calibration, the board images are shown with what was found in them, its residuals, and the world.

    Example: rafl-review tracks/

    Example: rafl-review calib.yaml
    """
    if path.suffix.lower() in CALIBRATION_SUFFIXES and not path.is_dir():
        if videos is not None or name is not None:
            raise InputError("expected --videos and --name with a folder of tracks only; leave them out")
        require_file(path, "a calibration (calib.yaml, written by rafl-calibrate)")
        if images is not None:
            require_folder(images, "a folder of board images")
        if board is not None:
            require_file(board, "a board description (board.yaml)")
        from rafl.review import commands

        commands.serve(commands.open_calibration(path, images, board), port, browser)
        return
    if images is not None or board is not None:
        raise InputError("expected --images and --board with a calibration (calib.yaml) only; leave them out")
    require_folder(path, "a folder of tracks, or calib.yaml")
    if videos is not None:
        require_folder(videos, "a folder of videos")
    try:
        who = check_visible(name or getpass.getuser())
    except (ValueError, OSError, KeyError) as error:
        raise InputError(f"--name: {error}; give your name with --name") from None
    from rafl.review import commands

    commands.serve(commands.open_tracks(path, videos, who), port, browser)
