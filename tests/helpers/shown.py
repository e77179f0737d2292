"""The page of results in a browser: opened, watched, and used."""

from playwright.sync_api import BrowserContext, Page

# Mean colour of the 3-D view's panels, and the share of pixels that are not the background.
READ_VIEW = """() => {
  const { canvas } = window.results.scene, copy = new OffscreenCanvas(canvas.width, canvas.height);
  window.results.scene.draw();
  const pen = copy.getContext("2d");
  pen.drawImage(canvas, 0, 0);
  const { data } = pen.getImageData(0, 0, canvas.width, canvas.height);
  const sum = [0, 0, 0]; let drawn = 0;
  for (let k = 0; k < data.length; k += 4) {
    if (Math.abs(data[k] - data[0]) + Math.abs(data[k + 1] - data[1]) + Math.abs(data[k + 2] - data[2]) < 12) continue;
    drawn++;
    for (let c = 0; c < 3; c++) sum[c] += data[k + c];
  }
  return { share: 4 * drawn / data.length, colour: sum.map((value) => value / Math.max(drawn, 1)) };
}"""


def open_page(context: BrowserContext, errors: list[str], address: str) -> Page:
    """Open an address and wait for the page. What goes wrong on it is added to `errors`."""
    page = context.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("dialog", lambda dialog: errors.append(f"dialog {dialog.message}"))
    page.on("console", lambda line: line.type == "error" and errors.append(line.text))
    allowed = (address.split("?")[0], "blob:")
    page.on("request", lambda request: request.url.startswith(allowed) or errors.append(request.url))
    page.set_default_timeout(20_000)
    page.goto(address)
    page.wait_for_selector("body[data-ready=results]")
    return page


def frame(page: Page) -> int:
    return int(page.evaluate("document.body.dataset.frame"))


def press(page: Page, *keys: str) -> None:
    for key in keys:
        page.keyboard.press(key)


def click_plot(page: Page, plot: str, time_s: float) -> None:
    """Click in a plot at a time."""
    box, left = page.evaluate(
        """([name, time]) => {
          const { plot } = window.results.plots[name], box = plot.over.getBoundingClientRect();
          return [[box.left, box.top, box.width, box.height], plot.valToPos(time, "x")];
        }""",
        [plot, time_s],
    )
    page.mouse.click(box[0] + left, box[1] + 0.4 * box[3])
