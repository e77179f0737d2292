"""The paper's sim-to-real study with stricter simulators as laboratories.

    python tests/bench/sim2real.py [--size full] [--out build/sim2real] [--lab viscous] [--lab rubber] [--lab crooked]

Every shape is simulated, rendered to video, tracked, captured and fitted with the same commands as in a laboratory.
Every model is tested on every shape. Resumable: results under --out are not computed again. `--size short` takes half
of the recordings and shorter ones; `quick` takes three shapes and fewer recordings, and trains less.
"""

import argparse
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml
from commands import run_command
from rich.console import Console

from rafl.capture.rendering.film import render_video, side_cameras, write_board_images
from rafl.capture.rendering.motion import SimulatedMotion
from rafl.capture.rendering.render import Appearance, Renderer
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.command_line import create_table, progress
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset
from rafl.data.synthetic import loaded_equilibria, simulate_release
from rafl.evaluation.metrics import BASELINE, compare_skipping_failures, latex_table, split_table
from rafl.fem.material import Material
from rafl.fem.maxwell import branch_shares, branch_times
from rafl.fem.mesh import HexMesh
from rafl.fitting.run_folder import FittedModel, load_model

DATASETS = Path(__file__).parents[2] / "datasets"
FPS = 100.0
LABS = ("viscous", "rubber", "crooked")  # of datasets/experiments/sim2real.yaml
FINISHED_MARK = "done"  # file in a run folder after the fit
SIMULATION_BATCH = 4  # recordings simulated at once


@dataclass(frozen=True)
class ModelFit:
    """How a model is fitted.

    Attributes:
        method: of rafl-fit.
        options: of rafl-fit.
        start: name of the model that the fit starts from; empty for none.
    """

    method: str
    options: tuple[object, ...] = ()
    start: str = ""


MODELS = {
    "auto": ModelFit("auto"),
    "sysid": ModelFit("sysid"),
    "sysid-e": ModelFit("sysid-e"),
    "srl": ModelFit("srl"),
    # As in the paper: without pre-training, with implicit Euler.
    "rafl": ModelFit("rafl", ("--warm-start", 0, "--no-limit-energy")),
    # With time integration that hardly damps, so that the material's damping is observable.
    "sysid-damping": ModelFit("sysid-damping", ("--integrator", "generalised-alpha")),
    "rafl-from-sysid": ModelFit("rafl", start="sysid-damping"),
}


@dataclass(frozen=True)
class StudySize:
    """Size of the study.

    Attributes:
        shapes: names; None for all of the study's.
        recordings: numbers of training, validation and test recordings; None for all.
        frames: of each recording; None for the study's own number.
        epochs: by model; None for the default.
    """

    shapes: tuple[str, ...] | None
    recordings: tuple[int, int, int] | None
    frames: int | None
    epochs: dict[str, int | None]


FULL = StudySize(
    None,
    None,
    None,
    {"auto": None, "sysid": 30, "sysid-e": 15, "srl": 400, "rafl": 12, "sysid-damping": 14, "rafl-from-sysid": 12},
)
SHORT = replace(FULL, recordings=(5, 1, 2), frames=100)
QUICK = StudySize(
    ("canonical", "thicker-scaled", "shorter"),
    (3, 1, 2),
    50,
    {"auto": None, "sysid": 5, "sysid-e": 4, "srl": 75, "rafl": 8, "sysid-damping": 8, "rafl-from-sysid": 4},
)
SIZES = {"full": FULL, "short": SHORT, "quick": QUICK}


class Study:
    """The experiment with one laboratory, in one folder."""

    def __init__(self, lab: str, out: Path, size: StudySize) -> None:
        self.lab, self.out, self.size = lab, out / lab, size
        self.plan: dict[str, Any] = yaml.safe_load((DATASETS / "experiments" / "sim2real.yaml").read_text())
        self.shapes = list(size.shapes or self.plan["shapes"])
        self.frames = size.frames or self.plan["frames"]
        counts = size.recordings or tuple(len(self.plan["split"][split]) for split in ("train", "val", "test"))
        splits = dict(zip(("train", "val", "test"), counts, strict=True))
        self.split = {
            number: split for split, count in splits.items() for number in evenly(self.plan["split"][split], count)
        }

    def specimen(self, shape: str) -> Path:
        """The specimen's file: the shape of the package, with preset `physical` and the assumed material."""
        path = self.out / "specimens" / f"{shape}.yaml"
        if not path.exists():
            content = yaml.safe_load((DATASETS / "specimens" / f"{shape}.yaml").read_text())
            content["material"]["preset"] = "physical"
            write_text(path, yaml.safe_dump(content, sort_keys=False))
        return path

    def models(self, shape: str) -> dict[str, int | None]:
        """Epochs by model; `srl`, which is bound to one mesh, only where the mesh is that of the first shape."""
        nodes = [len(read_specimen(self.specimen(each)).mesh.vertices) for each in (shape, self.shapes[0])]
        return {name: n for name, n in self.size.epochs.items() if name != "srl" or nodes[0] == nodes[1]}

    def laboratory_specimen(self, shape: str) -> Specimen:
        """The specimen as it is in the laboratory: finer mesh, true material, and what is not as described."""
        described, lab = read_specimen(self.specimen(shape)), self.plan["labs"][self.lab]
        coarse = read_specimen(DATASETS / "specimens" / f"{shape}.yaml").mesh  # without a cut at the clamp
        size = np.ptp(coarse.vertices, axis=0)
        axes = [np.unique(np.round(coarse.vertices[:, k], 9)) for k in range(3)]
        cells = [lab["refinement"] * (len(axis) - 1) for axis in axes]
        mesh, layout = HexMesh.box(cells, size), described.layout
        if "crooked" in lab:
            number = self.plan["shapes"].index(shape)
            positions = layout.positions + misplaced(layout.positions, size, lab["crooked"], number)
            mesh = replace(mesh, vertices=deviating(mesh.vertices, size, lab["crooked"]))
            layout = replace(layout, positions=deviating(positions, size, lab["crooked"]))
        return replace(
            described,
            mesh=mesh,
            layout=layout,
            material=laboratory_material(lab["material"]),
            fixed=mesh.face_nodes("x-min"),
            loaded=mesh.face_nodes("x-max"),
            integrator=lab["integrator"],
            substeps=lab["substeps"],
        )

    def motions(self, shape: str) -> list[SimulatedMotion]:
        """The simulated motions in the laboratory; simulated if their file is missing."""
        path, lab = self.out / shape / "truth.npy", self.laboratory_specimen(shape)
        loads = 1e-3 * np.array(self.plan["hung_g"])[list(self.split)]
        names = tuple(f"load{1e3 * load:03.0f}g" for load in loads)
        if not path.exists():
            simulator, parts = lab.simulator(1.0 / FPS), []
            for k in range(0, len(loads), SIMULATION_BATCH):
                print(f"{shape}: simulating the release of {', '.join(names[k : k + SIMULATION_BATCH])}", flush=True)
                starts = loaded_equilibria(simulator, lab.loaded, loads[k : k + SIMULATION_BATCH])
                parts.append(simulate_release(simulator, starts, self.frames, names[k : k + SIMULATION_BATCH]))
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path.with_suffix(".part.npy"), np.concatenate(parts, axis=1))
            path.with_suffix(".part.npy").rename(path)
        truth = np.load(path)
        time = np.arange(self.frames) / FPS
        return [
            SimulatedMotion(name, load, time, truth[:, b])
            for b, (name, load) in enumerate(zip(names, loads, strict=True))
        ]

    def build_dataset(self, shape: str) -> None:
        """Render, calibrate, track and capture."""
        folder = self.out / shape
        if (folder / f"{shape}.h5").exists():
            return
        motions, lab, appearance = self.motions(shape), self.laboratory_specimen(shape), Appearance()
        random = np.random.default_rng(self.plan["shapes"].index(shape))
        rig = side_cameras(lab, motions, random)
        if not (folder / "calib.yaml").exists():
            shutil.rmtree(folder / "calibration", ignore_errors=True)
            write_board_images(folder / "calibration", rig, appearance, random)
            run_command("rafl-calibrate", folder / "calibration", "--out", folder / "calib.yaml")
        with progress() as bar:
            task = bar.add_task(f"{shape}: rendering", total=self.frames * len(motions) * len(rig.cameras))
            for number, motion in enumerate(motions):
                for view, (name, camera) in enumerate(rig.cameras.items()):
                    path = folder / "videos" / motion.name / f"{name}.mp4"
                    if not path.exists():
                        renderer = Renderer.of(lab, camera, appearance, random)
                        render_video(path, motion, renderer, FPS, "h264", 97 * number + view, lambda: bar.advance(task))
        run_command(
            "rafl-track",
            folder / "videos",
            "--calib",
            folder / "calib.yaml",
            "--specimen",
            self.specimen(shape),
            "--out",
            folder / "tracks",
        )
        rows = [f"{m.name},{1e3 * m.load:g},{split}" for m, split in zip(motions, self.split.values(), strict=True)]
        write_text(folder / "recordings.csv", "\n".join(["recording,load_g,split", *rows, ""]))
        run_command(
            "rafl-capture",
            self.specimen(shape),
            folder / "tracks",
            "--recordings",
            folder / "recordings.csv",
            "--out",
            folder / f"{shape}.h5",
        )

    def fit(self, shape: str) -> None:
        """Fit every applicable model."""
        for name, epochs in self.models(shape).items():
            run, model = self.out / shape / name, MODELS[name]
            if (run / FINISHED_MARK).exists():
                continue
            print(f"{shape}: fitting {name}", flush=True)
            resume = ["--resume"] if list(run.glob("checkpoint*.pt")) else []
            if not resume:
                shutil.rmtree(run, ignore_errors=True)
            dataset = self.out / shape / f"{shape}.h5"
            start = ["--from", run.with_name(model.start)] if model.start else []
            limit = [] if epochs is None else ["--epochs", epochs]
            options = ["--method", model.method, *limit, *model.options, *start, *resume]
            run_command("rafl-fit", dataset, "--out", run, *options)
            (run / FINISHED_MARK).touch()

    def test(self, shape: str) -> pd.DataFrame:
        """Test errors of all models on one shape; `method` is METHOD@SHAPE with the shape trained on."""
        tables = []
        for trained in self.shapes:
            path = self.out / shape / "tested" / f"{trained}.csv"
            parts = [pd.read_csv(path)] if path.exists() else []
            known = {name for part in parts for name in part["method"]}
            missing = [name for name in self.models(trained) if f"{name}@{trained}" not in known]
            if missing:
                print(f"{shape}: testing models trained on {trained}", flush=True)
                dataset = read_dataset(self.out / shape / f"{shape}.h5")
                held_out = {name: dataset.trajectories[name] for name in dataset.split("test")}
                nodes, models = len(dataset.simulator.mesh.vertices), {}
                for name in missing:
                    model = load_model(self.out / trained / name)
                    if model.network is None or model.network.nodes == nodes:
                        models[f"{name}@{trained}"] = model
                if models:
                    parts.append(errors_by_method(replace(dataset, trajectories=held_out), models))
                    write_text(path, pd.concat(parts).drop_duplicates("method").to_csv(index=False))
            tables += parts
        return pd.concat(tables).drop_duplicates("method")


def evenly(values: list[int], count: int) -> list[int]:
    """`count` of some values at even places."""
    return [values[k] for k in np.linspace(0, len(values) - 1, count).round().astype(int)]


def laboratory_material(content: dict[str, Any]) -> Material:
    """The material of a laboratory; `loss` stands for branches of a constant loss factor."""
    values = dict(content)
    if "loss" in values:
        loss = values.pop("loss")
        frequencies = (loss["from_hz"], loss["to_hz"])
        shares = branch_shares(torch.tensor(loss["tan_delta"], dtype=torch.float64), *frequencies)
        values |= {"branch_shares": tuple(shares.tolist()), "branch_times": branch_times(*frequencies)}
    return Material(**values)


def deviating(positions: np.ndarray, size: np.ndarray, crooked: dict[str, float]) -> np.ndarray:
    """Positions (.., 3) [m] in a body of a size (3) [m] as described, in the one that was really made.

    Its section is wider and lower, it gets thinner towards the tip, and it reaches a little into the clamp, which
    therefore gives.
    """
    along = positions[..., 0] / size[0]
    section = crooked["section_percent"] / 100
    # Bending stiffness grows with the cube of the height.
    height = (1.0 - section) * (1.0 - crooked["tip_softer_percent"] / 300 * along)
    moved = positions.copy()
    moved[..., 0] = positions[..., 0] - 1e-3 * crooked["clamp_gives_mm"] * (1.0 - along)
    moved[..., 1] = 0.5 * size[1] + (1.0 + section) * (positions[..., 1] - 0.5 * size[1])
    moved[..., 2] = 0.5 * size[2] + height * (positions[..., 2] - 0.5 * size[2])
    return moved


def misplaced(positions: np.ndarray, size: np.ndarray, crooked: dict[str, float], seed: int) -> np.ndarray:
    """Distances [m], (M, 3), of dots from their described places, on their face of the body."""
    random = np.random.default_rng(seed)
    largest = 1e-3 * crooked["dots_off_mm"]
    offset = random.uniform(-largest, largest, positions.shape)
    offset *= np.minimum(1.0, largest / np.linalg.norm(offset, axis=1))[:, None]
    distance = np.minimum(np.abs(positions), np.abs(size - positions))
    offset[np.arange(len(positions)), distance.argmin(axis=1)] = 0.0
    return offset


def errors_by_method(dataset: Dataset, models: dict[str, FittedModel]) -> pd.DataFrame:
    """Errors by method; infinite for a model whose simulation fails."""
    compared, failures = compare_skipping_failures(dataset, models)
    for name, error in failures.items():
        print(f"{dataset.name}, {name}: {error}")
    failed = [{"dataset": dataset.name, "split": "test", "method": name, "mean_mm": np.inf} for name in failures]
    return pd.concat([split_table(compared), pd.DataFrame(failed)])


def show(title: str, table: pd.DataFrame) -> None:
    printed = create_table("", *map(str, table.columns), title=title)
    for name, row in table.iterrows():
        printed.add_row(str(name), *map(str, row))
    Console(width=170).print(printed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=SIZES, default="full", help="of the study [full]")
    parser.add_argument("--out", type=Path, default=Path("build/sim2real"), help="folder for videos, datasets and runs")
    parser.add_argument("--results", type=Path, help="folder for the tables [that of the study]")
    parser.add_argument("--lab", choices=LABS, action="append", help="only this laboratory [all]")
    parser.add_argument("--model", choices=MODELS, action="append", help="only this model [all]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    size = SIZES[options.size]
    if options.model:
        size = replace(size, epochs={name: size.epochs[name] for name in options.model})
    for lab in options.lab or LABS:
        study = Study(lab, options.out / options.size, size)
        run_study(study, options.results or study.out)


def run_study(study: Study, results: Path) -> None:
    """Compute what is missing of a study; print and write its tables."""
    print(f"laboratory {study.lab}", flush=True)
    suffix = f"-{study.lab}"
    for shape in study.shapes:
        study.build_dataset(shape)
        study.fit(shape)
    tested = {shape: study.test(shape) for shape in study.shapes}
    own_errors = []
    for shape, errors in tested.items():
        chosen = errors[errors["method"].isin([BASELINE, *(f"{name}@{shape}" for name in study.size.epochs)])]
        own_errors.append(chosen.assign(method=chosen["method"].str.removesuffix(f"@{shape}")))
    table = pd.concat(own_errors)
    write_text(results / f"sim2real{suffix}.csv", table.to_csv(index=False, float_format="%.4f"))
    write_text(results / f"sim2real{suffix}.tex", latex_table(table))
    value = table["mean_mm"].map("{:.3f}".format) + " +- " + table["std_mm"].map("{:.3f}".format)
    shown = table.assign(error=value).pivot(index="dataset", columns="method", values="error").loc[study.shapes]
    shown = shown.fillna("N/A")
    show(
        "marker error on the test recordings of the shape trained on, mean +- standard deviation [mm]",
        shown[[BASELINE, *study.size.epochs]],
    )
    rows = []
    for method in study.size.epochs:
        matrix = pd.DataFrame(
            {
                shape: errors.set_index("method")["mean_mm"].reindex([f"{method}@{name}" for name in study.shapes])
                for shape, errors in tested.items()
            }
        ).set_axis(study.shapes)
        original = pd.Series(
            {shape: errors.set_index("method")["mean_mm"][BASELINE] for shape, errors in tested.items()}
        )
        matrix = matrix.dropna(how="all").dropna(axis="columns", how="all")
        different = matrix.index.to_numpy()[:, None] != matrix.columns.to_numpy()
        worse = int((matrix.gt(original[matrix.columns], axis="columns") & different).to_numpy().sum())
        pairs = int((matrix.notna() & different).to_numpy().sum())
        show(
            f"{method}: mean marker error [mm], trained on rows, tested on columns",
            matrix.map("{:.3f}".format).replace("nan", "N/A"),
        )
        ratio = np.log((matrix / original[matrix.columns]).to_numpy())
        own, others = (np.exp(np.nanmean(ratio[mask])) for mask in (~different, different))
        print(
            f"{study.lab}, {method}: negative transfer in {worse} of {pairs} pairs of different shapes; error over "
            f"that of the baseline simulator, geometric mean: {own:.3f} on the own shape, {others:.3f} on the others"
        )
        rows.append(matrix.rename_axis("trained_on").reset_index().assign(method=method))
    write_text(results / f"sim2real{suffix}-transfer.csv", pd.concat(rows).to_csv(index=False, float_format="%.4f"))


if __name__ == "__main__":
    main()
