"""The page of results in a browser, served or as a file."""

import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import uvicorn
from evaluated import make_evaluation
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright
from shown import open_page

from rafl.evaluation import page_file
from rafl.evaluation.page_data import PageData
from rafl.review.results.calls import ResultsView
from rafl.review.server import create_server

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
OPTIONS = (
    "--no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-sync --no-first-run"
)
TOKEN = "token-of-the-tests"

Show = Callable[..., Page]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium is installed: apt-get install chromium")
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS.split())
        yield found
        found.close()


@pytest.fixture
def errors() -> list[str]:
    """What went wrong on the page: errors, dialogs, and requests to anywhere but the server or the file itself."""
    return []


@pytest.fixture
def context(browser: Browser, errors: list[str]) -> Iterator[BrowserContext]:
    found = browser.new_context(viewport={"width": 1280, "height": 800}, color_scheme="light")
    yield found
    found.close()
    assert errors == []


@pytest.fixture
def show(context: BrowserContext, errors: list[str], tmp_path: Path) -> Iterator[Show]:
    """Show data, served by default, or as a file without a network."""
    running: list[tuple[uvicorn.Server, threading.Thread]] = []

    def serve(data: PageData) -> str:
        listener = socket.create_server(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        app = create_server(ResultsView(data, tmp_path), TOKEN, port)
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        running.append((server, thread))
        return f"http://127.0.0.1:{port}/?token={TOKEN}"

    def start(data: PageData, as_file: bool = False) -> Page:
        if as_file:
            (tmp_path / "report.html").write_text(page_file.page_file(data), encoding="utf-8")
            address = (tmp_path / "report.html").as_uri()
            context.set_offline(True)
        else:
            address = serve(data)
        return open_page(context, errors, address)

    yield start
    for server, thread in running:
        server.should_exit = True
        thread.join(10)


@pytest.fixture
def data() -> PageData:
    """Three recordings (train, val, test) of a beam, each simulated by the baseline and by rafl."""
    return PageData.of_evaluation(make_evaluation(), "Evaluation x")
