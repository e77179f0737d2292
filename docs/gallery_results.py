"""The screenshots of the results page on the site, from the demonstration's report (`make gallery`)."""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

OUT = Path(__file__).parent / "gallery"
OPTIONS = ["--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAME = 8  # near the turning point of the first swing
COLOURS = 192  # of a picture


def save(name: str, picture: bytes) -> None:
    """Save a screenshot with few colours."""
    Image.open(io.BytesIO(picture)).convert("RGB").quantize(COLOURS).save(OUT / f"{name}.png", optimize=True)


def go_to(page: Page, frame: int) -> None:
    """Show a frame."""
    page.locator("#frame").fill(str(frame))
    page.wait_for_timeout(400)


def main(demo: Path) -> None:
    """Make the screenshots from the demonstration in a folder."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=OPTIONS)
        page = browser.new_page(viewport={"width": 1440, "height": 860})
        page.goto((demo / "run/report.html").resolve().as_uri())
        page.wait_for_selector("body[data-ready=results]")
        go_to(page, FRAME)
        save("results-bodies", page.screenshot())
        page.select_option("#colouring", "strain")
        go_to(page, FRAME)
        save("results-strain", page.locator("#view").screenshot())
        page.select_option("#colouring", "none")
        page.select_option("#layout", "overlay")
        page.select_option("#lines", "1")
        go_to(page, FRAME)
        save("results-overlaid", page.locator("#view").screenshot())
        save("results-tables", page.locator("#tables").screenshot())
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
