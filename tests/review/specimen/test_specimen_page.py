"""The page on which a specimen is described, in a browser."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page
from stills import SIDES, SIZE_MM, corner_pixels, still_tracks

from rafl.capture.specimen.specimen import read_specimen
from rafl.review.server import View
from rafl.review.tracks.calls import TracksView
from rafl.review.tracks.recordings import Library
from rafl.tracking.reconstruction.tracks import write_tracks

ServeView = Callable[[View], str]
# Where a pixel of a camera's frame is on the screen.
ON_SCREEN = """([camera, x, y]) => {
  const view = window.review.views.find((one) => one.camera === camera);
  const [u, v] = view.toCanvas(x, y), box = view.canvas.getBoundingClientRect();
  const ratio = view.canvas.width / view.canvas.clientWidth;
  return [box.left + u / ratio, box.top + v / ratio];
}"""


def open_specimen(page: Page, tmp_path: Path, serve_view: ServeView, name: str = "still") -> None:
    if name == "still":
        write_tracks(tmp_path / "tracks/still.h5", still_tracks())
    page.goto(serve_view(TracksView(Library(tmp_path / "tracks", None, "Ann"), tmp_path)))
    page.wait_for_selector("body[data-ready=list]")
    page.get_by_role("link", name=name, exact=True).click()
    page.wait_for_selector("body[data-ready=recording]")
    page.get_by_role("link", name="Describe the specimen").click()
    page.wait_for_selector("body[data-ready=specimen]")


def find(page: Page) -> None:
    page.get_by_role("button", name="Find the dots' places").click()
    page.wait_for_function("() => !document.body.dataset.finding", timeout=120_000)


def test_technician_makes_a_specimen(tmp_path: Path, serve_view: ServeView, page: Page, errors: list[str]) -> None:
    """Eight clicks: the recording, the link, four corners, one to find the places, one to write."""
    open_specimen(page, tmp_path, serve_view)
    for corner in corner_pixels("left").tolist():
        page.mouse.click(*page.evaluate(ON_SCREEN, ["left", *corner]))
    page.wait_for_function("() => document.querySelector('#size-x').value !== ''")
    size = [float(page.input_value(f"#size-{side}")) for side in "xyz"]
    assert size == pytest.approx(SIZE_MM, abs=0.7)  # a pixel of the screen is 0.3 mm
    find(page)
    assert page.locator("#dots tr").count() == len(SIDES)
    page.get_by_role("button", name="Write").click()
    page.wait_for_function("() => document.querySelector('#written').textContent.startsWith('Wrote')")
    specimen = read_specimen(tmp_path / "specimen.yaml")
    assert np.abs(1e3 * specimen.layout.positions - SIDES).max() < 1.0
    page.get_by_role("button", name="Write").click()
    page.wait_for_selector("#replace[open]")
    assert "There is specimen.yaml and specimen.png already" in page.locator("#replace-text").inner_text()
    before = (tmp_path / "specimen.yaml").stat().st_mtime_ns
    page.get_by_role("button", name="Keep it").click()
    page.get_by_role("button", name="Write").click()
    page.wait_for_selector("#replace[open]")
    assert (tmp_path / "specimen.yaml").stat().st_mtime_ns == before
    page.get_by_role("button", name="Replace").click()
    page.wait_for_function("() => document.querySelector('#specimen-message').textContent === 'written'")
    assert errors == []


def test_corners_are_dragged_cleared_and_dots_unticked(
    tmp_path: Path, serve_view: ServeView, page: Page, errors: list[str]
) -> None:
    open_specimen(page, tmp_path, serve_view)
    corners = corner_pixels("left")
    for corner in (corners + np.array([[0, 0], [0, 0], [0, 0], [25, 0]])).tolist():
        page.mouse.click(*page.evaluate(ON_SCREEN, ["left", *corner]))
    page.wait_for_function("() => Number(document.querySelector('#size-x').value) > 102")
    page.mouse.move(*page.evaluate(ON_SCREEN, ["left", *(corners[3] + [25, 0])]))
    page.mouse.down()
    page.mouse.move(*page.evaluate(ON_SCREEN, ["left", *corners[3]]), steps=3)
    page.mouse.up()
    page.wait_for_function("() => Number(document.querySelector('#size-x').value) < 101")
    page.get_by_role("button", name="Clear").click()
    assert page.locator("#corners-count").inner_text() == "left: 0 of 4, right: 0 of 4"
    page.fill("#size-x", "100")
    page.fill("#size-y", "60")
    find(page)
    assert "the size of the body is wrong" in page.locator("#specimen-message").inner_text()
    assert page.locator("#found").is_hidden()
    page.fill("#size-y", "20")
    page.fill("#size-z", "20")
    find(page)
    page.locator("#dots input").first.uncheck()
    assert page.locator("#write").is_disabled()
    find(page)
    assert page.locator("#dots tr.left-out").count() == 1
    page.fill("#specimen-file", "../evil")
    page.get_by_role("button", name="Write").click()
    page.wait_for_function("() => document.querySelector('#specimen-message').textContent.includes('without slashes')")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tracks"]
    assert errors == []


def test_hostile_names_do_nothing(tmp_path: Path, serve_view: ServeView, page: Page, errors: list[str]) -> None:
    tracks = still_tracks()
    names = ("<img src=x onerror=alert(1)>", "'\"&amp;${alert(1)}", *tracks.names[2:])
    object.__setattr__(tracks, "names", names)
    name = "<b onclick=alert(1)>still"
    write_tracks(tmp_path / f"tracks/{name}.h5", tracks)
    open_specimen(page, tmp_path, serve_view, name)
    assert page.locator("#specimen-title").inner_text() == name
    for side, value in zip("xyz", SIZE_MM, strict=True):
        page.fill(f"#size-{side}", str(value))
    find(page)
    assert "<img src=x onerror=alert(1)>" in page.locator("#dots").inner_text()
    page.fill("#specimen-file", "<script>alert(1)<")
    page.get_by_role("button", name="Write").click()
    page.wait_for_function("() => document.querySelector('#written').textContent.startsWith('Wrote')")
    assert read_specimen(tmp_path / "<script>alert(1)<.yaml").name == "-script-alert-1--"
    assert page.locator("main img, main script, main b").count() == 0
    assert errors == []
