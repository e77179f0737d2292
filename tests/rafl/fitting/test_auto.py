"""The default fit: the choice among models, errors on what was left out, and what the model has seen."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rafl.capture.specimen.specimen import Specimen
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings
from rafl.data.strain_range import StrainRange
from rafl.data.synthetic import loaded_equilibria, release_dataset
from rafl.fem.material import Material
from rafl.fitting.auto import SELECTION_FILE, Candidate, choose, fit_auto, selection_sentences
from rafl.fitting.material_search import MaterialSearch
from rafl.fitting.quantities import METHOD_QUANTITIES
from rafl.fitting.run_folder import FittedModel, History, Settings, load_model
from rafl.fitting.train_field import mean_error

SETTINGS = Settings("auto", ("small.h5",), 12, 1e-3, 0.0, 10, 0, 5)
SPLITS = {"a": "train", "b": "train", "c": "train", "d": "val", "e": "test"}
LOADS = np.array([0.03, 0.05, 0.1, 0.08, 0.065])


def ignore(row: dict[str, float]) -> None:
    pass


def candidates(*errors: list[float]) -> list[Candidate]:
    return [Candidate(str(k), FittedModel(str(k)), np.array(each)) for k, each in enumerate(errors)]


@pytest.mark.parametrize(
    ("errors", "kept"),
    [
        (([3.0, 4.0, 5.0], [0.1, 0.2, 0.3], [0.09, 0.22, 0.3]), "1"),  # the last gains nothing
        (([3.0, 4.0, 5.0], [0.1, 0.2, 0.3], [0.05, 0.1, 0.2]), "2"),  # it gains in every recording
        (([3.0, 4.0, 5.0], [3.1, 3.9, 5.0], [2.9, 4.1, 5.1]), "0"),
        (([3.0], [1.0], [0.95]), "1"),  # of one recording a gain of 5 % does not count
        (([3.0, 4.0], [3.0, 4.1], [0.1, 0.2]), "2"),  # better only by what the middle one lacks
        (([3.0, 4.0], [np.inf, np.inf], [0.1, 0.2]), "2"),  # a model that cannot be simulated
        (([3.0, 4.0], [np.inf, np.inf], [np.inf, np.inf]), "0"),
    ],
)
def test_the_simplest_model_that_no_other_beats_is_kept(errors: tuple[list[float], ...], kept: str) -> None:
    assert choose(candidates(*errors), len(errors[0])).name == kept


def test_without_evidence_the_material_of_fewest_parameters_is_kept() -> None:
    assert choose(candidates([], [], []), 0).name == "1"
    assert choose(candidates([], [np.inf], []), 0).name == "2"


@pytest.fixture(scope="module")
def rubber(small_specimen: Specimen) -> Dataset:
    """Recordings of a neo-Hookean rubber with branches, described as linearly elastic with a wrong E."""
    assumed = Material(150e3, 0.45, mass="lumped", law="corotated", integration="enhanced")
    branches = {"branch_shares": (0.06, 0.06, 0.06), "branch_times": (0.01, 0.1, 1.0)}
    target = replace(assumed, youngs_modulus=190e3, poissons_ratio=0.48, law="neo-hookean", **branches)
    base, lab = (
        replace(small_specimen.simulator(0.01, each), integrator="generalised-alpha") for each in (assumed, target)
    )
    starts = loaded_equilibria(lab, small_specimen.mesh.face_nodes("x-max"), LOADS)
    return release_dataset("small", base, lab, starts, 20, SPLITS)


def test_default_fit_predicts_left_out_recordings(rubber: Dataset, tmp_path: Path) -> None:
    """At most a hundredth of the error of the assumed material remains; the run says what was kept, and resumes."""
    model = fit_auto([rubber], SETTINGS, tmp_path, ignore)
    held_out = [Recordings.of(rubber, rubber.split("test"))]
    error, assumed = (mean_error(held_out, each) for each in (model, FittedModel("original")))
    assert error < 0.01 * assumed
    table = pd.read_csv(tmp_path / SELECTION_FILE)
    assert table["model"].tolist() == ["original", "sysid-branches", "constitutive"]
    assert table["left_out"].tolist() == [4] * 3  # three training recordings and one of validation
    kept = table[table["kept"]].iloc[0]
    assert error / 3 < 1e-3 * kept["left_out_mm"] < 3 * error
    first, second = selection_sentences(table, model)
    assert kept["model"] in first
    assert "it is a guess" in second
    assert model.seen is not None
    assert 0.01 < model.seen[0] < 0.5
    assert load_model(tmp_path) == model
    rows: list[dict[str, float]] = []
    again = fit_auto([rubber], SETTINGS, tmp_path, rows.append)
    assert again == model


@pytest.mark.slow
def test_left_out_errors_are_those_of_fits_without_the_recordings(rubber: Dataset, tmp_path: Path) -> None:
    quantities = METHOD_QUANTITIES["sysid-loss"]
    names = rubber.split("train")

    def search(chosen: list[str], folder: str) -> MaterialSearch:
        own = {name: item for name, item in rubber.trajectories.items() if name in chosen}
        run = tmp_path / folder
        run.mkdir()
        part = replace(rubber, trajectories=own)
        return MaterialSearch([part], SETTINGS, quantities, History(run, ignore), run / "checkpoint.pt")

    whole = search(names, "whole")
    estimated = whole.left_out_errors(whole.solve(), [[0], [1], [2]])
    refitted = []
    for k, name in enumerate(names):
        without = search([other for other in names if other != name], str(k))
        model = without.model(without.solve().x)
        refitted.append(mean_error([Recordings.of(rubber, [name])], model))
    assert estimated == pytest.approx(refitted, rel=0.25)


def test_strain_range_of_a_stretched_bar(small_specimen: Specimen) -> None:
    """A bar that is stretched by 10 % in 0.1 s: Green strain 0.105, rate about 1.05 1/s."""
    import torch

    mesh = small_specimen.mesh
    stretch = torch.linspace(1.0, 1.1, 11, dtype=torch.float64)
    rest = torch.from_numpy(mesh.vertices)
    positions = (rest * torch.stack([stretch, stretch**0, stretch**0], -1)[:, None])[:, None]
    found = StrainRange.of(mesh, positions, 0.01)
    assert found.strain == pytest.approx(0.105, rel=1e-6)
    assert found.rate == pytest.approx(1.1, rel=0.02)
    assert found.exceeds(StrainRange(0.05, 2.0))
    assert not found.exceeds(StrainRange(0.1, 1.1))
