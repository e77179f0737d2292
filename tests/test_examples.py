"""The examples of the documentation, run as they stand."""

import runpy
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support import ROOT, Run
from synthetic_tracks import tracks_of_positions

import rafl
from rafl import api
from rafl.capture.rendering.motion import tip_load_release
from rafl.fem.laws import LAWS

EXAMPLES = ROOT / "docs" / "examples"
FRAMES = 24
LOADS_G = {"load060g": "train", "load070g": "val", "load080g": "test"}


def tracks_of(specimen: rafl.Specimen, load: float) -> rafl.Tracks:
    """Exact tracks of a release that begins after two frames at rest."""
    material = replace(specimen.material, youngs_modulus=0.6 * specimen.material.youngs_modulus)
    motion = tip_load_release(specimen, material, load, FRAMES, 100.0)
    q = np.concatenate([np.repeat(motion.q[:1], 2, axis=0), motion.q])
    markers = specimen.markers(1e-6)
    position = markers.positions(torch.from_numpy(q)).numpy()
    return tracks_of_positions(markers.names, position, 1e-5)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, small_specimen: rafl.Specimen) -> Path:
    """A folder with a specimen, another one, tracks and a table of recordings."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "specimen.yaml").write_text(small_specimen.text)
    (folder / "longer.yaml").write_text(small_specimen.text.replace("[60, 20, 20]", "[80, 20, 20]"))
    rows = ["recording,load_g,split"]
    for name, split in LOADS_G.items():
        load = int(name[4:7])
        rafl.write_tracks(folder / "tracks" / f"{name}.h5", tracks_of(small_specimen, 1e-3 * load))
        rows.append(f"{name},{load},{split}")
    (folder / "recordings.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="module")
def fitted(lab: Path) -> Path:
    """The folder after the first example."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(lab)
        names = runpy.run_path(str(EXAMPLES / "fit_and_predict.py"))
    errors = names["errors"].groupby("method")["mean_mm"].mean()
    assert errors["rafl"] < 0.8 * errors["original"]
    assert names["motion"].markers.shape == (FRAMES, 20, 3)
    # A longer beam under the load droops; let go, its tip rises above the first frame.
    tip = names["prediction"].markers[:, -1, 2]
    assert tip.max() > tip[0] + 1e-3
    return lab


def test_fit_and_predict(fitted: Path) -> None:
    table = (fitted / "prediction.csv").read_text().splitlines()
    assert table[0] == "frame,time_s,marker,x_mm,y_mm,z_mm"
    assert len(table) == 1 + 20 * 20


@pytest.mark.parametrize("example", ["gradient", "own_law", "own_residual"])
def test_examples_with_the_simulator(
    fitted: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], example: str
) -> None:
    monkeypatch.chdir(fitted)
    names = runpy.run_path(str(EXAMPLES / f"{example}.py"))
    if example == "gradient":
        assert names["modulus"].grad > 0  # a stiffer beam hangs less
    elif example == "own_law":
        tip = names["tip"]
        assert tip["gent"] == pytest.approx(tip["corotated"], abs=0.5)  # [mm]; equal at small strains
        assert abs(tip["gent"] - tip["corotated"]).max() > 1e-3
        del LAWS["gent"]
    else:
        lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("rate")]
        losses = [float(line.split("loss")[1].split()[0]) for line in lines]
        assert losses[-1] < losses[0]


def test_predicted_start_is_at_rest(small_specimen: rafl.Specimen, fitted: Path) -> None:
    """Under its load the predicted shape is in equilibrium: with the load left on, it stays where it is."""
    model = rafl.load_model(fitted / "runs" / "beam")
    prediction = rafl.predict(small_specimen, model, load_g=50, frames=2)
    simulator = model.simulator(small_specimen.simulator(0.01))
    force = torch.zeros(1, len(simulator.mesh.vertices), 3, dtype=torch.float64)
    force[0, torch.from_numpy(small_specimen.loaded)] = torch.tensor(
        0.05 * np.asarray(simulator.gravity) / len(small_specimen.loaded)
    )
    start = rafl.Start(torch.from_numpy(prediction.vertices[:1]), 0 * force, force, 0 * force[..., 0], ("hanging",))
    with torch.no_grad():
        q, _ = rafl.rollout(simulator, start, 10, model.residual(simulator), model.parameters(simulator))
    assert float((q - q[0]).norm(dim=-1).max()) < 1e-5


def test_predict_refuses_impossible_arguments(small_specimen: rafl.Specimen) -> None:
    with pytest.raises(rafl.InputError, match="at least 0 g"):
        rafl.predict(small_specimen, load_g=-1)


def test_track(tmp_path: Path, specimen_file: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrates with and tracks what `rafl-render` writes."""
    done = run("rafl-render", specimen_file, "--out", "lab", "--loads-g", "80", "--frames", "12")
    assert done.returncode == 0, done.stderr
    shutil.copy(specimen_file, tmp_path / "lab" / "specimen.yaml")
    monkeypatch.chdir(tmp_path / "lab")
    names = runpy.run_path(str(EXAMPLES / "track.py"))
    assert set(names["tracks"]) == {"load080g"}
    assert (names["table"]["state"] == "measured").mean() > 0.99


def test_every_public_name_is_there_and_documented() -> None:
    assert set(rafl.__all__) - {"__version__"} == set(api.__all__)
    for name in rafl.__all__:
        assert name in ("__version__", "ResidualForce", "ResidualModel") or getattr(rafl, name).__doc__, name
