"""The page of a calibration in a browser: what a technician sees of boards, residuals, coverage and the plane."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_shots import bend, make_boards
from playwright.sync_api import Page

from rafl.review.calibration.boards import Boards
from rafl.review.calibration.calls import CalibrationView
from rafl.review.server import View

ServeView = Callable[[View], str]


@pytest.fixture
def calib(tmp_path: Path) -> Path:
    return make_boards(tmp_path)


def open_calibration(page: Page, address: str) -> None:
    page.goto(address)
    page.wait_for_selector("body[data-examined=yes]", timeout=60_000)


def colours(page: Page) -> np.ndarray:
    """The canvas as it is drawn, (H, W, 3)."""
    found = page.locator("#cameras canvas").screenshot()
    return np.asarray(cv2.imdecode(np.frombuffer(found, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int))


def test_technician_finds_the_image_that_spoils_a_calibration(
    calib: Path, serve_view: ServeView, page: Page, errors: list[str]
) -> None:
    """No click: the table marks it. One click on its row, or the key w, shows where and how."""
    bend(calib.parent / "calibration/left/03.png")
    open_calibration(page, serve_view(CalibrationView(Boards(calib, None, None))))
    assert page.locator("#images tr.large:not(.remark)").all_inner_texts()[0].startswith("03.png")
    page.locator("#images tr.large").first.click()
    page.wait_for_selector("body[data-drawn='left/03.png']")
    red, green, blue = np.moveaxis(colours(page), -1, 0)
    assert ((red > 220) & (green < 110) & (blue < 100)).sum() > 200  # arrows of points that are far off
    page.keyboard.press("n")
    page.wait_for_selector("body[data-drawn='left/04.png']")
    page.keyboard.press("w")
    page.wait_for_selector("body[data-drawn='left/03.png']")
    assert errors == []


def test_magnification_coverage_and_cameras(calib: Path, serve_view: ServeView, page: Page, errors: list[str]) -> None:
    open_calibration(page, serve_view(CalibrationView(Boards(calib, None, None))))
    assert page.locator("#facts").inner_text().count("found in 5 of 5 images") == 1
    assert "y = 0.0 mm" in page.locator("#facts").inner_text()
    page.select_option("#magnification", "1000")
    before = (colours(page)[..., 0] > 200).sum()
    assert page.evaluate("window.review.view.shown.magnification") == 1000
    page.keyboard.press("-")
    assert page.evaluate("window.review.view.shown.magnification") == 500
    assert (colours(page)[..., 0] > 200).sum() != before
    page.locator("#images tr").first.click()
    page.wait_for_selector("body[data-drawn=all]")
    corner, middle = page.evaluate("[[620, 460], [320, 240]].map(([x, y]) => window.review.view.toCanvas(x, y))")
    shown = colours(page)
    bare, covered = (np.median(shown[int(y) :, int(x) :][:12, :12], axis=(0, 1)) for x, y in (corner, middle))
    assert bare[0] > bare[1] + 15  # red where no board was
    assert covered[0] < covered[1] + 15
    page.get_by_role("button", name="right", exact=True).click()
    page.wait_for_selector("body[data-drawn='right/00.png']")
    assert "y = 30.0 mm" in page.locator("#facts").inner_text()
    page.keyboard.press("Tab")
    page.wait_for_selector("body[data-drawn='left/00.png']")
    assert errors == []


def test_plane_and_axes_are_drawn_where_the_board_is(
    calib: Path, serve_view: ServeView, page: Page, errors: list[str]
) -> None:
    """The grid has a line every 10 mm, 50 px; it ends where the box is not ticked, and follows calib.yaml."""
    open_calibration(page, serve_view(CalibrationView(Boards(calib, None, None))))
    page.uncheck("#show-corners")
    start, end = page.evaluate("[[120, 390], [260, 390]].map(([x, y]) => window.review.view.toCanvas(x, y))")
    along = round(start[1]), slice(round(start[0]) + 12, round(end[0]) - 12)
    red, green, _ = colours(page)[along].T
    assert ((red > 200) & (green < 150)).mean() > 0.9  # the x axis runs to the right from the world's origin
    page.uncheck("#show-plane")
    red, green, _ = colours(page)[along].T
    assert ((red > 200) & (green < 150)).mean() < 0.1
    paths = page.evaluate("window.review.shown().grid.lines.filter(({ axis }) => axis === 'x')")
    at = {line["value"]: line["path"][0][0] for line in paths}
    assert at[10] - at[0] == pytest.approx(50.0, abs=0.1)
    assert errors == []


def test_wrong_plane_and_wrong_pose_are_told(calib: Path, serve_view: ServeView, page: Page, errors: list[str]) -> None:
    """A normal along z instead of y, and a board that is 4 mm off the place in board.yaml."""
    calib.write_text(calib.read_text().replace("normal: [0.0, 1.0, 0.0]", "normal: [0.0, 0.0, 1.0]"))
    board = calib.parent / "calibration/board.yaml"
    board.write_text(board.read_text().replace("- -5.0", "- -1.0", 1))
    open_calibration(page, serve_view(CalibrationView(Boards(calib, None, None))))
    assert "the pose in board.yaml does not fit: " in page.locator("#images").inner_text()
    page.get_by_role("button", name="right", exact=True).click()
    page.wait_for_selector("body[data-drawn='right/00.png']")
    assert "the camera looks along its plane" in page.locator("#facts").inner_text()
    assert errors == []


def test_boards_that_are_not_found_and_hostile_names(
    calib: Path, serve_view: ServeView, page: Page, errors: list[str]
) -> None:
    left = calib.parent / "calibration/left"
    cv2.imwrite(str(left / "02.png"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(left / "04.png"), np.full((48, 64), 90, np.uint8))
    (left / "<img src=x onerror=alert(1)>.png").write_bytes(b"nothing")
    open_calibration(page, serve_view(CalibrationView(Boards(calib, None, None))))
    text = page.locator("#images").inner_text()
    assert "not used: no board was found there" in text
    assert "expected an image of 640 x 480 px as calibrated, found 64 x 48" in text
    assert "<img src=x onerror=alert(1)>.png" in text
    assert "which cannot be read" in text
    page.locator("#images tr", has_text="onerror").first.click()
    page.wait_for_function("() => document.body.dataset.drawn.includes('onerror')")
    assert "it cannot be shown" in page.locator("#cameras .label").inner_text()
    assert page.locator("main img, main script").count() == 0
    assert errors == []
