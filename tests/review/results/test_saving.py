"""What is saved of an evaluation: pictures, videos, and one file, which does nothing that it should not."""

import io
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from evaluated import METHODS, make_comparison, make_evaluation
from PIL import Image
from playwright.sync_api import BrowserContext, Page
from shown import READ_VIEW, open_page, press

from rafl.evaluation import page_file
from rafl.evaluation.evaluation_file import Evaluation, write_evaluation
from rafl.evaluation.metrics import BASELINE
from rafl.evaluation.page_data import PageData, pack_motion
from rafl.review.results.calls import ResultsView

Show = Callable[..., Page]


@pytest.mark.parametrize("as_file", [False, True], ids=["served", "file"])
def test_picture_and_video_are_saved(show: Show, data: PageData, tmp_path: Path, as_file: bool) -> None:
    page = show(data, as_file)
    press(page, "c")
    with page.expect_download() as saved:
        press(page, "s")
    assert saved.value.suggested_filename == "beam-load070g.png"
    image = np.asarray(Image.open(io.BytesIO(Path(saved.value.path()).read_bytes())).convert("RGB")).astype(int)
    assert image.shape[0] > 200
    view = page.evaluate("[window.results.scene.canvas.width, window.results.scene.canvas.height]")
    assert abs(image.shape[1] - view[0]) <= 1
    saturated = np.ptp(image, axis=2) > 60  # body and colour scale
    assert saturated.mean() > 0.05
    assert saturated[-45:, :200].mean() > 0.02  # the scale
    with page.expect_download(timeout=60_000) as saved:
        press(page, "v")
    shutil.copy(saved.value.path(), tmp_path / "video.webm")
    assert saved.value.suggested_filename == "beam-load070g.webm"
    with av.open(str(tmp_path / "video.webm")) as video:
        frames = [image.to_ndarray(format="gray") for image in video.decode(video=0)]
    assert len(frames) > 5
    change = [np.abs(frames[k].astype(int) - frames[0]).mean() for k in (len(frames) // 2, len(frames) - 1)]
    assert max(change) > 0.3


def test_page_saves_itself_as_one_file(
    show: Show, data: PageData, context: BrowserContext, errors: list[str], tmp_path: Path
) -> None:
    """The file shows the same without a network, and asks for nothing."""
    page = show(data)
    tables = page.locator("#tables").inner_text()
    with page.expect_download() as saved:
        page.click("#file")
    assert saved.value.suggested_filename == "Evaluation-x.html"
    shutil.copy(saved.value.path(), tmp_path / "saved.html")
    context.set_offline(True)
    copy = open_page(context, errors, (tmp_path / "saved.html").as_uri())
    assert copy.locator("#tables").inner_text() == tables
    assert copy.evaluate(READ_VIEW)["share"] > 0.1
    assert not copy.locator("#file").is_visible()
    for script in ("fetch('https://example.com')", "new Image().src = 'https://example.com/x.png'"):
        blocked = copy.evaluate(
            f"""() => new Promise((done) => {{
              document.addEventListener("securitypolicyviolation", (event) => done(event.effectiveDirective));
              Promise.resolve({script}).catch(() => {{}});
            }})"""
        )
        assert blocked in ("connect-src", "img-src", "default-src")
    errors[:] = [line for line in errors if "Content Security Policy" not in line and "example.com" not in line]


@pytest.mark.parametrize("as_file", [False, True], ids=["served", "file"])
def test_hostile_names_do_nothing(show: Show, as_file: bool) -> None:
    name = "</script><img src=x onerror=alert(1)><script>alert(2)</script>"
    item = make_comparison(name, methods=(BASELINE, name), dataset=name)
    item = replace(item, marker_names=tuple(f"{name}{k}" for k in range(len(item.marker_names))))
    page = show(PageData.of_evaluation(Evaluation([item], name), name), as_file)
    assert page.locator("#title").inner_text() == name
    assert page.locator("#models").inner_text() == name
    assert page.locator("#recording option").inner_text().startswith(f"{name} (test")
    assert page.locator("#methods li").nth(1).inner_text().startswith(name)
    assert page.locator("#marker option").nth(2).inner_text() == f"{name}2"
    assert page.locator("img").count() == 0
    page.wait_for_timeout(200)  # for what would run later


def test_file_without_a_motion_shows_its_errors(show: Show, data: PageData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_file, "MAX_BYTES", 2 * len(pack_motion(data.recordings[0])))  # one, as text
    page = show(data, as_file=True)
    press(page, "n")
    page.wait_for_selector("body[data-ready][data-recording='0']")
    assert "not in this file" in page.locator("#warning").inner_text()
    mean = page.evaluate("window.results.plots.mean.plot.data")
    np.testing.assert_allclose(mean[1], 1e3 * data.recordings[0].errors[BASELINE], rtol=1e-3)
    press(page, "p")
    page.wait_for_selector("body[data-ready][data-recording='2']")
    assert not page.locator("#warning").is_visible()


def test_thirty_recordings_load_quickly(show: Show, tmp_path: Path) -> None:
    """30 recordings of 200 frames, 90 elements and two methods: the file is read and the page is up within seconds."""
    evaluation = make_evaluation(METHODS, 30, 200)
    write_evaluation(tmp_path / "evaluation.h5", evaluation)
    begin = time.monotonic()
    data = ResultsView.of_run(tmp_path).data
    read = time.monotonic() - begin
    show(data)
    begin = time.monotonic()
    page = show(data)
    loaded = time.monotonic() - begin
    begin = time.monotonic()
    press(page, "n")
    page.wait_for_selector("body[data-ready][data-recording='3']")
    changed = time.monotonic() - begin
    content = page_file.page_file(data)
    print(f"read {read:.2f} s, page {loaded:.2f} s, next recording {changed:.2f} s, file {len(content) / 1e6:.1f} MB")
    assert read < 20.0
    assert loaded < 10.0
    assert changed < 5.0
    assert len(content) < 15e6
