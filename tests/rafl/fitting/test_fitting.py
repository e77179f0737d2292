from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from rafl.common.errors import InputError, SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.data.synthetic import with_material
from rafl.evaluation.metrics import compare
from rafl.fem.mesh import HexMesh
from rafl.fitting import train_field as fit
from rafl.fitting.methods import check_inputs
from rafl.fitting.residual_targets import residual_targets
from rafl.fitting.run_folder import FittedModel, Settings, load_model, load_tensors, save_model, save_tensors
from rafl.fitting.supervised import fit_supervised
from rafl.fitting.sysid import _Search, identify_material, spoken
from rafl.fitting.train_field import (
    fit_residual_field,
    mean_error,
    nothing_to_follow,
    shortened,
    training_items,
    validation_batches,
)
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.global_residual import GlobalResidual

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


def test_a_field_has_the_symmetry_of_what_it_is_trained_on(dataset: Dataset, tmp_path: Path) -> None:
    """A beam held at its end under gravity along z is its own mirror image across y; runs of old say nothing of it."""
    settings = replace(SETTINGS, epochs=1)
    model = fit_residual_field([dataset], settings, tmp_path / "one", silent)
    leaning = replace(dataset, simulator=replace(dataset.simulator, gravity=(0.0, 3.0, -9.0)))
    both = fit_residual_field([dataset, leaning], settings, tmp_path / "both", silent)
    assert model.field is not None
    assert both.field is not None
    assert model.field.mirrors.tolist() == [False, True, False]
    assert both.field.mirrors.tolist() == [False, False, False]
    content = load_tensors(tmp_path / "one" / "model.pt", "a model")
    del content["field"]["mirrors"]
    save_tensors(tmp_path / "one" / "model.pt", content)
    old = load_model(tmp_path / "one").field
    assert old is not None
    assert not old.mirrors.any()


def test_a_field_that_tears_the_body_apart_is_given_up(dataset: Dataset, tmp_path: Path) -> None:
    """Steps far too long: training goes on from the best field with shorter ones, and says what failed."""
    rows: list[dict[str, float]] = []
    settings = replace(SETTINGS, epochs=8, learning_rate=2.0, frames=0)
    model = fit_residual_field([dataset], settings, tmp_path, rows.append)
    assert any(row.get("failed", 0) > 0 for row in rows)
    assert rows[-1]["learning_rate"] < 0.5 * rows[1]["learning_rate"]
    assert 1e3 * mean_error(validation_batches([dataset]), model) == min(row["validation_mm"] for row in rows)


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


def test_a_model_steps_as_it_was_fitted(dataset: Dataset, tmp_path: Path) -> None:
    """Whatever integrator a dataset names; and what goes on from a model steps likewise."""
    settings = replace(SETTINGS, method="sysid", epochs=2, integrator="generalised-alpha")
    identified = identify_material([dataset], settings, tmp_path / "a", silent)
    assert load_model(tmp_path / "a").stepping == {"integrator": "generalised-alpha", "substeps": 1}
    stepped = replace(dataset, simulator=replace(dataset.simulator, integrator="generalised-alpha"))
    own, other = (mean_error([Recordings.of(each, ["d"])], identified) for each in (stepped, dataset))
    assert own == other
    assert own != mean_error([Recordings.of(dataset, ["d"])], replace(identified, stepping=None))
    errors = compare(stepped, {"sysid": identified})[-1].errors["sysid"]
    assert errors.mean() == pytest.approx(own)
    rows: list[dict[str, float]] = []
    settings = replace(SETTINGS, epochs=1, frames=0, start=str(tmp_path / "a"))
    corrected = fit_residual_field([dataset], settings, tmp_path / "b", rows.append)
    assert corrected.stepping == identified.stepping
    assert nothing_to_follow([dataset], replace(settings, warm_start=3))
    assert not nothing_to_follow([dataset], replace(settings, warm_start=3, start=""))
    other_steps = replace(dataset, name="other", simulator=replace(dataset.simulator, substeps=2))
    check_inputs("rafl", [dataset, other_steps], tmp_path / "a", "")
    for start, integrator in ((None, ""), (tmp_path / "a", "generalised-alpha")):
        with pytest.raises(InputError, match="2 substeps"):
            check_inputs("rafl", [dataset, other_steps], start, integrator)
    untrained = 1e3 * mean_error(validation_batches([dataset]), identified)
    assert rows[0]["validation_mm"] == pytest.approx(untrained, rel=0.05)  # the new field is nearly none


def test_a_field_corrects_the_identified_material(dataset: Dataset, tmp_path: Path) -> None:
    """Here the material explains all, so that a field on top of it starts where identification ended."""
    identified = identify_material([dataset], replace(SETTINGS, method="sysid", epochs=30), tmp_path / "a", silent)
    settings = replace(SETTINGS, epochs=2, frames=0, start=str(tmp_path / "a"), warm_start=3)
    model = fit_residual_field([dataset], settings, tmp_path / "b", silent)
    assert model.material == identified.material
    held_out = [Recordings.of(dataset, ["d"])]
    assert mean_error(held_out, load_model(tmp_path / "b")) < 0.01 * mean_error(held_out, FittedModel("original"))
    again = fit_residual_field([dataset], replace(settings, start=str(tmp_path / "b")), tmp_path / "c", silent)
    assert again.material == identified.material


def test_fine_tuning_follows_its_recordings_first(dataset: Dataset, tmp_path: Path) -> None:
    """All their frames, whatever of them is simulated; training begins no worse than the field came."""
    first = fit_residual_field([dataset], replace(SETTINGS, epochs=1, frames=6), tmp_path / "a", silent)
    other = with_material(dataset.simulator, 300e3, 0.3)
    changed = replace(dataset, simulator=other)
    came = 1e3 * mean_error(validation_batches([shortened(changed, 6)]), first)
    rows: list[dict[str, float]] = []
    settings = replace(SETTINGS, epochs=1, frames=6, start=str(tmp_path / "a"), warm_start=3)
    fit_residual_field([changed], settings, tmp_path / "b", rows.append)
    assert [row["warm_start"] for row in rows[:3]] == [1, 2, 3]
    assert rows[3]["epoch"] == 0
    assert rows[3]["validation_mm"] == pytest.approx(min([came, *(row["validation_mm"] for row in rows[:3])]))
    assert rows[3]["validation_mm"] < 0.9 * came
    followed = torch.load(tmp_path / "b" / "targets-0.pt", weights_only=True)
    steps = [len(dataset.trajectories[name].time) - 1 for name in dataset.split("train")]
    assert len(followed["q"]) == sum(steps)


def test_an_interrupted_identification_goes_on(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends as an uninterrupted one, and what was simulated before the end came is not simulated again."""
    settings = replace(SETTINGS, method="sysid", epochs=4)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    identify_material([dataset], settings, whole, silent)

    def stop(row: dict[str, float]) -> None:
        if row["epoch"] == 3:
            raise KeyboardInterrupt

    calls = []
    simulate = _Search._simulate
    monkeypatch.setattr(_Search, "_simulate", lambda self, x: (calls.append((self.frames, *x)), simulate(self, x))[1])
    with pytest.raises(KeyboardInterrupt):
        identify_material([dataset], settings, broken, stop)
    identify_material([dataset], settings, broken, silent)
    assert len(calls) == len(set(calls))
    assert (whole / "history.csv").read_text() == (broken / "history.csv").read_text()
    assert load_model(whole).material == load_model(broken).material


def test_the_stated_uncertainty_is_the_actual_one(dataset: Dataset, tmp_path: Path) -> None:
    """Over noisy copies of the recordings E scatters as its interval says; E and nu trade off, and it is said."""
    random = np.random.default_rng(3)
    found, widths = [], []
    for k in range(16):
        noisy = {
            name: replace(item, markers=item.markers + random.normal(0, 2e-4, item.markers.shape))
            for name, item in dataset.trajectories.items()
        }
        run = tmp_path / str(k)
        settings = replace(SETTINGS, method="sysid-e", epochs=4, frames=6)
        model = identify_material([replace(dataset, trajectories=noisy)], settings, run, silent)
        assert model.material is not None
        assert model.material["poissons_ratio"] == 0.499
        table = pd.read_csv(run / "parameters.csv")
        found.append(model.material["youngs_modulus"])
        widths.append((table["high_95"][0] - table["low_95"][0]) / 2 / 1.96)
    assert np.std(found, ddof=1) == pytest.approx(np.mean(widths), rel=0.5)  # of 16 copies, it varies by 18 %


def test_a_fit_beside_what_cannot_be_simulated_is_kept(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without an interval."""
    settings = replace(SETTINGS, method="sysid-e", epochs=3, frames=4)
    simulated = _Search._simulate

    def simulate(self: _Search, x: np.ndarray) -> tuple[float, list[float]]:
        if (tmp_path / "model.pt").exists():
            raise SimulationError("too stiff")
        return simulated(self, x)

    monkeypatch.setattr(_Search, "_simulate", simulate)
    model = identify_material([dataset], settings, tmp_path, silent)
    assert load_model(tmp_path).material == model.material
    assert "no interval" in spoken(pd.read_csv(tmp_path / "parameters.csv"))[0]


def test_a_material_that_explains_all_is_kept(dataset: Dataset, tmp_path: Path) -> None:
    """Nothing to gain, and nothing to divide by."""
    still = {
        name: replace(
            item, markers=np.broadcast_to(dataset.markers.rest, item.markers.shape), q=dataset.simulator.mesh.vertices
        )
        for name, item in dataset.trajectories.items()
    }
    simulator = replace(dataset.simulator, gravity=(0.0, 0.0, 0.0))
    settings = replace(SETTINGS, method="sysid-e", epochs=1)
    exact = replace(dataset, trajectories=still, simulator=simulator)
    model = identify_material([exact], settings, tmp_path, silent)
    assert mean_error(validation_batches([exact]), model) < 1e-9


def test_trading_off_is_said() -> None:
    table = pd.DataFrame(
        {
            "name": ["youngs_modulus", "poissons_ratio"],
            "unit": ["Pa", np.nan],
            "value": [2e5, 0.45],
            "low_95": [1.9e5, np.nan],
            "high_95": [2.1e5, np.nan],
            "correlation_youngs_modulus": [1.0, -0.97],
            "correlation_poissons_ratio": [-0.97, 1.0],
        }
    )
    first, second, third = spoken(table)
    assert "1.9e+05 to 2.1e+05" in first
    assert "no interval" in second
    assert "-0.970" in third


def test_supervised_residuals(dataset: Dataset, tmp_path: Path) -> None:
    """The targets follow the recordings, the network learns them, and another mesh is refused by name."""
    settings = replace(SETTINGS, method="srl", epochs=75, frames=0)
    recordings = Recordings.of(dataset, ["a", "b"])
    targets = residual_targets(recordings, 1e-8)
    assert np.sqrt(targets.objective.mean() / 20) < 2e-5
    model = fit_supervised([dataset], settings, tmp_path, silent)
    train = [recordings]
    assert mean_error(train, model) < 0.3 * mean_error(train, FittedModel("original"))
    again = load_model(tmp_path)
    assert mean_error(train, again) == mean_error(train, model)
    own = dataset.simulator
    stretched = replace(own, mesh=own.mesh.scaled([1.2, 0.9, 1.0]))
    forces = []
    for simulator in (own, stretched):
        residual, rest = model.residual(simulator), torch.from_numpy(simulator.mesh.vertices)[None]
        assert residual is not None
        forces.append(residual(rest, torch.zeros_like(rest), torch.zeros_like(rest)).detach())
    assert torch.equal(*forces)
    assert forces[0].abs().max() > 0
    other = replace(own, mesh=HexMesh.box((2, 1, 1), (0.02, 0.01, 0.01)))
    with pytest.raises(InputError, match=r"srl: expected the mesh .* found 12"):
        model.residual(other)


@pytest.mark.parametrize("method", ["rafl", "srl"])
def test_weights_of_another_version_are_refused(method: str, dataset: Dataset, tmp_path: Path) -> None:
    model = FittedModel("rafl", ResidualField()) if method == "rafl" else FittedModel("srl", network=GlobalResidual(8))
    save_model(tmp_path, model)
    content = load_tensors(tmp_path / "model.pt", "a model")
    part = content["field" if method == "rafl" else "network"]
    part["unknown"] = part.pop("scale" if method == "rafl" else "motion_mean")
    save_tensors(tmp_path / "model.pt", content)
    with pytest.raises(InputError, match=r"weights of this version in .*model\.pt.*fit again"):
        load_model(tmp_path)


@pytest.mark.parametrize("part", ["field", "optimiser", "shuffle", "history"])
def test_a_checkpoint_with_other_contents_is_refused(part: str, dataset: Dataset, tmp_path: Path) -> None:
    settings = Settings("rafl", ("a.h5",), 1, 1e-3, 0.0, 5, 0, 0)
    fit_residual_field([dataset], settings, tmp_path, silent)
    content = load_tensors(tmp_path / "checkpoint.pt", "a checkpoint")
    content[part] = [{"epoch": 1.0}, 3] if part == "history" else {"unknown": torch.zeros(3)}
    save_tensors(tmp_path / "checkpoint.pt", content)
    with pytest.raises(InputError, match=r"a checkpoint of this version in .*checkpoint\.pt, found .*fit again"):
        fit_residual_field([dataset], replace(settings, epochs=2), tmp_path, silent)


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
