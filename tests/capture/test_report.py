"""The report of a dataset in a browser: its tables fit into the window, and say what they count."""

import io
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import sync_playwright
from rich.console import Console

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.summary import recordings_table
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.report import dataset_page
from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset

NAMES = [f"2026-03-01_beam_take{k}_released" for k in range(6)]
# What `--refine-cameras` found: changes, their standard deviations, and what the pixels say, all with many digits.
CHANGE = np.array([*[-0.0123456] * 7, *[0.00123456] * 7, 12.345, 1.2345, 0.12345, 3.4567, 99.0, 0.012345, 9876.5])
ATTRIBUTES = {
    "load_g": 120.5,
    "still_frames": 120,
    "first_frame": 1234,
    "first_frame_from": "recordings.csv",
    "registration": "clamp markers, moving",
    "registration_residual_mm": 0.123,
    "loading": "hanging load",
    **{f"camera_change_{camera}": CHANGE for camera in ("left-upper", "right-upper")},
}


@pytest.fixture(scope="module")
def dataset(small_specimen: Specimen, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Six recordings with long names, in which the markers on one of two faces are unknown."""
    folder = tmp_path_factory.mktemp("npy")
    places = small_specimen.layout.positions
    seen = np.where(places[:, 1:2] == 0.0, places, np.nan)
    np.save(folder / "q0.npy", 1e3 * np.stack([places, *[seen] * 6]))
    rows = [RecordingRow(recording="q0", load_g=0, split="train")]
    settings = CaptureSettings(start=0, initial="rest", fps=100.0)
    built = build_dataset(small_specimen, folder, rows, settings, "", lambda: None)
    item = built.trajectories["q0"]
    return replace(
        built,
        trajectories={name: replace(item, attributes=item.attributes | ATTRIBUTES) for name in NAMES},
    )


def test_tables_fit_into_the_window(dataset: Dataset, small_specimen: Specimen, tmp_path: Path) -> None:
    executable = shutil.which("chromium") or shutil.which("chromium-browser")
    if executable is None:
        pytest.skip("no chromium is installed: apt-get install chromium")
    (tmp_path / "small.html").write_text(dataset_page(small_specimen, dataset), encoding="utf-8")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox", "--disable-gpu"])
        for width in (1280, 1000):
            page = browser.new_page(viewport={"width": width, "height": 900})
            page.goto((tmp_path / "small.html").as_uri())
            hidden = page.evaluate("[...document.querySelectorAll('table')].map(t => t.scrollWidth - t.clientWidth)")
            assert hidden == [0] * 5
        browser.close()


def test_valid_is_explained(dataset: Dataset, small_specimen: Specimen) -> None:
    shown = io.StringIO()
    Console(width=130, file=shown).print(recordings_table(dataset))
    text = " ".join(shown.getvalue().split())
    assert "50.0%" in text
    explained = "valid: share of positions that are known, of all markers in the specimen file in all frames"
    assert explained in text
    assert explained.removeprefix("valid") in " ".join(dataset_page(small_specimen, dataset).split())
