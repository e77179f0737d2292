from dataclasses import replace
from pathlib import Path

import pytest
import torch

from groundwork import InputError
from rafl import fit
from rafl.dataset import Dataset
from rafl.fit import fit_residual_field, mean_error, training_items
from rafl.objective import Recordings
from rafl.run import FittedModel, Settings, load_model
from rafl.sysid import identify_material

SETTINGS = Settings("rafl", ("small.h5",), 3, 2e-3, 1e-5, 10, 12, 5)


def silent(row: dict[str, float]) -> None:
    pass


def weights(run: Path) -> list[torch.Tensor]:
    model = load_model(run)
    assert model.field is not None
    return list(model.field.state_dict().values())


def test_training_lowers_the_error_on_held_out_recordings(dataset: Dataset, tmp_path: Path) -> None:
    model = fit_residual_field([dataset], replace(SETTINGS, epochs=12, learning_rate=5e-3, frames=0), tmp_path, silent)
    held_out = [Recordings.of(dataset, ["d"])]
    assert mean_error(held_out, model) < 0.5 * mean_error(held_out, FittedModel("original"))


def test_an_interrupted_run_ends_like_an_uninterrupted_one(dataset: Dataset, tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    fit_residual_field([dataset], SETTINGS, whole, silent)

    def stop_after_one(row: dict[str, float]) -> None:
        if row["epoch"] == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_residual_field([dataset], SETTINGS, broken, stop_after_one)
    fit_residual_field([dataset], SETTINGS, broken, silent)
    assert (whole / "history.csv").read_text() == (broken / "history.csv").read_text()
    for one, other in zip(weights(whole), weights(broken), strict=True):
        assert torch.equal(one, other)


def test_training_stops_when_it_no_longer_helps(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = iter([5.0, 4.0, 4.5, 4.4, 4.3, 4.2, 4.1])
    monkeypatch.setattr(fit, "mean_error", lambda *_: 1e-3 * next(errors))
    rows: list[dict[str, float]] = []
    fit_residual_field([dataset], replace(SETTINGS, epochs=50, patience=3, frames=3), tmp_path, rows.append)
    assert [row["epoch"] for row in rows] == [0, 1, 2, 3, 4]


def test_system_identification_explains_the_recordings(dataset: Dataset, tmp_path: Path) -> None:
    """A hundredth of the held-out error is left. E and nu themselves trade off against one another: a bent
    beam tells them apart poorly, so they are only near the truth."""
    settings = replace(SETTINGS, method="sysid", epochs=40, frames=0)
    model = identify_material([dataset], settings, tmp_path, silent)
    held_out = [Recordings.of(dataset, ["d"])]
    assert mean_error(held_out, model) < 0.01 * mean_error(held_out, FittedModel("original"))
    assert model.material is not None
    assert model.material["youngs_modulus"] == pytest.approx(190e3, rel=0.15)
    assert model.material["poissons_ratio"] == pytest.approx(0.45, abs=0.05)
    assert load_model(tmp_path).material == model.material


def test_an_interrupted_identification_goes_on(dataset: Dataset, tmp_path: Path) -> None:
    settings = replace(SETTINGS, method="sysid", epochs=2)
    identify_material([dataset], settings, tmp_path, silent)
    rows: list[dict[str, float]] = []
    identify_material([dataset], replace(settings, epochs=5), tmp_path, rows.append)
    assert [row["epoch"] for row in rows] == [3, 4, 5][: len(rows)]
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"] or rows[-1]["loss"] < 1e-4


def test_nothing_to_train_on_is_refused(dataset: Dataset) -> None:
    items = {name: replace(item, split="test") for name, item in dataset.trajectories.items()}
    with pytest.raises(InputError, match="split `train`"):
        training_items([replace(dataset, trajectories=items)])


def test_a_strangers_pickle_is_not_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (Path(tmp_path / "sprung"),))

    torch.save(Trap(), tmp_path / "model.pt")
    with pytest.raises(InputError, match="cannot be read"):
        load_model(tmp_path)
    assert not (tmp_path / "sprung").exists()
