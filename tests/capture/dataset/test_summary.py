"""What looks wrong in a dataset: units, markers that moved alike, first frames that do not fit, one film twice."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.summary import warnings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError
from rafl.data.dataset import Dataset


@pytest.fixture(scope="module")
def built(small_specimen: Specimen, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("tracks")
    q = tip_load_release(small_specimen, small_specimen.material, 0.06, 30, 100.0).q
    moving = small_specimen.markers(1e-6).positions(torch.from_numpy(q)).numpy()
    np.save(folder / "q0.npy", 1e3 * np.concatenate([small_specimen.layout.positions[None], moving]))
    rows = [RecordingRow(recording="q0", load_g=60, split="train")]
    return build_dataset(small_specimen, folder, rows, CaptureSettings(), "", lambda: None)


@pytest.mark.parametrize(
    ("unit", "hint"),
    [
        ({"youngs_modulus": 2.2e-1}, "if it is in MPa, write 220000"),
        ({"youngs_modulus": 220.0}, "if it is in kPa, write 220000"),
        ({"density": 1.07}, "if it is in g/cm3, write 1070"),
    ],
)
def test_a_wrong_unit_is_named_and_nothing_that_follows_from_it(
    unit: dict[str, float], hint: str, built: Dataset
) -> None:
    material = replace(built.simulator.material, **unit)
    (line,) = warnings(replace(built, simulator=replace(built.simulator, material=material)))
    assert line.endswith(hint)


def test_markers_that_moved_alike_are_told(built: Dataset) -> None:
    """A common shift of 0.6 mm is, one of 0.4 mm is not, and nor are dots that a hand has misplaced."""
    count = len(built.markers.names)

    def told(moved: np.ndarray) -> list[str]:
        return [
            line for line in warnings(replace(built, markers=replace(built.markers, moved=moved))) if "alike" in line
        ]

    scatter = np.random.default_rng(0).normal(0.0, 1e-4, (count, 3))
    (line,) = told(scatter + np.array([0.0, 0.0, -6e-4]))
    assert line.startswith("all markers were found moved alike from their at_mm in the first frames: -0.6 mm along z.")
    assert not told(scatter + np.array([0.0, 0.0, -4e-4]))
    assert not any(told(np.random.default_rng(seed).normal(0.0, 5e-4, (count, 3))) for seed in range(50))


def test_first_frames_that_do_not_fit_are_told(built: Dataset) -> None:
    swing = built.trajectories["q0"]
    assert not any("Check at_mm" in line for line in warnings(built))
    bad = replace(swing, attributes=swing.attributes | {"fit_residual_mm": 0.72})
    (line,) = (line for line in warnings(replace(built, trajectories={"q0": bad})) if "Check at_mm" in line)
    assert "(root mean square): q0 0.72. Check at_mm" in line


def test_one_recording_of_two_names_is_refused(small_specimen: Specimen, tmp_path: Path) -> None:
    still = np.repeat(1e3 * small_specimen.layout.positions[None], 4, axis=0)
    rows = []
    for name, split in (("q0", "train"), ("q1", "test")):
        np.save(tmp_path / f"{name}.npy", still)
        rows.append(RecordingRow(recording=name, load_g=60, split=split))
    with pytest.raises(InputError, match="recordings q0 and q1: expected different recordings, found the same"):
        build_dataset(small_specimen, tmp_path, rows, CaptureSettings(), "", lambda: None)
