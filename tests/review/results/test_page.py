"""What a person sees of an evaluation in a browser."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from evaluated import LOST, MARKED, METHODS, TIME_STEP, make_evaluation, swing
from playwright.sync_api import BrowserContext, Page
from shown import READ_VIEW, click_plot, frame, press

from rafl.evaluation.metrics import BASELINE
from rafl.evaluation.page_data import PageData

Show = Callable[..., Page]


@pytest.mark.parametrize("as_file", [False, True], ids=["served", "file"])
def test_step_scrub_and_play_by_keyboard(show: Show, data: PageData, as_file: bool) -> None:
    page = show(data, as_file)
    assert page.evaluate("document.body.dataset.recording") == "2"  # the first test recording
    press(page, "ArrowRight", "ArrowRight", "ArrowLeft", "Shift+ArrowRight")
    assert frame(page) == 11
    assert page.locator("#time").inner_text() == "0.110 s, frame 11 of 39"
    press(page, "End")
    assert frame(page) == 39
    press(page, "Home")
    assert frame(page) == 0
    page.locator("#frame").fill("25")
    assert frame(page) == 25
    page.select_option("#speed", "0.1")
    both = "[window.results.player.clock, performance.now() / 1000]"
    clock, begin = page.evaluate(f"(window.results.player.play(), {both})")
    page.wait_for_timeout(700)
    later, end = page.evaluate(both)
    assert later - clock == pytest.approx(0.1 * (end - begin), abs=0.03)
    assert page.locator("#play").inner_text() == "Stop"
    page.locator("#frame").focus()
    press(page, " ")
    assert page.locator("#play").inner_text() == "Play"
    assert frame(page) > 25
    press(page, ".", ".", ".", ".")
    assert page.evaluate("window.results.player.speed") == 1
    press(page, "Home", " ")
    page.wait_for_function("() => Number(document.body.dataset.frame) > 20")  # at full speed
    press(page, " ")


@pytest.mark.parametrize("as_file", [False, True], ids=["served", "file"])
def test_a_click_in_a_plot_goes_to_that_time(show: Show, data: PageData, as_file: bool) -> None:
    page = show(data, as_file)
    for plot, time_s in (("mean", 0.21), ("each", 0.302), ("path", 0.1)):
        click_plot(page, plot, time_s)
        assert abs(frame(page) - time_s / TIME_STEP) <= 1.0
        assert page.evaluate(f"window.results.plots.{plot}.time") == pytest.approx(TIME_STEP * frame(page), abs=1e-6)
    labels = page.evaluate("Object.values(window.results.plots).filter((p) => p.plot).map((p) => p.plot.axes[1].label)")
    assert labels == ["error [mm]", "error [mm]", "z [mm]"]


def test_plots_show_errors_of_methods_and_of_markers(show: Show, data: PageData) -> None:
    page, item = show(data), data.recordings[2]
    mean = page.evaluate("window.results.plots.mean.plot.data")
    np.testing.assert_allclose(mean[1], 1e3 * item.errors[BASELINE], rtol=1e-3)
    np.testing.assert_allclose(mean[2], 1e3 * item.errors["rafl"], rtol=1e-3)
    page.locator("[data-plot=each] select").select_option(BASELINE)
    press(page, "m")
    marker = int(page.locator("#marker").input_value())
    chosen = page.evaluate("window.results.plots.each.plot.data.at(-1)")
    expected = 1e3 * np.linalg.norm(item.simulated[BASELINE] - item.recorded, axis=-1)[:, marker]
    np.testing.assert_allclose(chosen, expected, atol=1e-3)
    page.locator("[data-plot=path] select").select_option("x")
    path = page.evaluate("window.results.plots.path.plot.data")
    np.testing.assert_allclose(path[1], 1e3 * item.recorded[:, marker, 0], atol=2e-3)
    np.testing.assert_allclose(path[3], 1e3 * item.simulated["rafl"][:, marker, 0], atol=2e-3)


def test_missing_markers_are_missing(show: Show, data: PageData) -> None:
    """A marker without a position is not drawn, has a gap in the plots, and is named."""
    page = show(data)
    page.select_option("#marker", str(LOST[0]))
    page.locator("#frame").fill("6")
    count = len(data.recordings[0].marker_names)
    assert page.locator("#missing").inner_text() == f"1 of {count} markers missing in this frame: m3"
    sizes = page.evaluate(
        "Array.from(window.results.scene.markers.instanceMatrix.array).filter((_, k) => k % 16 === 0)"
    )
    assert [k for k, size in enumerate(sizes) if size == 0] == [LOST[0]]
    for plot, column in (("path", 1), ("each", -1)):
        values = page.evaluate(f"window.results.plots.{plot}.plot.data.at({column})")
        assert [k for k, value in enumerate(values) if value is None] == list(range(5, 9))
    page.locator("#frame").fill("9")
    assert page.locator("#missing").inner_text() == f"all {count} markers recorded in this frame"


def test_a_recording_is_chosen(show: Show, data: PageData) -> None:
    """By the list, by keys, in the table, and by its curve in the plot of all recordings."""
    page = show(data)
    options = page.locator("#recording option").all_inner_texts()
    assert [text.split(" (")[1].split(",")[0] for text in options] == ["train", "val", "test"]
    means = [1e3 * data.recordings[0].errors[method].mean() for method in METHODS]
    assert options[0] == f"load060g (train, error {means[0]:.2f} / {means[1]:.2f} mm)"
    page.select_option("#recording", "0")
    page.wait_for_selector("body[data-ready][data-recording='0']")
    press(page, "n")
    page.wait_for_selector("body[data-ready][data-recording='1']")
    assert page.locator("#tables tr.current").inner_text().startswith("beam\tload065g\tval")
    page.get_by_role("button", name="load060g").click()
    page.wait_for_selector("body[data-ready][data-recording='0']")
    assert page.locator("#methods li").nth(1).inner_text().split("\n")[-1].startswith(f"{means[1]:.3f} ± ")
    page.locator("#curves .u-over").click()
    page.wait_for_selector("body[data-ready][data-recording='2']")
    assert frame(page) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("as_file", [False, True], ids=["served", "file"])
def test_bodies_side_by_side_overlaid_and_hidden(show: Show, data: PageData, as_file: bool) -> None:
    page = show(data, as_file)
    panels = "window.results.scene.panels().map((panel) => panel.methods)"
    assert page.evaluate(panels) == [[BASELINE], ["rafl"]]
    first = page.evaluate(READ_VIEW)
    assert first["share"] > 0.1
    press(page, "o")
    assert page.evaluate(panels) == [[BASELINE, "rafl"]]
    press(page, "4")  # the first method is hidden
    assert page.evaluate(panels) == [["rafl"]]
    colour = page.evaluate(READ_VIEW)["colour"]
    assert colour[2] > colour[0] + 20  # blue
    press(page, "4", "o", "l", "k", "+")
    moved = page.evaluate(READ_VIEW)
    assert moved["share"] > first["share"]
    press(page, "0")
    assert page.evaluate(READ_VIEW)["share"] == pytest.approx(first["share"], rel=0.01)


def test_the_body_is_where_the_simulation_has_it(show: Show, data: PageData) -> None:
    page, item = show(data), data.recordings[2]
    page.locator("#frame").fill("17")
    drawn = page.evaluate("Array.from(window.results.scene.bodies.get('rafl').faceGeometry.attributes.position.array)")
    vertices = item.motions["rafl"].vertices[17]
    expected = vertices[item.surface.faces[:, [0, 1, 2, 0, 2, 3]]].reshape(-1, 3)
    np.testing.assert_allclose(np.reshape(drawn, (-1, 3)), expected, atol=2e-6)
    np.testing.assert_allclose(item.simulated["rafl"][17], swing(40, 1.02)[17, MARKED], atol=1e-12)
    matrices = page.evaluate("Array.from(window.results.scene.markers.instanceMatrix.array)")
    np.testing.assert_allclose(np.reshape(matrices, (-1, 4, 4))[:, 3, :3], item.recorded[17], atol=2e-6)


def test_colours_of_strain_and_residual_force(show: Show, data: PageData) -> None:
    """The largest value over all methods and frames has the scale's last colour; what has no value is grey."""
    page, item = show(data), data.recordings[2]
    body = "window.results.scene.bodies.get('{}')"
    colours = "Array.from({}.faceGeometry.attributes.color.array)"
    press(page, "c")
    assert page.locator("#colouring").input_value() == "strain"
    most = max(motion.strain.max() for motion in item.motions.values())
    assert page.evaluate("window.results.scene.most()") == pytest.approx(most, rel=1e-4)
    shade = np.reshape(page.evaluate(colours.format(body.format("rafl"))), (-1, 6, 3))
    share = item.motions["rafl"].strain[0][item.surface.cells] / most
    assert np.argmax(shade[:, 0, 0] + shade[:, 0, 1]) == np.argmax(share)  # viridis grows lighter
    assert (shade == shade[:, :1]).all()  # one colour for each cell
    press(page, "c")
    grey = np.reshape(page.evaluate(colours.format(body.format(BASELINE))), (-1, 3))
    np.testing.assert_allclose(grey, 0.6, atol=1e-6)
    shade = np.reshape(page.evaluate(colours.format(body.format("rafl"))), (-1, 3))
    tip = item.motions["rafl"].vertices[0][item.surface.faces[:, [0, 1, 2, 0, 2, 3]].ravel(), 0]
    np.testing.assert_allclose(
        shade[tip > 0.0999], [[253 / 255, 231 / 255, 37 / 255]] * (tip > 0.0999).sum(), atol=0.01
    )
    np.testing.assert_allclose(shade[tip < 1e-4], [[68 / 255, 1 / 255, 84 / 255]] * (tip < 1e-4).sum(), atol=0.01)


def test_a_click_selects_a_marker(show: Show, data: PageData) -> None:
    page = show(data)
    x, y = page.evaluate(
        """() => {
          const { scene, motion } = window.results, box = scene.canvas.getBoundingClientRect();
          const [u, v] = scene.project(motion.recorded.values.subarray(3 * 11, 3 * 12), scene.panels()[1]);
          return [box.left + u, box.top + v];
        }"""
    )
    page.mouse.click(x, y)
    assert page.locator("#marker").input_value() == "11"
    assert page.locator("[data-plot=path] .heading").inner_text().startswith("Marker m11")


def test_errors_are_drawn_as_lines(show: Show, data: PageData) -> None:
    page, item = show(data), data.recordings[2]
    page.locator("#frame").fill("6")
    page.select_option("#lines", "10")
    ends = page.evaluate("Array.from(window.results.scene.bodies.get('rafl').lineGeometry.attributes.position.array)")
    lines = np.reshape(ends, (-1, 2, 3))
    expected = 10.0 * (item.recorded[6] - item.simulated["rafl"][6])
    expected[LOST[0]] = 0.0
    np.testing.assert_allclose(lines[:, 1] - lines[:, 0], expected, atol=4e-5)


@pytest.mark.parametrize(("methods", "count"), [(1, 1), (5, 1), (2, 200)])
def test_few_and_many_methods_and_recordings(show: Show, methods: int, count: int) -> None:
    names = (BASELINE, "rafl", "srl", "sysid", "constitutive")[:methods]
    page = show(PageData.of_evaluation(make_evaluation(names, count, 10), "x"))
    assert page.evaluate("window.results.scene.panels().length") == methods
    assert page.locator("#methods li").count() == methods
    assert page.evaluate(READ_VIEW)["share"] > 0.05
    assert page.locator("#recording option").count() == count
    assert page.locator("#tables h2").all_inner_texts() == [
        "Error of simulated markers",
        "Frequency, damping, rest position",
        "Error of each recording",
    ]


def test_recording_without_bodies_shows_markers_and_errors(show: Show) -> None:
    evaluation = make_evaluation()
    evaluation.comparisons[2] = replace(evaluation.comparisons[2], motions={})
    page = show(PageData.of_evaluation(evaluation, "x"))
    assert "holds the bodies of 2 of 3 recordings" in page.locator("#note").inner_text()
    assert 0.001 < page.evaluate(READ_VIEW)["share"] < 0.1
    click_plot(page, "path", 0.2)
    assert abs(frame(page) - 20) <= 1
    press(page, "n")
    page.wait_for_selector("body[data-ready][data-recording='0']")
    assert page.evaluate(READ_VIEW)["share"] > 0.1


def test_without_webgl_plots_and_tables_are_shown(show: Show, data: PageData, context: BrowserContext) -> None:
    context.add_init_script(
        """const original = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
          return kind.startsWith("webgl") ? null : original.call(this, kind, ...rest);
        };
        console.error = () => {};  // three.js writes that there is no WebGL"""
    )
    page = show(data)
    assert "draws nothing in 3-D" in page.locator("#warning").inner_text()
    click_plot(page, "mean", 0.2)
    assert abs(frame(page) - 20) <= 1
    press(page, "n")
    page.wait_for_selector("body[data-ready][data-recording='0']")
    assert page.locator("#warning").is_visible()
    assert not page.locator("#picture").is_visible()


def test_a_stopped_server_is_named(show: Show, data: PageData, context: BrowserContext, errors: list[str]) -> None:
    page = show(data)
    context.set_offline(True)
    press(page, "n")
    page.wait_for_selector("body[data-ready][data-recording='0']")
    assert page.locator("#warning").inner_text() == "rafl-review does not answer any more; start it again"
    assert errors.pop().startswith("Failed to load resource")


def test_light_and_dark(show: Show, data: PageData) -> None:
    page = show(data)
    levels = {}
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        page.wait_for_timeout(100)
        levels[scheme] = page.evaluate(
            """() => [getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]
              .map((text) => text.match(/\\d+/g).slice(0, 3).reduce((sum, part) => sum + Number(part), 0) / 3)"""
        )
    assert levels["light"][0] > 200 > 60 > levels["light"][1]
    assert levels["dark"][0] < 60 < 200 < levels["dark"][1]


def test_every_control_has_a_name(show: Show, data: PageData) -> None:
    page = show(data)
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll("button, select, input")].filter((one) =>
          !(one.tagName === "BUTTON" && one.textContent.trim()) && !one.ariaLabel && !one.labels?.length
        ).map((one) => one.outerHTML)"""
    )
    assert unnamed == []
    assert "load070g" in (page.locator("#scene").get_attribute("aria-label") or "")
