"""The commands. A wrong input gives a one-line error and exit code 2, and no file is written."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from stills import SIDES, still
from support import Run, assert_refused, folder_content

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.rendering.motion import tip_load_release
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.marker_table import marker_table
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import write_dataset
from rafl.data.synthetic import release_dataset
from rafl.fem.mesh import HexMesh
from rafl.fitting.run_folder import FittedModel, save_model
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.global_residual import GlobalResidual

COMMANDS = ("rafl-render", "rafl-calibrate", "rafl-track", "rafl-specimen", "rafl-capture", "rafl-fit", "rafl-eval")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(command: str, run: Run) -> None:
    result = run(command, "--help")
    assert result.returncode == 0
    assert f"Example: {command} " in " ".join(result.stdout.split())


def write_still(path: Path, size_factor: float = 1.0, places_mm: np.ndarray = SIDES) -> None:
    """A CSV file of `rafl-track` that shows a box at rest, with dots on its sides."""
    recording = still(places_mm)
    assert recording.names is not None
    table = marker_table(recording.time, recording.names, size_factor * recording.position)
    for axis, sigma in zip("xyz", np.moveaxis(1e3 * recording.sigma, -1, 0), strict=True):
        table[f"sigma_{axis}_mm"] = sigma.ravel()
    table.to_csv(path, index=False)


def test_a_still_gives_a_specimen_that_reads_back(run: Run, tmp_path: Path) -> None:
    write_still(tmp_path / "still.csv")
    result = run("rafl-specimen", "still.csv", "--box", "100x20x20", "--out", "beam.yaml")
    assert result.returncode == 0, result.stderr
    assert "32 dots" in result.stdout
    assert "next: rafl-track videos/ --calib calib.yaml --specimen beam.yaml" in result.stdout
    specimen = read_specimen(tmp_path / "beam.yaml")
    assert specimen.name == "beam"
    assert specimen.layout.names[:2] == ("L1", "L2")
    np.testing.assert_allclose(specimen.layout.positions, 1e-3 * SIDES, atol=0.3e-3)
    assert 0.04e-3 < specimen.layout.sigma.min() < specimen.layout.sigma.max() < 1.5e-3
    assert (tmp_path / "beam.png").stat().st_size > 10_000
    again = run("rafl-specimen", "still.csv", "--box", "100x20x20", "--out", "beam.yaml")
    assert_refused(again, "beam.yaml", "choose another --out")


def test_specimen_refuses_wrong_input(run: Run, tmp_path: Path) -> None:
    write_still(tmp_path / "still.csv")
    write_still(tmp_path / "large.csv", 2.0, SIDES[::4])
    (tmp_path / "bad.h5").write_text("not tracks")
    before = folder_content(tmp_path)
    for parts, arguments in (
        (("--box", "--surface", "--like"), ["still.csv"]),
        (("--box", "'100x20'"), ["still.csv", "--box", "100x20"]),
        (("--box", "above 0"), ["still.csv", "--box", "100x20x0"]),
        (("--stencil",), ["--box", "100x20x20"]),
        (("bad.h5",), ["bad.h5", "--box", "100x20x20"]),
        (("large.csv", "correct the size"), ["large.csv", "--box", "100x20x20"]),
        (("--element-mm", "thin"), ["still.csv", "--box", "100x0.5x20"]),
        ((".yaml", "out.csv"), ["still.csv", "--box", "100x20x20", "--out", "out.csv"]),
        (("--dot-mm",), ["--stencil", "--box", "10x5x5"]),
    ):
        assert_refused(run("rafl-specimen", *arguments), *parts)
        assert folder_content(tmp_path) == before


def test_a_stencil_comes_with_its_specimen(run: Run, tmp_path: Path) -> None:
    result = run("rafl-specimen", "--stencil", "--box", "100x30x30", "--out", "dots.pdf")
    assert result.returncode == 0, result.stderr
    specimen = read_specimen(tmp_path / "dots.yaml")
    assert len(specimen.layout.names) == 50
    assert (tmp_path / "dots.pdf").read_bytes().startswith(b"%PDF")


@pytest.fixture(scope="module")
def built(small_specimen: Specimen, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("arrays")
    return build_dataset(small_specimen, write_author_arrays(small_specimen, folder), ROWS, SETTINGS, "", lambda: None)


SETTINGS = CaptureSettings(2e-3, 3e-3, 100.0)
ROWS = [
    RecordingRow(recording="q0", load_g=50, split="train"),
    RecordingRow(recording="q1", load_g=70, split="test"),
]


def write_author_arrays(specimen: Specimen, folder: Path) -> Path:
    """Write simulated markers as `q0.npy` and `q1.npy`, arrays in the format of the paper's authors."""
    import torch

    markers = specimen.markers(1e-6)
    for row in ROWS:
        motion = tip_load_release(specimen, specimen.material, 1e-3 * row.load_g, 5, 100.0)
        moving = markers.positions(torch.from_numpy(motion.q)).numpy()
        np.save(folder / f"{row.recording}.npy", 1e3 * np.concatenate([specimen.layout.positions[None], moving]))
    return folder


@pytest.fixture
def capture_command(small_specimen: Specimen, specimen_file: Path, tmp_path: Path) -> tuple[str | Path, ...]:
    """The command that builds a.h5 from arrays and a table of one recording, both in the temporary folder."""
    write_author_arrays(small_specimen, tmp_path)
    table = tmp_path / "recordings.csv"
    table.write_text("recording,load_g,split\nq0,50,train\n")
    return ("rafl-capture", specimen_file, tmp_path, "--recordings", table, "--out", "a.h5")


def test_capture_refuses_wrong_input(
    capture_command: tuple[str | Path, ...], specimen_file: Path, run: Run, tmp_path: Path
) -> None:
    table = tmp_path / "recordings.csv"
    table.write_text("recording,load_g,split\nq0,50,train\nq1,70,test\n")

    def refused(*parts: str) -> None:
        assert_refused(run(*capture_command), *parts)
        assert not list(tmp_path.glob("*a*.h5"))

    text = specimen_file.read_text()
    specimen_file.write_text(text.replace("at_mm: [28, 0, 13]", "at_mm: [28, -4, 13]"))
    refused("La2", "4.00 mm off", "at most 2 mm")
    specimen_file.write_text(text)
    table.write_text("recording,load_g,split\nq0,50,train\nq2,70,test\n")
    refused("q2", "q2.h5, .csv, .c3d, .trc, .tsv or .npy")
    table.write_text("recording,load_g,split\n")
    refused("recordings.csv", "at least one recording")
    table.unlink()
    refused("recordings.csv", "found nothing")


def test_failed_capture_keeps_the_old_dataset(
    capture_command: tuple[str | Path, ...], run: Run, tmp_path: Path
) -> None:
    assert run(*capture_command).returncode == 0
    assert "data:image/png" in (tmp_path / "a.html").read_text()
    before = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "q0.npy").write_bytes(b"broken")
    assert_refused(run(*capture_command), "q0.npy", "cannot be read")
    assert (tmp_path / "a.h5").read_bytes() == before


def test_update_inspect_and_verify_a_dataset(
    capture_command: tuple[str | Path, ...], specimen_file: Path, run: Run, tmp_path: Path
) -> None:
    assert run(*capture_command).returncode == 0
    (tmp_path / "recordings.csv").write_text("recording,load_g,split\nq1,70,test\n")
    assert run(*capture_command, "--update").returncode == 0
    result = run("rafl-capture", "--inspect", "a.h5")
    assert result.returncode == 0, result.stderr
    for part in ("small: 63 vertices, 24 elements", "train 1, val 0, test 1", "q0.npy", "E = 150000 Pa", "SI: m, s"):
        assert part in " ".join(result.stdout.split()), result.stdout
    assert "as they were written" in run("rafl-capture", "--verify", "a.h5").stdout
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["trajectories/q1"].attrs["load_g"] = 71.0
    assert_refused(run("rafl-capture", "--verify", "a.h5"), "trajectories/q1 changed")
    assert_refused(run("rafl-capture", "--verify", specimen_file), "cannot be read")
    assert_refused(run("rafl-capture", "--inspect", "nowhere.h5"), "nowhere.h5")
    assert_refused(run("rafl-capture", specimen_file), "for instance rafl-capture")
    assert_refused(run(*capture_command, "--update", "--rest", "q0:x"), "straight:12-40")
    assert_refused(run(*capture_command[:-1], "new.h5", "--update"), "new.h5", "nothing there")


def test_fit_and_eval_refuse_wrong_input(built: Dataset, run: Run, tmp_path: Path) -> None:
    write_dataset(tmp_path / "a.h5", built)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file.attrs["format"] = "rafl-dataset/7"
    assert_refused(run("rafl-fit", "a.h5", "--out", "run"), "rafl-dataset/7", "newer")
    write_dataset(tmp_path / "a.h5", built)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["trajectories"]
    assert_refused(run("rafl-fit", "a.h5", "--out", "run"), "at least one trajectory")
    tests_only = {name: replace(item, split="test") for name, item in built.trajectories.items()}
    write_dataset(tmp_path / "a.h5", replace(built, trajectories=tests_only))
    assert_refused(run("rafl-fit", "a.h5", "--out", "run"), "split `train`")
    assert_refused(run("rafl-fit", "nowhere.h5"), "nowhere.h5", "check the path")
    assert not (tmp_path / "run").exists()
    (tmp_path / "a.h5").write_bytes(b"not a dataset")
    assert_refused(run("rafl-fit", "a.h5"), "a.h5", "cannot be read")

    write_dataset(tmp_path / "a.h5", built)
    assert_refused(run("rafl-fit", "a.h5", "--out", "run", "--device", "gpu"), "--device", "cpu, cuda", "'gpu'")
    assert not (tmp_path / "run").exists()
    assert_refused(run("rafl-eval", "a.h5"), "at least one run folder and one dataset", "no run folder")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "config.yaml").write_bytes(b"\xff\xfe")
    assert_refused(run("rafl-fit", "a.h5", "--out", "odd", "--epochs", "1", "--resume"), "config.yaml", "as YAML")
    assert_refused(run("rafl-eval", "nowhere", "a.h5"), "nowhere/model.pt")
    assert_refused(run("rafl-fit", "a.h5", "a.h5", "--out", "run"), "each dataset once", "a.h5 in a.h5 again")
    assert not (tmp_path / "run").exists()
    assert_refused(run("rafl-fit", "a.h5", "--out", "a.h5/run"), "a.h5", "check the path")
    done = run("rafl-fit", "a.h5", "--out", "run", "--method", "rafl", "--epochs", "1", "--frames", "3")
    assert done.returncode == 0, done.stderr
    assert_refused(
        run("rafl-fit", "a.h5", "--out", "run", "--method", "rafl", "--epochs", "1"), "already holds a run", "--resume"
    )
    assert_refused(run("rafl-fit", "a.h5", "--out", "run", "--epochs", "2", "--resume"), "the settings")
    again = ("rafl-fit", "a.h5", "--out", "run", "--method", "rafl", "--epochs", "1", "--frames", "3", "--resume")
    assert run(*again).returncode == 0
    assert_refused(run("rafl-eval", "run", "a.h5", "a.h5"), "each dataset once", "a.h5 in a.h5 again")
    write_dataset(tmp_path / "a.h5", replace(built, recipe="another"))
    assert_refused(run(*again), "run", "a.h5 has changed", "choose another --out")
    assert_refused(run("rafl-eval", "run", "a.h5", "--out", "out", "--device", "cuda:99"), "a CUDA device, found")
    assert not (tmp_path / "out").exists()
    (tmp_path / "run" / "model.pt").write_bytes(b"x")
    assert_refused(run("rafl-eval", "run", "a.h5"), "model.pt", "cannot be read")


def test_tensorboard_option(built: Dataset, run: Run, tmp_path: Path) -> None:
    """The option writes events, or asks for the package if it is not installed."""
    write_dataset(tmp_path / "a.h5", built)
    result = run(
        "rafl-fit", "a.h5", "--out", "run", "--method", "rafl", "--epochs", "1", "--frames", "3", "--tensorboard"
    )
    if importlib.util.find_spec("tensorboard") is None:
        assert_refused(result, "package tensorboard", "history.csv")
        assert not (tmp_path / "run").exists()
    else:
        assert result.returncode == 0, result.stderr
        assert list((tmp_path / "run").glob("events.out.tfevents.*"))


def test_eval_of_models_not_applicable_to_a_mesh(built: Dataset, run: Run, tmp_path: Path) -> None:
    """Eval refuses a model applicable to no dataset, and leaves a model out on datasets with another mesh."""
    write_dataset(tmp_path / "small.h5", built)
    save_model(tmp_path / "srl", FittedModel("srl", network=GlobalResidual(7)))
    save_model(tmp_path / "sysid", FittedModel("sysid", material={"youngs_modulus": 190e3, "poissons_ratio": 0.45}))
    assert_refused(run("rafl-eval", "srl", "small.h5"), "srl: expected the training mesh")
    assert_refused(run("rafl-eval", "srl", "sysid", "small.h5"), "srl: expected the training mesh")
    result = run("rafl-eval", "sysid", "small.h5")
    assert result.returncode == 0, result.stderr
    assert "sysid: worse than the baseline simulator on 1 of 1 datasets" in result.stdout
    other = replace(built.simulator, mesh=HexMesh.box((2, 1, 1), (0.02, 0.01, 0.01)), fixed=np.arange(4))
    write_dataset(
        tmp_path / "other.h5", release_dataset("other", other, other, other.mesh.vertices[None], 3, {"a": "test"})
    )
    save_model(tmp_path / "srl", FittedModel("srl", network=GlobalResidual(12)))
    result = run("rafl-eval", "srl", "sysid", "small.h5", "other.h5", "--out", "both")
    assert result.returncode == 0, result.stderr
    assert re.search(r"srl: worse than the baseline simulator on \d of 1 datasets", result.stdout)
    assert re.search(r"held-out marker error: original [\d.]+ mm, sysid [\d.]+ mm", result.stdout)
    assert not (tmp_path / "run" / "errors.csv").exists()


def test_eval_of_models_whose_simulation_fails(built: Dataset, run: Run, tmp_path: Path) -> None:
    """A model is left out where its simulation fails; if it fails everywhere, eval fails."""
    write_dataset(tmp_path / "small.h5", built)
    weightless = replace(built.simulator, gravity=(0.0, 0.0, 0.0))
    write_dataset(
        tmp_path / "weightless.h5",
        release_dataset("weightless", weightless, weightless, weightless.mesh.vertices[None], 3, {"a": "test"}),
    )
    field = ResidualField()
    field.load_state_dict({key: 30.0 * value for key, value in field.state_dict().items()})
    save_model(tmp_path / "unstable", FittedModel("rafl", field=field))
    save_model(tmp_path / "good", FittedModel("sysid-e", material={"youngs_modulus": 190e3, "poissons_ratio": 0.45}))
    save_model(
        tmp_path / "odd", FittedModel("rafl", field=field, time_integration={"integrator": "magic", "substeps": 1})
    )
    assert_refused(run("rafl-eval", "odd", "small.h5"), "model.pt", "integrator", "magic")
    result = run("rafl-eval", "unstable", "small.h5")
    assert result.returncode == 1
    assert "error: rafl on small: step 1" in result.stderr
    assert not (tmp_path / "unstable" / "errors.csv").exists()
    result = run("rafl-eval", "good", "unstable", "small.h5", "weightless.h5")
    assert result.returncode == 0, result.stderr
    assert "left out on small: rafl" in result.stderr
    assert re.search(
        r"rafl: worse than the baseline simulator on \d of 1 datasets; its simulation fails on 1 more", result.stdout
    )
    assert (tmp_path / "good" / "report.html").exists()


def test_render_refuses_wrong_input(specimen_file: Path, run: Run, tmp_path: Path) -> None:
    assert_refused(run("rafl-render", "nowhere.yaml", "--out", "film"), "nowhere.yaml")
    assert_refused(run("rafl-render", specimen_file, "--out", "film", "--loads-g", "5O"), "--loads-g", "'5O'")
    assert_refused(run("rafl-render", specimen_file, "--out", "film", "--loads-g", ""), "at least one recording")
    text = specimen_file.read_text()
    specimen_file.write_text(text.replace("at_mm: [28, 0, 13]", "at_mm: [28, -2.5, 13]"))
    assert_refused(run("rafl-render", specimen_file, "--out", "film"), "La2", "2.50 mm off", "smaller elements")
    specimen_file.write_text(text)
    assert not (tmp_path / "film").exists()
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "thesis.txt").write_text("mine")
    assert_refused(run("rafl-render", specimen_file, "--out", "film"), "found files in it")


def test_fit_refuses_unsuitable_datasets_before_it_writes(built: Dataset, run: Run, tmp_path: Path) -> None:
    mesh = HexMesh.box((3, 2, 2), (0.03, 0.02, 0.02))
    other = replace(built.simulator, mesh=mesh, fixed=mesh.face_nodes("x-min"))
    write_dataset(tmp_path / "a.h5", built)
    write_dataset(tmp_path / "b.h5", release_dataset("b", other, other, mesh.vertices[None], 3, {"a": "train"}))
    assert_refused(run("rafl-fit", "a.h5", "b.h5", "--method", "srl", "--out", "run"), "srl", "one mesh", "36")
    assert_refused(run("rafl-fit", "a.h5", "--integrator", "euler", "--out", "run"), "implicit-euler", "'euler'")
    write_dataset(tmp_path / "c.h5", replace(built, name="c", simulator=replace(built.simulator, substeps=2)))
    assert_refused(
        run("rafl-fit", "a.h5", "c.h5", "--out", "run"), "same time integration", "c: implicit-euler, 2 substeps"
    )
    assert_refused(run("rafl-fit", "a.h5", "--method", "magic", "--out", "run"), "--method", "sysid-e", "magic")
    assert_refused(
        run("rafl-fit", "a.h5", "--method", "rafl", "--from", "nowhere", "--out", "run"), "nowhere", "check the path"
    )
    assert not (tmp_path / "run").exists()
