"""The screenshots of `rafl-review` on the site, from the demonstration's output (`make gallery`).

The recording shown is a copy in which the tracker's pixels of two markers are exchanged.
"""

import shutil
import socket
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import uvicorn
from playwright.sync_api import Page, sync_playwright

from rafl.calibration.rig import parse_calibration, read_calibration
from rafl.review.calibration.boards import Boards
from rafl.review.calibration.calls import CalibrationView
from rafl.review.server import View, create_server
from rafl.review.tracks.calls import TracksView
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks, write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels, triangulate

OUT = Path(__file__).parent / "gallery"
RECORDING, ROW = "load090g", 30
CORNERS = (
    (0.0, 0.0, 0.03),
    (0.0, 0.0, 0.0),
    (0.1011, 0.0, 0.0235),
    (0.0984, 0.0, -0.0063),
)  # of the beam as it hangs [m]


def with_exchanged(tracks: Tracks) -> Tracks:
    """The tracks with two neighbours of the left camera exchanged, and one marker lost for eight frames."""
    camera = "left"
    seen = [k for k in range(len(tracks.names)) if tracks.state[ROW, k] and (tracks.pixel[camera][ROW, k] > 0).all()]
    pair, lost = [seen[3], seen[4]], seen[10]
    for values in (tracks.pixel[camera], tracks.pixel_sigma[camera]):
        values[ROW:, pair] = values[ROW:, pair[::-1]]
        values[44:56, lost] = float("nan")
    rig = parse_calibration(tracks.calibration, Path("tracks"))
    pixels = {name: CameraPixels(tracks.pixel[name], tracks.pixel_sigma[name]) for name in tracks.pixel}
    position, sigma, residual = triangulate(rig, pixels)
    state = (position[..., 0] == position[..., 0]).astype("uint8")
    return replace(tracks, position=position, sigma=sigma, residual=residual, state=state)


@contextmanager
def opened(view: View) -> Iterator[Page]:
    """The page of a view in a browser."""
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    app = create_server(view, "gallery", port)
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
            )
            page = browser.new_page(viewport={"width": 1440, "height": 860})
            page.goto(f"http://127.0.0.1:{port}/?token=gallery")
            yield page
            browser.close()
    finally:
        server.should_exit = True
        thread.join()


def show_calibration(demo: Path) -> None:
    """The first board image of the left camera."""
    with opened(CalibrationView(Boards(demo / "calib.yaml", None, None))) as page:
        page.wait_for_selector("body[data-examined=yes]", timeout=120_000)
        page.wait_for_timeout(500)
        page.screenshot(path=OUT / "review-calibration.png")


def show_specimen(demo: Path) -> None:
    """The recording at rest with the corners of the left face, its outline and its dots."""
    rig = read_calibration(demo / "rest/calib.yaml")
    with opened(TracksView(Library(demo / "rest/tracks", None, "Ann"), demo)) as page:
        page.wait_for_selector("body[data-ready=list]")
        page.get_by_role("link", name="load000g").click()
        page.wait_for_selector("body[data-ready=recording]")
        page.get_by_role("link", name="Describe the specimen").click()
        page.wait_for_selector("body[data-ready=specimen]")
        for corner in rig.cameras["left"].project(np.array(CORNERS)).tolist():
            page.mouse.click(
                *page.evaluate(
                    """([x, y]) => {
                      const [view] = window.review.views, box = view.canvas.getBoundingClientRect();
                      const [u, v] = view.toCanvas(x, y);
                      return [box.left + u, box.top + v];
                    }""",
                    corner,
                )
            )
        page.wait_for_function("() => document.querySelector('#size-x').value !== ''")
        page.get_by_role("button", name="Find the dots' places").click()
        page.wait_for_selector("#found:not([hidden])", timeout=120_000)
        page.wait_for_timeout(500)
        page.screenshot(path=OUT / "review-specimen.png")


def show_tracks(demo: Path) -> None:
    """The list, a recording with two markers exchanged, and the same when they are swapped back."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "tracks"
        folder.mkdir()
        for path in (demo / "tracks").glob("*.h5"):
            write_tracks(folder / path.name, read_tracks(path))
        write_tracks(folder / f"{RECORDING}.h5", with_exchanged(read_tracks(folder / f"{RECORDING}.h5")))
        with opened(TracksView(Library(folder, None, "Ann"))) as page:
            page.wait_for_selector("body[data-ready=list]")
            page.wait_for_timeout(1000)
            page.screenshot(path=OUT / "review-list.png", clip={"x": 180, "y": 0, "width": 1080, "height": 330})
            page.get_by_role("link", name=RECORDING).click()
            page.wait_for_selector("body[data-ready=recording]")
            page.keyboard.press("n")
            page.wait_for_selector(f"body[data-row='{ROW}']")
            page.wait_for_timeout(500)
            page.screenshot(path=OUT / "review-exchanged.png")
            page.keyboard.press("s")
            page.wait_for_function("() => document.querySelector('#message').textContent.includes('swapped')")
            page.keyboard.press("n")
            page.wait_for_function("() => !document.body.dataset.acting && Number(document.body.dataset.row) === 44")
            page.wait_for_timeout(500)
            page.screenshot(path=OUT / "review-mended.png")
            page.keyboard.press("?")
            page.locator("#keys").screenshot(path=OUT / "review-keys.png")


def main(demo: Path) -> None:
    """Make the screenshots from the demonstration in a folder."""
    OUT.mkdir(exist_ok=True)
    show_calibration(demo)
    show_specimen(demo)
    show_tracks(demo)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
