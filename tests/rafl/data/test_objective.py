from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, frame_errors, training_loss
from rafl.evaluation.metrics import Transfer, compare, error_table, held_out_errors, latex_table, split_table
from rafl.fitting.run_folder import FittedModel


def with_gaps(dataset: Dataset) -> Dataset:
    """Recording a without its last 5 frames, and b with a third of its markers unobserved in frame 3."""
    a, b = dataset.trajectories["a"], dataset.trajectories["b"]
    short = {key: getattr(a, key)[:-5] for key in ("time", "markers", "valid", "sigma")}
    valid = b.valid.copy()
    valid[3, ::3] = False
    markers = np.where(valid[..., None], b.markers, np.nan)
    changed = {"a": replace(a, **short), "b": replace(b, valid=valid, markers=markers)}
    return replace(dataset, trajectories={**dataset.trajectories, **changed})


def test_error_of_a_known_offset(dataset: Dataset) -> None:
    """All markers are off by 3 mm: every frame has an error of 3 mm, also with gaps and in shorter recordings."""
    recordings = Recordings.of(with_gaps(dataset), ["a", "b"])
    simulated = recordings.markers + torch.tensor([0.0, 0.003, 0.0])
    errors = frame_errors(recordings, simulated)
    assert [len(values) for values in errors] == [20, 25]
    for values in errors:
        np.testing.assert_allclose(values, 0.003)


def test_loss_of_a_known_offset(dataset: Dataset) -> None:
    """1e3 * (markers * (3 mm)^2 + 1e-4 * sum f^2) per step; only observed markers count."""
    recordings = Recordings.of(with_gaps(dataset), ["b"])
    simulated = recordings.markers + torch.tensor([0.0, 0.003, 0.0])
    nodes = dataset.simulator.mesh.vertices.shape
    forces = torch.full((24, 1, *nodes), 0.1, dtype=torch.float64)
    expected = 1e3 * ((23 * 20 + 13) / 24 * 9e-6 + 1e-4 * 0.01 * nodes[0] * 3)
    assert float(training_loss(recordings, simulated, forces, 1e-4)) == pytest.approx(expected)


def test_error_tables(dataset: Dataset) -> None:
    """Standard deviations are over all frames of all recordings; held-out errors are of test recordings only."""
    comparisons = compare(
        dataset, {"sysid": FittedModel("sysid", material={"youngs_modulus": 190e3, "poissons_ratio": 0.45})}
    )
    rows = error_table(comparisons)
    assert set(rows["method"]) == {"original", "sysid"}
    assert len(rows) == 8
    # With the true material the simulation reproduces the recordings exactly.
    assert rows[rows["method"] == "sysid"]["mean_mm"].max() < 1e-5
    train = split_table(comparisons).query("split == 'train' and method == 'original'").iloc[0]
    pooled = np.concatenate([item.errors["original"] for item in comparisons if item.split == "train"])
    assert train["mean_mm"] == pytest.approx(1e3 * pooled.mean())
    assert train["std_mm"] == pytest.approx(1e3 * pooled.std())
    held_out = rows.query("recording == 'd' and method == 'original'")["mean_mm"].iloc[0]
    assert 1e3 * held_out_errors(comparisons)["original"] == pytest.approx(held_out)
    assert held_out > 0.3


def test_transfer_counts_datasets_with_larger_errors_and_latex_marks_the_best() -> None:
    splits = pd.DataFrame(
        [
            {"dataset": d, "split": split, "recordings": n, "method": m, "mean_mm": mean, "std_mm": 0.1}
            for d, split, n, values in (
                ("thick", "test", 2, (1.0, 0.5, 2.0)),
                ("thick", "train", 9, (9.0, 9.0, 9.0)),
                ("thin", "train", 1, (2.0, 1.0, 1.0)),
                ("thin", "val", 3, (4.0, 3.0, 9.0)),
            )
            for m, mean in zip(("original", "rafl", "sysid"), values, strict=True)
        ]
    )
    transfer = Transfer.of(splits)
    assert transfer.errors.loc["original"].tolist() == [1.0, 3.5]
    assert transfer.errors.loc["sysid"].tolist() == [2.0, 7.0]
    assert transfer.negative_transfers == {"rafl": 0, "sysid": 2}
    text = latex_table(splits)
    assert r"$\underline{\mathbf{0.500 \pm 0.100}}$" in text
    assert r"$2.000 \pm 0.100$" in text
    assert "9.000" not in text
