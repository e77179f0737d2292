import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError, SimulationError
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.data.synthetic import loaded_equilibria, release_dataset, with_material
from rafl.evaluation.metrics import compare
from rafl.fem.material import Material
from rafl.fem.maxwell import branch_shares, complex_modulus
from rafl.fem.mesh import HexMesh
from rafl.fitting import train_field
from rafl.fitting.material_search import Evaluation, MaterialSearch
from rafl.fitting.methods import check_inputs
from rafl.fitting.quantities import BRANCH_TIMES, LOSS_FREQUENCIES
from rafl.fitting.residual_targets import residual_targets
from rafl.fitting.run_folder import FittedModel, Settings, load_model, load_tensors, save_model, save_tensors
from rafl.fitting.supervised import fit_supervised
from rafl.fitting.sysid import identify_material, parameter_sentences
from rafl.fitting.train_field import (
    fit_residual_field,
    mean_error,
    pretraining_unavailable,
    training_items,
    validation_batches,
)
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.global_residual import GlobalResidual

SETTINGS = Settings("rafl", ("small.h5",), 3, 2e-3, 1e-5, 10, 12, 5)


def ignore(row: dict[str, float]) -> None:
    pass


def weights(run: Path) -> list[torch.Tensor]:
    model = load_model(run)
    assert model.field is not None
    return list(model.field.state_dict().values())


def test_training_lowers_the_error_on_held_out_recordings(dataset: Dataset, tmp_path: Path) -> None:
    model = fit_residual_field([dataset], replace(SETTINGS, epochs=12, learning_rate=5e-3, frames=0), tmp_path, ignore)
    held_out = [Recordings.of(dataset, ["d"])]
    assert mean_error(held_out, model) < 0.5 * mean_error(held_out, FittedModel("original"))


def test_new_field_has_the_symmetry_of_its_training_datasets(dataset: Dataset, tmp_path: Path) -> None:
    """A clamped beam under gravity along z is symmetric across y. Models saved without mirrors have no symmetry."""
    settings = replace(SETTINGS, epochs=1)
    model = fit_residual_field([dataset], settings, tmp_path / "one", ignore)
    inclined = replace(dataset, simulator=replace(dataset.simulator, gravity=(0.0, 3.0, -9.0)))
    both = fit_residual_field([dataset, inclined], settings, tmp_path / "both", ignore)
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


def test_training_continues_from_the_best_field_after_a_failed_simulation(dataset: Dataset, tmp_path: Path) -> None:
    """The learning rate is far too high; it is reduced, and the history counts the failures."""
    rows: list[dict[str, float]] = []
    settings = replace(SETTINGS, epochs=8, learning_rate=2.0, frames=0)
    model = fit_residual_field([dataset], settings, tmp_path, rows.append)
    assert any(row.get("failed", 0) > 0 for row in rows)
    assert rows[-1]["learning_rate"] < 0.5 * rows[1]["learning_rate"]
    assert 1e3 * mean_error(validation_batches([dataset]), model) == min(row["validation_mm"] for row in rows)


def test_resumed_run_equals_an_uninterrupted_one(dataset: Dataset, tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    fit_residual_field([dataset], SETTINGS, whole, ignore)

    def stop_after_one(row: dict[str, float]) -> None:
        if row["epoch"] == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_residual_field([dataset], SETTINGS, broken, stop_after_one)
    fit_residual_field([dataset], SETTINGS, broken, ignore)
    assert (whole / "history.csv").read_text() == (broken / "history.csv").read_text()
    for one, other in zip(weights(whole), weights(broken), strict=True):
        assert torch.equal(one, other)


def test_training_stops_when_the_validation_error_stalls(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = iter([5.0, 4.0, 4.5, 4.4, 4.3, 4.2, 4.1])
    monkeypatch.setattr(train_field, "mean_error", lambda *_: 1e-3 * next(errors))
    rows: list[dict[str, float]] = []
    fit_residual_field([dataset], replace(SETTINGS, epochs=50, patience=3, frames=3), tmp_path, rows.append)
    assert [row["epoch"] for row in rows] == [0, 1, 2, 3, 4]


def test_system_identification_reproduces_the_recordings(dataset: Dataset, tmp_path: Path) -> None:
    """At most 1 % of the held-out error remains. E and nu are only near the truth: bending correlates them."""
    settings = replace(SETTINGS, method="sysid", epochs=40, frames=0)
    model = identify_material([dataset], settings, tmp_path, ignore)
    held_out = [Recordings.of(dataset, ["d"])]
    assert mean_error(held_out, model) < 0.01 * mean_error(held_out, FittedModel("original"))
    assert model.material is not None
    assert model.material["youngs_modulus"] == pytest.approx(190e3, rel=0.15)
    assert model.material["poissons_ratio"] == pytest.approx(0.45, abs=0.05)
    assert load_model(tmp_path).material == model.material


@pytest.mark.parametrize("method", ["sysid-loss", "sysid-branches"])
def test_identification_of_rubber_that_remembers(method: str, small_specimen: Specimen, tmp_path: Path) -> None:
    """E within 0.1 % and the loss factor at the swing's frequency within 1 %, from exact positions of all vertices."""
    frequency, mesh = torch.tensor([9.0], dtype=torch.float64), small_specimen.mesh
    shares = tuple(branch_shares(torch.tensor(0.12, dtype=torch.float64), *LOSS_FREQUENCIES).tolist())
    assumed = Material(150e3, 0.45, mass="lumped", law="corotated", integration="enhanced")
    remembering = {"branch_shares": shares, "branch_times": BRANCH_TIMES}
    target = replace(assumed, youngs_modulus=190e3, poissons_ratio=0.48, **remembering)
    base, lab = (
        replace(small_specimen.simulator(0.01, each), integrator="generalised-alpha") for each in (assumed, target)
    )
    starts = loaded_equilibria(lab, mesh.face_nodes("x-max"), np.array([0.04, 0.1]))
    recorded = release_dataset("small", base, lab, starts, 25, {"a": "train", "b": "train"})
    model = identify_material([recorded], replace(SETTINGS, method=method, epochs=25, frames=0), tmp_path, ignore)
    assert model.material is not None
    assert model.material["youngs_modulus"] == pytest.approx(190e3, rel=1e-3)

    def loss_factor(material: dict[str, Any]) -> float:
        own, times = (torch.tensor(material[key], dtype=torch.float64) for key in ("branch_shares", "branch_times"))
        storage, loss = complex_modulus(own, times, frequency)
        mu = material["youngs_modulus"] / (2 * (1 + material["poissons_ratio"]))
        viscous = 2 * np.pi * frequency * material.get("viscosity", 0.0) / mu
        return float((loss + viscous) / storage)

    assert loss_factor(model.material) == pytest.approx(loss_factor(vars(target)), rel=0.01)
    assert load_model(tmp_path).material == model.material


def test_model_keeps_the_time_integration_of_its_fit(dataset: Dataset, tmp_path: Path) -> None:
    """It overrides the integrator of a dataset, and a model trained from it inherits it."""
    settings = replace(SETTINGS, method="sysid", epochs=2, integrator="generalised-alpha")
    identified = identify_material([dataset], settings, tmp_path / "a", ignore)
    assert load_model(tmp_path / "a").time_integration == {"integrator": "generalised-alpha", "substeps": 1}
    alpha = replace(dataset, simulator=replace(dataset.simulator, integrator="generalised-alpha"))
    own, other = (mean_error([Recordings.of(each, ["d"])], identified) for each in (alpha, dataset))
    assert own == other
    assert own != mean_error([Recordings.of(dataset, ["d"])], replace(identified, time_integration=None))
    errors = compare(alpha, {"sysid": identified})[-1].errors["sysid"]
    assert errors.mean() == pytest.approx(own)
    rows: list[dict[str, float]] = []
    settings = replace(SETTINGS, epochs=1, frames=0, start=str(tmp_path / "a"))
    corrected = fit_residual_field([dataset], settings, tmp_path / "b", rows.append)
    assert corrected.time_integration == identified.time_integration
    assert pretraining_unavailable([dataset], replace(settings, warm_start=3))
    assert not pretraining_unavailable([dataset], replace(settings, warm_start=3, start=""))
    other_steps = replace(dataset, name="other", simulator=replace(dataset.simulator, substeps=2))
    check_inputs("rafl", [dataset, other_steps], tmp_path / "a", "")
    for start, integrator in ((None, ""), (tmp_path / "a", "generalised-alpha")):
        with pytest.raises(InputError, match="2 substeps"):
            check_inputs("rafl", [dataset, other_steps], start, integrator)
    untrained = 1e3 * mean_error(validation_batches([dataset]), identified)
    assert rows[0]["validation_mm"] == pytest.approx(untrained, rel=0.05)  # a new field has almost no effect


def test_field_is_trained_on_top_of_the_identified_material(dataset: Dataset, tmp_path: Path) -> None:
    """The material alone reproduces these recordings, so the field keeps the error of the identification."""
    identified = identify_material([dataset], replace(SETTINGS, method="sysid", epochs=30), tmp_path / "a", ignore)
    settings = replace(SETTINGS, epochs=2, frames=0, start=str(tmp_path / "a"), warm_start=3)
    model = fit_residual_field([dataset], settings, tmp_path / "b", ignore)
    assert model.material == identified.material
    held_out = [Recordings.of(dataset, ["d"])]
    assert mean_error(held_out, load_model(tmp_path / "b")) < 0.01 * mean_error(held_out, FittedModel("original"))
    again = fit_residual_field([dataset], replace(settings, start=str(tmp_path / "b")), tmp_path / "c", ignore)
    assert again.material == identified.material


def test_fine_tuning_begins_with_pretraining(dataset: Dataset, tmp_path: Path) -> None:
    """Pre-training uses all frames, even if training simulates fewer. It does not increase the validation error."""
    first = fit_residual_field([dataset], replace(SETTINGS, epochs=1, frames=6), tmp_path / "a", ignore)
    other = with_material(dataset.simulator, 300e3, 0.3)
    changed = replace(dataset, simulator=other)
    initial = 1e3 * mean_error(validation_batches([changed.first_frames(6)]), first)
    rows: list[dict[str, float]] = []
    settings = replace(SETTINGS, epochs=1, frames=6, start=str(tmp_path / "a"), warm_start=3)
    fit_residual_field([changed], settings, tmp_path / "b", rows.append)
    assert [row["warm_start"] for row in rows[:3]] == [1, 2, 3]
    assert rows[3]["epoch"] == 0
    assert rows[3]["validation_mm"] == pytest.approx(min([initial, *(row["validation_mm"] for row in rows[:3])]))
    assert rows[3]["validation_mm"] < 0.9 * initial
    targets = torch.load(tmp_path / "b" / "targets-0.pt", weights_only=True)
    steps = [len(dataset.trajectories[name].time) - 1 for name in dataset.split("train")]
    assert len(targets["q"]) == sum(steps)


def test_interrupted_identification_is_resumed(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends like an uninterrupted one and repeats no simulation."""
    settings = replace(SETTINGS, method="sysid", epochs=4)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    identify_material([dataset], settings, whole, ignore)

    def stop(row: dict[str, float]) -> None:
        if row["epoch"] == 3:
            raise KeyboardInterrupt

    calls = []
    simulate = MaterialSearch._simulate
    monkeypatch.setattr(
        MaterialSearch, "_simulate", lambda self, x: (calls.append((self.frames, *x)), simulate(self, x))[1]
    )
    with pytest.raises(KeyboardInterrupt):
        identify_material([dataset], settings, broken, stop)
    identify_material([dataset], settings, broken, ignore)
    assert len(calls) == len(set(calls))
    assert (whole / "history.csv").read_text() == (broken / "history.csv").read_text()
    assert load_model(whole).material == load_model(broken).material


def test_interval_matches_the_scatter_over_noisy_recordings(dataset: Dataset, tmp_path: Path) -> None:
    """The standard deviation of E over noisy copies of the recordings agrees with its 95 % interval."""
    random = np.random.default_rng(3)
    estimates, sigmas = [], []
    for k in range(16):
        noisy = {
            name: replace(item, markers=item.markers + random.normal(0, 2e-4, item.markers.shape))
            for name, item in dataset.trajectories.items()
        }
        run = tmp_path / str(k)
        settings = replace(SETTINGS, method="sysid-e", epochs=4, frames=6)
        model = identify_material([replace(dataset, trajectories=noisy)], settings, run, ignore)
        assert model.material is not None
        assert model.material["poissons_ratio"] == 0.499
        table = pd.read_csv(run / "parameters.csv")
        estimates.append(model.material["youngs_modulus"])
        sigmas.append((table["high_95"][0] - table["low_95"][0]) / 2 / 1.96)
    # The standard deviation of 16 values has itself a relative standard deviation of 18 %.
    assert np.std(estimates, ddof=1) == pytest.approx(np.mean(sigmas), rel=0.5)


def test_search_avoids_materials_that_cannot_be_simulated(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(SETTINGS, method="sysid-e", epochs=6, frames=4)
    original = MaterialSearch._simulate

    def simulate(self: MaterialSearch, x: np.ndarray) -> Evaluation:
        if np.exp(x[0]) > limit:
            raise SimulationError("too stiff")
        return original(self, x)

    monkeypatch.setattr(MaterialSearch, "_simulate", simulate)
    limit = 1.05 * dataset.simulator.material.youngs_modulus
    model = identify_material([dataset], settings, tmp_path, ignore)
    assert model.material is not None
    assert model.material["youngs_modulus"] <= limit


def test_identification_with_an_initial_loss_of_zero(dataset: Dataset, tmp_path: Path) -> None:
    """Recordings at rest without gravity: the assumed material is exact, and no division by zero occurs."""
    at_rest = {
        name: replace(
            item, markers=np.broadcast_to(dataset.markers.rest, item.markers.shape), q=dataset.simulator.mesh.vertices
        )
        for name, item in dataset.trajectories.items()
    }
    simulator = replace(dataset.simulator, gravity=(0.0, 0.0, 0.0))
    settings = replace(SETTINGS, method="sysid-e", epochs=1)
    exact = replace(dataset, trajectories=at_rest, simulator=simulator)
    model = identify_material([exact], settings, tmp_path, ignore)
    assert mean_error(validation_batches([exact]), model) < 1e-9


def test_no_interval_where_the_frame_was_found_through_the_model(dataset: Dataset, tmp_path: Path) -> None:
    """The recordings' frame follows the assumed material, which their loss does not show."""
    through = {"registration": "through the model, from the markers near the clamp"}
    items = {name: replace(item, attributes=through) for name, item in dataset.trajectories.items()}
    settings = replace(SETTINGS, method="sysid-e", epochs=12, frames=0)
    identify_material([replace(dataset, trajectories=items)], settings, tmp_path, ignore)
    table = pd.read_csv(tmp_path / "parameters.csv")
    assert table[["low_95", "high_95"]].isna().all(axis=None)
    (line,) = parameter_sentences(table, through_model=True)
    assert "--rest" in line


def test_correlated_parameters_are_reported() -> None:
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
    first, second, third = parameter_sentences(table)
    assert "1.9e+05 to 2.1e+05" in first
    assert "no interval" in second
    assert "-0.970" in third


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("youngs_modulus", 1e7, "E is at its upper bound, 10000 kPa: the recordings ask for more; check .*density"),
        ("youngs_modulus", 2e4, "E is at its lower bound, 20 kPa: the recordings ask for less; check .*density"),
        ("poissons_ratio", 0.3, "nu is at its lower bound, 0.3: "),
        ("poissons_ratio", 0.4995, ""),
        ("viscosity", 0.0, ""),
        ("tan_delta", 0.5, "tan_delta is at its upper bound, 0.5: "),
        ("branch_share_2", 1.0, "branch_share_2 is at its upper bound, 1: "),
        ("energy_weight_1", 1.0, ""),
    ],
)
def test_values_at_bounds_that_no_specimen_reaches_are_told(name: str, value: float, told: str) -> None:
    """Rubber is nearly incompressible, and may have no viscosity."""
    row = {"name": name, "unit": np.nan, "value": value, "low_95": np.nan, "high_95": np.nan}
    lines = parameter_sentences(pd.DataFrame([row | {f"correlation_{name}": np.nan}]))
    assert len(lines) == bool(told)
    assert re.match(told, "".join(lines))


def test_supervised_residual_network(dataset: Dataset, tmp_path: Path) -> None:
    """Targets reproduce the recordings, the network learns them, and a mesh of another size raises an error."""
    settings = replace(SETTINGS, method="srl", epochs=75, frames=0)
    recordings = Recordings.of(dataset, ["a", "b"])
    targets = residual_targets(recordings, 1e-8)
    assert np.sqrt(targets.objective.mean() / 20) < 2e-5
    model = fit_supervised([dataset], settings, tmp_path, ignore)
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
    with pytest.raises(InputError, match=r"srl: expected the training mesh .* found 12"):
        model.residual(other)


@pytest.mark.parametrize("method", ["rafl", "srl"])
def test_weights_with_other_names_are_refused(method: str, dataset: Dataset, tmp_path: Path) -> None:
    model = FittedModel("rafl", ResidualField()) if method == "rafl" else FittedModel("srl", network=GlobalResidual(8))
    save_model(tmp_path, model)
    content = load_tensors(tmp_path / "model.pt", "a model")
    part = content["field" if method == "rafl" else "network"]
    part["unknown"] = part.pop("scale" if method == "rafl" else "motion_mean")
    save_tensors(tmp_path / "model.pt", content)
    with pytest.raises(InputError, match=r"weights of this version in .*model\.pt.*fit again"):
        load_model(tmp_path)


@pytest.mark.parametrize("part", ["field", "optimiser", "shuffle", "history"])
def test_checkpoint_with_other_contents_is_refused(part: str, dataset: Dataset, tmp_path: Path) -> None:
    settings = Settings("rafl", ("a.h5",), 1, 1e-3, 0.0, 5, 0, 0)
    fit_residual_field([dataset], settings, tmp_path, ignore)
    content = load_tensors(tmp_path / "checkpoint.pt", "a checkpoint")
    content[part] = [{"epoch": 1.0}, 3] if part == "history" else {"unknown": torch.zeros(3)}
    save_tensors(tmp_path / "checkpoint.pt", content)
    with pytest.raises(InputError, match=r"a checkpoint of this version in .*checkpoint\.pt, found .*fit again"):
        fit_residual_field([dataset], replace(settings, epochs=2), tmp_path, ignore)


def test_datasets_without_training_recordings_are_refused(dataset: Dataset) -> None:
    items = {name: replace(item, split="test") for name, item in dataset.trajectories.items()}
    with pytest.raises(InputError, match="split `train`"):
        training_items([replace(dataset, trajectories=items)])


def test_code_in_a_model_file_is_not_executed(tmp_path: Path) -> None:
    class Malicious:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (Path(tmp_path / "executed"),))

    torch.save(Malicious(), tmp_path / "model.pt")
    with pytest.raises(InputError, match="cannot be read"):
        load_model(tmp_path)
    assert not (tmp_path / "executed").exists()
