"""The page in a browser: what a technician does, and what it leaves in the files."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from filmed import BIT_TOP, BIT_WIDTH, BITS, Film
from playwright.sync_api import Browser, Page
from served import Served
from synthetic_tracks import tracks_of_pixels

import rafl
from rafl.capture.rendering.film import side_cameras
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.tracking.reconstruction.corrected_tracks import read_corrected_tracks
from rafl.tracking.reconstruction.tracks import read_tracks, write_tracks
from rafl.tracking.reconstruction.triangulation import CameraPixels

Serve = Callable[[Path], str]
Launch = Callable[[Path], Served]
# Reads the frame number that is drawn into a bitmap on the page's canvas.
READ_COUNTER = f"""(camera) => {{
  const view = window.review.views.find((one) => one.camera === camera);
  const canvas = new OffscreenCanvas(view.image.width, view.image.height), pen = canvas.getContext("2d");
  pen.drawImage(view.image, 0, 0);
  let number = 0;
  for (let bit = 0; bit < {BITS}; bit++) {{
    const [level] = pen.getImageData({BIT_WIDTH} * (bit + 1) + {BIT_WIDTH // 2}, {BIT_TOP} + 10, 1, 1).data;
    if (level > 130) number += 2 ** bit;
  }}
  return number;
}}"""


def open_recording(page: Page, address: str, name: str = "swing") -> None:
    page.goto(address)
    page.wait_for_selector("body[data-ready=list]")
    page.get_by_role("link", name=name, exact=True).click()
    page.wait_for_selector("body[data-ready=recording]")


def position_of(page: Page, camera: str, marker: str) -> tuple[float, float]:
    """Where a marker is on the screen."""
    found = page.evaluate(
        """([camera, marker]) => {
          const view = window.review.views.find((one) => one.camera === camera);
          const { block, at } = view.rows.at(view.row), count = view.names.length;
          const cell = at * count + view.names.indexOf(marker), values = block.cameras[camera];
          const [x, y] = view.toCanvas(values.pixel[2 * cell], values.pixel[2 * cell + 1]);
          const box = view.canvas.getBoundingClientRect(), ratio = view.canvas.width / view.canvas.clientWidth;
          return [box.left + x / ratio, box.top + y / ratio];
        }""",
        [camera, marker],
    )
    return found[0], found[1]


def click_marker(page: Page, camera: str, marker: str, shift: bool = False) -> None:
    if shift:
        page.keyboard.down("Shift")
    page.mouse.click(*position_of(page, camera, marker))
    if shift:
        page.keyboard.up("Shift")


def go_to(page: Page, row: int) -> None:
    page.fill("#row", str(row))
    page.keyboard.press("Enter")
    page.wait_for_selector(f"body[data-row='{row}']")
    page.evaluate("document.activeElement.blur()")


def wait_for_correction(page: Page, text: str) -> None:
    said = "document.querySelector('#message').textContent.includes(text)"
    page.wait_for_function(f"(text) => {said} && !document.body.dataset.acting", arg=text)


def test_technician_finds_two_swapped_markers_and_mends_them(
    film: Film, serve: Serve, page: Page, errors: list[str]
) -> None:
    """Three actions after the page is up: a click on the recording, `n` to the worst stretch, `s` to swap back."""
    open_recording(page, serve(film.path.parent))
    page.keyboard.press("n")
    page.wait_for_selector("body[data-row='40'][data-selected='A1,B1']")
    assert page.evaluate(READ_COUNTER, "left") == 40
    page.keyboard.press("s")
    wait_for_correction(page, "A1 and B1 swapped from frame 40 of left on")
    np.testing.assert_allclose(read_corrected_tracks(film.path).tracks.position, film.tracks.position, atol=1e-9)
    page.wait_for_function("() => document.querySelector('#stretches').textContent.includes('exchanged') === false")
    assert errors == []


def test_every_correction_by_mouse_and_keyboard(film: Film, serve: Serve, page: Page, errors: list[str]) -> None:
    open_recording(page, serve(film.path.parent))
    go_to(page, 10)
    # Drag: fitted to the dot under the pointer; with Shift, set by hand.
    x, y = position_of(page, "left", "C3")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 9, y + 2, steps=3)
    page.mouse.up()
    wait_for_correction(page, "C3 fitted in frame 10")
    assert page.get_attribute("body", "data-selected") == "C3"  # what is dragged is selected
    assert page.locator("#plotted").inner_text() == "C3 in camera left, over the rows of the tracks"
    found = read_corrected_tracks(film.path).tracks
    np.testing.assert_allclose(found.pixel["left"][10, 12], film.tracks.pixel["left"][10, 12], atol=0.05)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 12, y, steps=3)
    page.keyboard.down("Shift")
    page.mouse.up()
    page.keyboard.up("Shift")
    wait_for_correction(page, "C3 set by hand in frame 10")
    moved = read_corrected_tracks(film.path).tracks.pixel["left"][10, 12] - film.tracks.pixel["left"][10, 12]
    assert 3.0 < moved[0] < 30.0
    page.keyboard.press("Control+z")
    wait_for_correction(page, "taken back")
    page.keyboard.press("Control+y")
    wait_for_correction(page, "made again")
    # Delete a stretch, then put the marker back and follow it on until its own track goes on.
    click_marker(page, "left", "C5")
    page.keyboard.press("[")
    go_to(page, 30)
    page.keyboard.press("]")
    page.keyboard.press("d")
    wait_for_correction(page, "C5 deleted in frames 10 to 30 of left")
    go_to(page, 10)
    page.keyboard.press("a")
    page.mouse.click(*position_of(page, "left", "C5"))
    page.wait_for_function("() => window.review.state.corrections.length === 5")
    page.wait_for_function("() => !window.review.corrector.following && !document.body.dataset.acting")
    found = read_corrected_tracks(film.path).tracks
    assert np.abs(found.pixel["left"][10:31, 14] - film.tracks.pixel["left"][10:31, 14]).max() < 0.2
    # A lost marker's cross is dragged onto the dot that comes back, and followed on.
    click_marker(page, "left", "B4")
    page.keyboard.press("[")
    go_to(page, 30)
    page.keyboard.press("]")
    page.keyboard.press("d")
    wait_for_correction(page, "B4 deleted in frames 10 to 30 of left")
    go_to(page, 10)
    x, y = position_of(page, "left", "B4")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 4, y + 4, steps=2)
    page.mouse.up()
    page.wait_for_function("() => window.review.state.corrections.length === 8")
    page.wait_for_function("() => !window.review.corrector.following && !document.body.dataset.acting")
    found = read_corrected_tracks(film.path).tracks
    assert np.abs(found.pixel["left"][10:31, 8] - film.tracks.pixel["left"][10:31, 8]).max() < 0.2
    # Rename, accept.
    click_marker(page, "left", "A2")
    page.fill("#new-name", "Tip")
    page.get_by_role("button", name="Rename").click()
    wait_for_correction(page, "A2 is now Tip")
    page.get_by_role("button", name="Accept").click()
    wait_for_correction(page, "Tip accepted in frames 10 to 10")  # the stretch was chosen for another marker
    assert page.locator("#corrections li").count() == 10
    assert "Ann" in page.locator("#corrections li").first.inner_text()
    for _ in range(11):
        page.get_by_role("button", name="Undo").click() if page.locator("#undo").is_enabled() else None
        page.wait_for_function("() => !document.body.dataset.acting")
    np.testing.assert_array_equal(read_corrected_tracks(film.path).tracks.position, read_tracks(film.path).position)
    assert errors == []


def test_steps_zoom_plots_and_play(film: Film, serve: Serve, page: Page, errors: list[str]) -> None:
    open_recording(page, serve(film.path.parent))
    for key, row in (("ArrowRight", 1), ("Shift+ArrowRight", 11), ("ArrowLeft", 10), ("End", 79), ("Home", 0)):
        page.keyboard.press(key)
        page.wait_for_selector(f"body[data-row='{row}']")
        assert page.evaluate(READ_COUNTER, "left") == page.evaluate(READ_COUNTER, "right") == row
    over = page.locator("[data-plot=path] .u-over").bounding_box()
    assert over is not None
    page.mouse.click(over["x"] + 0.5 * over["width"], over["y"] + 10)
    page.wait_for_function("() => Math.abs(Number(document.body.dataset.row) - 39.5) < 1.6")
    before = position_of(page, "left", "B3")
    page.mouse.move(*before)
    page.mouse.wheel(0, -400)
    page.wait_for_timeout(100)
    np.testing.assert_allclose(position_of(page, "left", "B3"), before, atol=1.0)
    assert position_of(page, "left", "B4")[0] - before[0] > 1.5 * 60 * 0.9
    page.keyboard.press("0")
    page.keyboard.press("e")
    page.keyboard.press("Home")
    page.keyboard.press(" ")
    page.wait_for_function("() => Number(document.body.dataset.row) > 5")
    page.keyboard.press(" ")
    assert errors == []


def test_killed_server_loses_nothing_that_was_confirmed(film: Film, launch: Launch, page: Page) -> None:
    served = launch(film.path.parent)
    open_recording(page, served.address)
    page.keyboard.press("n")
    page.keyboard.press("s")
    wait_for_correction(page, "swapped from frame 40")
    served.kill()
    np.testing.assert_allclose(read_corrected_tracks(film.path).tracks.position, film.tracks.position, atol=1e-9)
    again = launch(film.path.parent)
    open_recording(page, again.address)
    assert page.locator("#corrections li").count() == 1
    assert again.stop() == 0


def test_second_page_is_told(film: Film, serve: Serve, page: Page, browser: Browser) -> None:
    served = serve(film.path.parent)
    open_recording(page, served)
    second = browser.new_page()
    open_recording(second, served)
    assert "Another page has this recording open" in second.locator("#warning").inner_text()
    assert second.locator("button[data-do=delete]").is_disabled()
    page.keyboard.press("n")
    page.wait_for_selector("body[data-selected='A1,B1']")
    page.keyboard.press("s")
    second.wait_for_function("() => document.querySelectorAll('#corrections li').length === 1")
    page.goto("about:blank")
    second.wait_for_selector("body[data-writable=true]")
    assert second.locator("#warning").is_hidden()
    second.close()


def test_second_page_takes_over(film: Film, serve: Serve, page: Page, browser: Browser, errors: list[str]) -> None:
    served = serve(film.path.parent)
    open_recording(page, served)
    page.wait_for_selector("body[data-writable=true]")
    second = browser.new_page()
    open_recording(second, served)
    second.get_by_role("button", name="Correct it here").click()
    second.get_by_role("button", name="Leave it").click()
    assert second.get_attribute("body", "data-writable") == "false"
    second.get_by_role("button", name="Correct it here").click()
    second.locator("#taking button[value=yes]").click()
    second.wait_for_selector("body[data-writable=true]")
    page.wait_for_selector("body[data-writable=false]")
    assert "Another page has taken over this recording" in page.locator("#warning").inner_text()
    assert page.locator("button[data-do=swap]").is_disabled()
    second.keyboard.press("n")
    second.wait_for_selector("body[data-selected='A1,B1']")
    second.keyboard.press("s")
    page.wait_for_function("() => document.querySelectorAll('#corrections li').length === 1")
    second.close()
    assert errors == []


def test_corrections_of_other_tracks_are_kept_or_taken_out(
    film: Film, serve: Serve, page: Page, errors: list[str]
) -> None:
    served = serve(film.path.parent)
    open_recording(page, served)
    page.keyboard.press("n")
    page.wait_for_selector("body[data-selected='A1,B1']")
    page.keyboard.press("s")
    wait_for_correction(page, "swapped from frame 40")
    click_marker(page, "left", "C2")
    page.keyboard.press("Enter")
    wait_for_correction(page, "C2 accepted")
    tracks = read_tracks(film.path)
    tracks.pixel["left"][2, 3] += 0.5
    write_tracks(film.path, tracks)
    page.reload()
    page.wait_for_selector("body[data-ready=recording]")
    page.wait_for_selector("body[data-writable=true]")
    assert "Some corrections were made on other tracks" in page.locator("#warning").inner_text()
    page.get_by_role("button", name="It holds").last.click()
    wait_for_correction(page, "holds for these tracks")
    page.get_by_role("button", name="Take it out").click()
    wait_for_correction(page, "is taken out")
    assert page.locator("#corrections li").count() == 1
    assert page.locator("#warning").is_hidden()
    assert read_corrected_tracks(film.path).doubtful == ()
    assert errors == []


def test_hostile_names_do_nothing(film: Film, serve: Serve, page: Page, errors: list[str]) -> None:
    name = "<img src=x onerror=alert(1)>"
    tracks = read_tracks(film.path)
    names = ("<script>alert(1)<", "'\"&amp;${alert(1)}", *tracks.names[2:])
    for key, value in (("names", names), ("notes", ("<b onclick=alert(1)>bold",))):
        object.__setattr__(tracks, key, value)
    write_tracks(film.path.parent / f"{name}.h5", tracks)
    (film.path.parent / "%2e%2e.h5").write_bytes(b"nothing")
    (film.path.parent / "javascript:alert(1).h5").write_bytes(b"nothing")
    open_recording(page, serve(film.path.parent), name)
    page.keyboard.press("n")
    page.wait_for_function("() => document.body.dataset.selected")
    assert page.locator("#notes li").inner_text() == "<b onclick=alert(1)>bold"
    assert page.locator("#title").inner_text() == name
    assert page.locator("main img, main script, main b").count() == 0
    assert errors == []


def test_thousand_recordings(film: Film, serve: Serve, page: Page) -> None:
    for number in range(1000):
        shutil.copy(film.path, film.path.parent / f"take{number:04d}.h5")
    address = serve(film.path.parent)
    start = time.perf_counter()
    page.goto(address)
    page.wait_for_selector("body[data-ready=list]")
    page.wait_for_function("() => document.querySelector('#rows tr:nth-child(5)').cells[1].textContent === '80'")
    taken = time.perf_counter() - start
    print(f"1,001 recordings: page up in {taken:.2f} s")
    assert taken < 4.0
    page.fill("#filter", "take0999")
    assert page.locator("#rows tr:visible").count() == 1


def test_swap_made_on_the_page_is_in_the_dataset(
    tmp_path: Path, small_specimen: Specimen, specimen_file: Path, serve: Serve, page: Page
) -> None:
    """A release that the tracker has followed with two markers exchanged from row 9 on."""
    motion = tip_load_release(small_specimen, small_specimen.material, 0.06, 40, 100.0)
    markers = small_specimen.markers(1e-3)
    truth = markers.positions(torch.from_numpy(motion.q)).numpy()
    rig = side_cameras(small_specimen, [motion], np.random.default_rng(0))
    on_left = np.array([name.startswith("L") for name in markers.names])
    pixels = {}
    for camera, seen in (("left", on_left), ("right", ~on_left)):
        path = np.where(seen[:, None], rig.cameras[camera].project(truth), np.nan)
        if camera == "left":
            path[9:, [1, 2]] = path[9:, [2, 1]]
        pixels[camera] = CameraPixels(path, np.where(seen[:, None], 0.02, np.full_like(path, np.nan)))
    tracks = tracks_of_pixels(tuple(markers.names), rig, pixels, longest_gap=5)
    write_tracks(tmp_path / "tracks/load060g.h5", tracks)
    open_recording(page, serve(tmp_path / "tracks"), "load060g")
    page.keyboard.press("n")
    page.wait_for_selector("body[data-row='9'][data-selected='La1,La2']")
    assert "no video of camera left" in page.locator("[data-camera=left] .label").inner_text()
    page.keyboard.press("s")
    wait_for_correction(page, "La1 and La2 swapped from frame 9 of left on")
    (tmp_path / "recordings.csv").write_text("recording,load_g,split\nload060g,60,train\n")
    item = rafl.build_dataset(specimen_file, tmp_path / "tracks", tmp_path / "recordings.csv").trajectories["load060g"]
    assert str(item.attributes["corrections"]).startswith("1 of load060g.corrections.yaml ")
    start = int(str(item.attributes["first_frame"]))
    error = item.markers - truth[start : start + len(item.markers)]
    assert np.nanmax(np.abs(error[..., [0, 2]])) < 2e-4
