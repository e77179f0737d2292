"""Plans: what they make of datasets, methods, seeds and options, and what is refused, by its key."""

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from support import ROOT

from rafl import cli
from rafl.batch.cluster import read_cluster
from rafl.batch.plain_command import plain_command
from rafl.common.errors import InputError
from rafl.sweep.cells import Sweep, sweep_units
from rafl.sweep.files import find_datasets
from rafl.sweep.plan import fit_options, read_plan, variants

Units = Callable[..., Sweep]

PLAN = "format: rafl-sweep/1\ndatasets: [thick.h5, thin.h5, long.h5]\n"


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Units:
    """Makes the units of a plan, from what follows its datasets."""
    monkeypatch.chdir(tmp_path)
    for name in ("thick", "thin", "long"):
        (tmp_path / f"{name}.h5").touch()

    def units(text: str, head: str = PLAN) -> Sweep:
        path = Path("plan.yaml")
        path.write_text(head + text)
        plan = read_plan(path)
        return sweep_units(plan, path, Path("out"))

    return units


def test_every_dataset_method_and_seed(sweep: Units) -> None:
    made = sweep(
        "methods: [sysid, {method: rafl, name: field, options: {warm-start: [0, 20]}}]\nseeds: [3, 4]\n"
        "options: {epochs: 5}\n"
    )
    assert len(made.fits) == 3 * (1 + 2 * 2)
    assert len(made.cells) == len(made.fits)
    lines = {unit.name: unit.line for unit in made.units}
    assert lines["thick_sysid"] == "rafl-fit thick.h5 --method sysid --out out/runs/thick_sysid --epochs 5 --resume"
    assert lines["thin_field-warm-start=0_4"] == (
        "rafl-fit thin.h5 --method rafl --out out/runs/thin_field-warm-start=0_4 --epochs 5 --seed 4 --warm-start 0 "
        "--resume"
    )
    assert lines["thin_sysid_on_thin"] == (
        "rafl-eval out/runs/thin_sysid thin.h5 --out out/cells/thin_sysid/thin --no-report"
    )
    assert {cell.seed for cell in made.cells} == {None, 3, 4}


def test_a_transfer_matrix(sweep: Units) -> None:
    made = sweep("methods: [sysid]\nevaluate: all\n")
    assert (len(made.fits), len(made.cells)) == (3, 9)
    assert {(cell.trained_on, cell.dataset) for cell in made.cells} == {
        (one, other) for one in ("thick", "thin", "long") for other in ("thick", "thin", "long")
    }
    made = sweep("methods: [sysid]\nevaluate: left-out\n")
    assert all(cell.trained_on != cell.dataset for cell in made.cells)
    assert len(made.cells) == 6


def test_folds_leave_every_dataset_out_once(sweep: Units) -> None:
    made = sweep("methods: [sysid]\ntrain: folds\nevaluate: left-out\n")
    assert [unit.name for unit in made.fits] == ["without-thick_sysid", "without-thin_sysid", "without-long_sysid"]
    assert made.fits[0].inputs == ("thin.h5", "long.h5")
    assert [cell.dataset for cell in made.cells] == ["thick", "thin", "long"]
    made = sweep("methods: [sysid]\ntrain: folds\nfolds: 2\nevaluate: left-out\n")
    assert Counter(cell.dataset for cell in made.cells) == {"thick": 1, "thin": 1, "long": 1}
    assert [unit.inputs for unit in made.fits] == [("thin.h5",), ("thick.h5", "long.h5")]
    (fit,) = sweep("methods: [auto]\ntrain: all\n").fits
    assert (fit.name, fit.inputs) == ("all_auto", ("thick.h5", "thin.h5", "long.h5"))


def test_a_fit_that_starts_from_another(sweep: Units) -> None:
    """`from` names a method of the plan, whose run of the same datasets it waits for, or a folder beside the plan."""
    made = sweep("methods: [sysid, {method: rafl, options: {from: sysid}}]\n")
    fit = next(unit for unit in made.fits if unit.name == "thick_rafl_0")
    assert "--from out/runs/thick_sysid " in fit.line
    assert "out/runs/thick_sysid/model.pt" in fit.inputs
    made = sweep("methods: [{method: rafl, options: {from: runs/old}}]\n")
    assert made.fits[0].inputs == ("thick.h5", "runs/old/model.pt")


def test_datasets_by_pattern_and_beside_the_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "a folder [1]"
    folder.mkdir()
    for name in ("b.h5", "a.h5", "-c.h5"):
        (folder / name).touch()
    (folder / "plan.yaml").write_text("format: rafl-sweep/1\ndatasets: [b.h5, '*.h5']\nmethods: [sysid]\n")
    monkeypatch.chdir(tmp_path)
    path = Path("a folder [1]/plan.yaml")
    plan = read_plan(path)
    assert list(find_datasets(plan, path)) == ["b", "-c", "a"]
    monkeypatch.chdir(folder)
    path = Path("plan.yaml")
    made = sweep_units(plan, path, Path("out"))
    assert made.fits[1].command[:2] == ("rafl-fit", "./-c.h5")


def test_datasets_of_specimens(sweep: Units, tmp_path: Path) -> None:
    """Their folders are found by a pattern; fits wait for the datasets, and are captured again when tracks change."""
    for name in ("s 1", "s 2"):
        tracks = tmp_path / "lab" / name / "tracks"
        tracks.mkdir(parents=True)
        for path in (tracks / "load.h5", tracks.parent / "specimen.yaml", tracks.parent / "recordings.csv"):
            path.touch()
    made = sweep("specimens: ['lab/s *']\nmethods: [sysid]\ncapture: {tolerance-mm: 3, initial: rest}\n")
    assert [unit.name for unit in made.captures] == ["s 1", "s 2"]
    assert made.captures[0].line == (
        "rafl-capture 'lab/s 1/specimen.yaml' 'lab/s 1/tracks' --recordings 'lab/s 1/recordings.csv' "
        "--out 'out/datasets/s 1.h5' --tolerance-mm 3 --initial rest"
    )
    assert "lab/s 1/tracks/load.h5" in made.captures[0].inputs
    assert len(made.fits) == 5
    assert made.fits[0].inputs == made.captures[0].outputs
    with pytest.raises(InputError, match=r"capture: initial: expected auto or rest.*found 'late'"):
        sweep("specimens: ['lab/s *']\nmethods: [sysid]\ncapture: {initial: late}\n")
    with pytest.raises(InputError, match="capture: out: expected an option of rafl-capture"):
        sweep("specimens: ['lab/s *']\nmethods: [sysid]\ncapture: {out: x}\n")
    (tmp_path / "lab" / "s 2" / "recordings.csv").unlink()
    with pytest.raises(InputError, match=r"specimens: .*in lab/s 2, found no recordings\.csv"):
        sweep("specimens: ['lab/s *']\nmethods: [sysid]\n")
    with pytest.raises(InputError, match="specimens: expected the folder of a specimen"):
        sweep("specimens: [lab/s9]\nmethods: [sysid]\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("methods: [magic]\n", "methods.0.method: expected auto, rafl.*found 'magic'"),
        ("methods: []\n", "methods: .*at least 1"),
        ("methods: [sysid]\nsedes: [1]\n", "sedes: .*not permitted"),
        ("methods: [sysid]\nseeds: [1, x]\n", "seeds.1: .*integer.*found 'x'"),
        ("methods: [sysid]\nseeds: [1, 1]\n", "seeds: expected different numbers"),
        ("methods: [sysid, sysid]\n", "methods: .*'sysid' more than once; give each a `name`"),
        ("methods: [sysid]\ntrain: some\n", "train: .*'each', 'all' or 'folds'"),
        ("methods: [sysid]\nfolds: 2\n", "folds: expected `train: folds`"),
        ("methods: [sysid]\ntrain: folds\nfolds: 4\n", "folds: expected from 2 to 3"),
        ("methods: [sysid]\ntrain: all\nevaluate: left-out\n", "evaluate: expected `own` or `all`"),
        (
            "methods: [{method: rafl, options: {epoch: 3}}]\n",
            "methods.0.options: epoch: expected an option of rafl-fit",
        ),
        ("methods: [{method: rafl, options: {epochs: many}}]\n", "epochs: expected a whole number, found 'many'"),
        ("methods: [{method: rafl, options: {epochs: [2, 0]}}]\n", "epochs: expected at least 1, found 0"),
        ("methods: [{method: rafl, options: {epochs: true}}]\n", "epochs: expected a whole number, found True"),
        ("methods: [{method: rafl, options: {epochs: []}}]\n", "epochs: expected a value, found an empty list"),
        ("methods: [{method: rafl, options: {by-sigma: 1}}]\n", "by-sigma: expected true or false, found 1"),
        ("methods: [{method: rafl, options: {integrator: euler}}]\n", "integrator: expected implicit-euler or"),
        ("methods: [{method: rafl, options: {out: x}}]\n", "out: expected an option of rafl-fit"),
        ("methods: [{method: rafl, name: a/b}]\n", "methods.0.name: expected a name without slashes"),
        ("methods: [{method: rafl, name: " + "x" * 119 + "}]\n", "unit .*at most 120 bytes.*shorter `name`"),
        ("options: {seed: 3}\nmethods: [rafl]\n", "options: seed: expected an option"),
    ],
)
def test_mistakes_are_named(sweep: Units, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        sweep(text)
    assert "plan.yaml" in str(error.value) or text.endswith("folds: 4\n")


def test_missing_datasets_are_named(sweep: Units) -> None:
    head = "format: rafl-sweep/1\nmethods: [sysid]\n"
    with pytest.raises(InputError, match=r"datasets: expected a dataset at no\*\.h5, found nothing"):
        sweep("datasets: ['no*.h5']\n", head)
    with pytest.raises(InputError, match=r"datasets: expected at least one dataset, or `specimens`"):
        sweep("datasets: []\n", head)
    Path("other").mkdir()
    Path("other/thick.h5").touch()
    with pytest.raises(InputError, match=r"datasets: expected names .*'thick' more than once"):
        sweep("datasets: [thick.h5, other/thick.h5]\n", head)


def test_plans_offer_the_options_of_the_command() -> None:
    assert {"epochs", "warm-start", "from", "by-sigma", "limit-energy"} <= fit_options().keys()
    assert not {"out", "seed", "method", "resume", "each", "on", "jobs", "tensorboard"} & fit_options().keys()


def test_plain_commands_say_what_was_typed() -> None:
    values = {
        "datasets": [Path("a b.h5"), Path("-c.h5")],
        "seed": -3,
        "limit_energy": False,
        "by_sigma": True,
        "start": Path("old"),
        "epochs": None,
        "jobs": 4,
    }
    line = plain_command("rafl-fit", cli.fit, values)
    assert line == (
        "rafl-fit", "a b.h5", "./-c.h5", "--seed=-3", "--from", "old", "--by-sigma", "--no-limit-energy"
    )  # fmt: skip
    assert re.fullmatch("[a-z-]+", line[0])


def test_the_examples_of_the_documentation_are_read() -> None:
    folder = ROOT / "datasets" / "sweeps"
    plan = read_plan(folder / "plan.yaml")
    assert [variant.label for variant in variants(plan)] == [
        "auto",
        "field-warm-start=0",
        "field-warm-start=20",
        "field-on-material",
    ]
    assert read_cluster(folder / "cluster.yaml").partition == "short"
