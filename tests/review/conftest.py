"""Tracked films, and the server on them."""

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import uvicorn
from filmed import Film, make_film, with_swapped
from playwright.sync_api import Browser, Page, sync_playwright
from served import Served
from starlette.testclient import TestClient

from rafl.review.server import View, create_server
from rafl.review.tracks.calls import TracksView
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.tracks import write_tracks

PORT, TOKEN = 4321, "token-of-the-tests"
OPTIONS = (
    "--no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-sync --no-first-run"
)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Film:
    """A film in which the left camera loses the marker B3 for 8 frames, as tracked."""
    folder = tmp_path_factory.mktemp("filmed")
    return make_film(folder, frames=80, hidden={frame: (7,) for frame in range(20, 28)})


@pytest.fixture
def film(filmed: Film, tmp_path: Path) -> Film:
    """A copy whose tracks take A1 and B1 for each other in the left camera from row 40 on."""
    shutil.copytree(filmed.folder, tmp_path / "lab")
    copy = Film(tmp_path / "lab", filmed.name, filmed.tracks)
    videos = {name: str(copy.folder / f"videos/swing/{name}.mp4") for name in filmed.tracks.videos}
    swapped = with_swapped(filmed.tracks, "A1", "B1", 40)
    swapped.videos.update(videos)
    write_tracks(copy.path, swapped)
    return copy


@pytest.fixture
def client(film: Film) -> Iterator[TestClient]:
    """A browser that has opened the address of a server on the film."""
    app = create_server(TracksView(Library(film.path.parent, None, "Ann")), TOKEN, PORT)
    with TestClient(app, base_url=f"http://127.0.0.1:{PORT}") as found:
        assert found.get(f"/?token={TOKEN}").status_code == 200
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    executable = shutil.which("chromium") or shutil.which("chromium-browser")
    if executable is None:
        pytest.skip("no chromium is installed: apt-get install chromium")
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=executable, args=OPTIONS.split())
        yield found
        found.close()


@pytest.fixture
def errors() -> list[str]:
    return []


@pytest.fixture
def page(browser: Browser, errors: list[str]) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    found = context.new_page()
    found.on("pageerror", lambda error: errors.append(str(error)))
    found.on("dialog", lambda dialog: errors.append(f"dialog {dialog.message}"))
    found.set_default_timeout(15_000)
    yield found
    context.close()


@pytest.fixture
def serve_view() -> Iterator[Callable[[View], str]]:
    """Serve a view in this process; returns the address."""
    running: list[tuple[uvicorn.Server, threading.Thread]] = []

    def start(view: View) -> str:
        listener = socket.create_server(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        app = create_server(view, TOKEN, port)
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        running.append((server, thread))
        return f"http://127.0.0.1:{port}/?token={TOKEN}"

    yield start
    for server, thread in running:
        server.should_exit = True
        thread.join(10)


@pytest.fixture
def serve(serve_view: Callable[[View], str]) -> Callable[[Path], str]:
    """Serve a folder of tracks in this process; returns the address."""
    return lambda folder: serve_view(TracksView(Library(folder, None, "Ann")))


@pytest.fixture
def launch() -> Iterator[Callable[[Path], Served]]:
    """Start the command `rafl-review` on a folder of tracks."""
    running = []

    def start(folder: Path) -> Served:
        program = "from rafl.review.cli import review_app; review_app()"
        is_run = (folder / "evaluation.h5").exists()
        named = [] if is_run else ["--name", "Ann"]
        line = [sys.executable, "-c", program, str(folder), "--no-browser", *named]
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
        running.append(process)
        assert process.stdout is not None
        text = ""
        for out in process.stdout:
            text += out
            if match := re.search(r"open (http://\S+)", text):
                return Served(process, match[1])
        raise AssertionError(text)

    yield start
    for process in running:
        process.kill()
        process.wait()
