"""What `rafl-review` does once its options are checked: serve the page on this machine until Ctrl-C."""

import secrets
import socket
import threading
import webbrowser
from pathlib import Path

import typer
import uvicorn
from threadpoolctl import threadpool_limits

from rafl.common.command_line import one_line
from rafl.common.errors import InputError
from rafl.common.interruption import Terminated
from rafl.common.kernels import announce_compilation
from rafl.review.calibration.boards import Boards
from rafl.review.calibration.calls import CalibrationView
from rafl.review.kinds import CALIBRATION, TRACKS, kind_of
from rafl.review.server import View, create_server
from rafl.review.tracks.calls import TracksView
from rafl.review.tracks.recordings import Library
from rafl.tracking.single_marker import load_kernels

HOST = "127.0.0.1"
SHUTDOWN_S = 2  # for requests that are being answered when the command is stopped


def open_view(path: Path, videos: Path | None, who: str, images: Path | None = None, board: Path | None = None) -> View:
    """The view of a path.

    Args:
        path: folder of tracks, calibration, run folder or dataset.
        videos: of tracks: folder of the videos; None where `rafl-track` found them.
        who: of tracks: name for corrections.
        images: of a calibration: folder of board images; None where `rafl-calibrate` found them.
        board: of a calibration: board description; None for that of `rafl-calibrate`, or with `images`, `board.yaml`
            in it.

    Raises:
        InputError: there is nothing of the kind, or it cannot be read.
    """
    kind = kind_of(path)
    if kind == TRACKS:
        return open_tracks(path, videos, who)
    if kind == CALIBRATION:
        return CalibrationView(Boards(path, images, board))
    from rafl.review.results.calls import ResultsView  # takes seconds, which tracks need not wait for

    return ResultsView.of_run(path) if path.is_dir() else ResultsView.of_dataset(path)


def open_tracks(tracks: Path, videos: Path | None, who: str) -> TracksView:
    """The view of a folder of tracks.

    Args:
        tracks: folder of tracks.
        videos: folder of videos; None where `rafl-track` found them.
        who: name for the corrections.

    Raises:
        InputError: there are no tracks.
    """
    library = Library(tracks, videos, who)
    if not library.names():
        raise InputError(
            f"expected tracks (.h5) or an evaluated model in {tracks}, found none; track the videos with rafl-track, "
            "or name a run folder that rafl-eval has evaluated"
        )
    announce_compilation()
    threading.Thread(target=load_kernels, daemon=True).start()
    return TracksView(library)


def serve(view: View, port: int, browser: bool) -> None:
    """Serve the page of a view until Ctrl-C.

    Args:
        view: what is shown.
        port: on the loopback interface; 0 for a free one.
        browser: whether to open the page.

    Raises:
        InputError: the port is taken.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        # With its protocol named, connections send at once instead of waiting for acknowledgements (TCP_NODELAY).
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, port))
            listener.listen()
        except OSError as error:
            raise InputError(f"--port: expected a free port, found {port}: {error.strerror}; choose another") from None
        port = listener.getsockname()[1]
        token = secrets.token_urlsafe(24)
        address = f"http://{HOST}:{port}/?token={token}"
        typer.echo(f"{one_line(view.title)}; Ctrl-C ends")
        typer.echo(f"open {address}")
        opening = threading.Thread(target=webbrowser.open, args=(address,), daemon=True)
        app = create_server(view, token, port, opening.start if browser else None)
        config = uvicorn.Config(app, log_level="error", access_log=False, timeout_graceful_shutdown=SHUTDOWN_S)
        try:
            with threadpool_limits(1, user_api="blas"):  # threads for matrices this small would only wait
                uvicorn.Server(config).run(sockets=[listener])
        except KeyboardInterrupt as error:
            if isinstance(error, Terminated):
                raise
            typer.echo("stopped; all that was confirmed is written")
