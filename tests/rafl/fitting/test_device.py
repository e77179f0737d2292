"""Fits and evaluations in tensors, on each device, beside those of the compiled kernels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from devices import CARD, ON_DEVICES

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import write_dataset
from rafl.evaluation.metrics import compare, error_table, motion_table
from rafl.fitting.fit import fit
from rafl.fitting.methods import METHODS
from rafl.fitting.run_folder import FittedModel, Settings, load_model, read_settings
from rafl.residual.acceleration_field import ResidualField
from rafl.simulation.device import require_device

SETTINGS = Settings("sysid", ("small.h5",), 2, 2e-3, 1e-5, 10, 12, 5)


@pytest.fixture
def short(dataset: Dataset) -> Dataset:
    """The leading frames of one training and one validation recording."""
    return replace(dataset, trajectories={name: dataset.trajectories[name].first_frames(3) for name in ("a", "c")})


def in_tensors(dataset: Dataset, device: str) -> Dataset:
    return replace(dataset, simulator=replace(dataset.simulator, arithmetic="torch", device=device))


def physical(dataset: Dataset) -> Dataset:
    """The dataset with the elements and the time integration of the preset `physical`."""
    material = replace(dataset.simulator.material, law="corotated", mass="lumped", integration="enhanced")
    simulator = replace(dataset.simulator, material=material, integrator="generalised-alpha", substeps=2)
    return replace(dataset, simulator=simulator)


def assert_same_tables(ours: pd.DataFrame, theirs: pd.DataFrame, tolerance: float) -> None:
    """Check that numbers differ by less than a tolerance, in the unit of the table, and texts not at all."""
    assert list(ours.columns) == list(theirs.columns)
    for name in ours.columns:
        if pd.api.types.is_float_dtype(ours[name]):
            np.testing.assert_allclose(ours[name], theirs[name], rtol=0.0, atol=tolerance)
        else:
            assert ours[name].tolist() == theirs[name].tolist()


@ON_DEVICES
@pytest.mark.parametrize("preset", ["paper", "physical"])
def test_fitted_and_evaluated_tables_agree(preset: str, device: str, short: Dataset, tmp_path: Path) -> None:
    """To 1e-9 m in the errors of recordings, as in every simulated marker."""
    own = short if preset == "paper" else physical(short)
    models, histories = {}, []
    for label, each in (("kernels", own), ("tensors", in_tensors(own, device))):
        rows: list[dict[str, float]] = []
        models[label] = METHODS[SETTINGS.method]([each], SETTINGS, tmp_path / label, rows.append)
        histories.append(pd.DataFrame(rows))
    pd.testing.assert_frame_equal(*histories, rtol=1e-6)
    parameters = [pd.read_csv(tmp_path / label / "parameters.csv") for label in models]
    pd.testing.assert_frame_equal(*parameters, rtol=1e-5)
    compared = [
        compare(each, {"sysid": models[label]})
        for label, each in (("kernels", own), ("tensors", in_tensors(own, device)))
    ]
    assert_same_tables(*(error_table(each) for each in compared), 1e-6)  # [mm]
    for ours, theirs in zip(*compared, strict=True):
        for method, markers in ours.simulated.items():
            assert float(np.abs(markers - theirs.simulated[method]).max()) < 1e-9
    assert len(motion_table(compared[0])) == len(motion_table(compared[1]))


@ON_DEVICES
def test_fields_simulate_the_same_motion(device: str, short: Dataset) -> None:
    """With weights that change the motion by millimetres, and with the limit of its energy."""
    torch.manual_seed(3)
    field = ResidualField()
    with torch.no_grad():
        for weight in field.parameters():
            weight.mul_(1.5)
    for limit in (None, 0.01):
        model = FittedModel("rafl", field, energy_fraction=limit)
        compared = [compare(each, {"rafl": model}) for each in (short, in_tensors(short, device))]
        for ours, theirs in zip(*compared, strict=True):
            assert float(np.abs(ours.simulated["rafl"] - ours.simulated["original"]).max()) > 1e-5
            for method, markers in ours.simulated.items():
                assert float(np.abs(markers - theirs.simulated[method]).max()) < 1e-9


@ON_DEVICES
def test_fields_are_trained_alike(device: str, short: Dataset, tmp_path: Path) -> None:
    """With the pre-training; training takes the network in single precision, so the errors agree to 1e-7 m."""
    settings = replace(SETTINGS, method="rafl", epochs=2, warm_start=2)
    histories = []
    for label, each in (("kernels", short), ("tensors", in_tensors(short, device))):
        rows: list[dict[str, float]] = []
        METHODS["rafl"]([each], settings, tmp_path / label, rows.append)
        histories.append([row["validation_mm"] for row in rows if "validation_mm" in row])
    np.testing.assert_allclose(*histories, rtol=0.0, atol=1e-4)


def test_run_is_resumed_on_another_device(short: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings of a run do not name the device."""
    write_dataset(tmp_path / "small.h5", short)
    fit(tmp_path / "small.h5", tmp_path / "run", "sysid", epochs=1)
    before = (tmp_path / "run" / "config.yaml").read_text()
    (tmp_path / "run" / "model.pt").unlink()
    monkeypatch.setattr("rafl.simulation.simulator.require_device", lambda name: None)
    monkeypatch.setattr("rafl.fitting.fit.require_device", lambda name: None)
    used = []

    def on_device(own: Dataset, device: str) -> Dataset:
        used.append(device)
        return in_tensors(own, "cpu")

    monkeypatch.setattr(Dataset, "on_device", on_device)
    fit(tmp_path / "small.h5", tmp_path / "run", "sysid", epochs=1, resume=True, device="cuda")
    assert used == ["cuda"]
    assert load_model(tmp_path / "run").method == "sysid"
    assert (tmp_path / "run" / "config.yaml").read_text() == before
    assert "device" not in vars(read_settings(tmp_path / "run"))


@pytest.mark.parametrize("name", ["gpu", "cuda:", "mps", "cuda:x", ""])
def test_unknown_devices_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="expected cpu, cuda or"):
        require_device(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="torch finds a CUDA device")
def test_absent_card_is_refused_before_anything_is_written(dataset: Dataset, tmp_path: Path) -> None:
    write_dataset(tmp_path / "small.h5", dataset)
    with pytest.raises(InputError, match="expected a CUDA device, found none"):
        fit(tmp_path / "small.h5", tmp_path / "run", "sysid", device="cuda")
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="expected a CUDA device, found none"):
        dataset.on_device("cuda:1")


@CARD
def test_card_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match="found"):
        require_device("cuda:99")
    require_device("cuda")
