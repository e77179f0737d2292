"""The page of results in a browser, served or as a file."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from evaluated import make_evaluation
from playwright.sync_api import Browser, BrowserContext, Page
from shown import open_page

from rafl.evaluation import page_file
from rafl.evaluation.page_data import PageData
from rafl.review.results.calls import ResultsView
from rafl.review.server import View


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
def show(
    context: BrowserContext, errors: list[str], serve_view: Callable[[View], str], tmp_path: Path
) -> Callable[..., Page]:
    """Show data, served by default, or as a file without a network."""

    def start(data: PageData, as_file: bool = False) -> Page:
        if not as_file:
            return open_page(context, errors, serve_view(ResultsView(data, tmp_path)))
        (tmp_path / "report.html").write_text(page_file.page_file(data), encoding="utf-8")
        context.set_offline(True)
        return open_page(context, errors, (tmp_path / "report.html").as_uri())

    return start


@pytest.fixture
def data() -> PageData:
    """Three recordings (train, val, test) of a beam, each simulated by the baseline and by rafl."""
    return PageData.of_evaluation(make_evaluation(), "Evaluation x")
