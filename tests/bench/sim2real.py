"""The paper's sim-to-real study with a stricter simulator as the lab: simulated, filmed, tracked, captured, fitted.

    python tests/bench/sim2real.py [--quick] [--out build/sim2real]

Every shape goes down the whole road by the commands a lab types; every model is tested on every shape. Resumable: what
stands under --out is not made again. --quick takes three shapes, fewer recordings and trains less.
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
from commands import command
from rafl.capture.rendering.film import film, side_cameras, write_board_images
from rafl.capture.rendering.motion import Motion
from rafl.capture.rendering.render import Look, Painter
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rich.console import Console
from rich.table import Table

from rafl.common.command_line import progress
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset
from rafl.data.synthetic import hung, let_go
from rafl.evaluation.metrics import ORIGINAL, compare_those_that_simulate, latex_table, split_table
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.fitting.run_folder import FittedModel, load_model

DATASETS = Path(__file__).parents[2] / "datasets"
FPS = 100.0
DONE = "done"
TOGETHER = 4  # recordings simulated at once


@dataclass(frozen=True)
class Model:
    """What is fitted under a name.

    Attributes:
        method, options: of rafl-fit.
        start: name of the model that it goes on from.
    """

    method: str
    options: tuple[object, ...] = ()
    start: str = ""


MODELS = {
    "sysid": Model("sysid"),
    "sysid-e": Model("sysid-e"),
    "srl": Model("srl"),
    # As the paper trains: from no force at all, under backward differences.
    "rafl": Model("rafl", ("--warm-start", 0)),
    # Where the simulator's own damping does not hide the material's.
    "sysid-damping": Model("sysid-damping", ("--integrator", "generalised-alpha")),
    "rafl-from-sysid": Model("rafl", start="sysid-damping"),
}


@dataclass(frozen=True)
class Effort:
    """How much of everything.

    Attributes:
        shapes: as many of the study's; all where None.
        recordings: numbers of recordings to train, to validate and to test with; all where None.
        frames: of each recording; as the study says where None.
        epochs: by model.
    """

    shapes: tuple[str, ...] | None
    recordings: tuple[int, int, int] | None
    frames: int | None
    epochs: dict[str, int]


FULL = Effort(
    None,
    None,
    None,
    {"sysid": 30, "sysid-e": 15, "srl": 400, "rafl": 12, "sysid-damping": 14, "rafl-from-sysid": 12},
)
QUICK = Effort(
    ("canonical", "thicker-scaled", "shorter"),
    (3, 1, 2),
    50,
    {"sysid": 5, "sysid-e": 4, "srl": 75, "rafl": 8, "sysid-damping": 8, "rafl-from-sysid": 4},
)


class Study:
    """The experiment under one folder."""

    def __init__(self, out: Path, effort: Effort) -> None:
        self.out, self.effort = out, effort
        self.plan: dict[str, Any] = yaml.safe_load((DATASETS / "experiments" / "sim2real.yaml").read_text())
        self.shapes = list(effort.shapes or self.plan["shapes"])
        self.frames = effort.frames or self.plan["frames"]
        counts = effort.recordings or tuple(len(self.plan["split"][split]) for split in ("train", "val", "test"))
        splits = dict(zip(("train", "val", "test"), counts, strict=True))
        self.split = {number: split for split, count in splits.items() for number in self.plan["split"][split][:count]}

    def specimen(self, shape: str) -> Path:
        return DATASETS / "specimens" / f"{shape}.yaml"

    def models(self, shape: str) -> dict[str, int]:
        """Epochs by model; supervised learning, which is tied to a mesh, where the mesh is the first shape's too."""
        nodes = [len(read_specimen(self.specimen(each)).mesh.vertices) for each in (shape, self.shapes[0])]
        return {name: n for name, n in self.effort.epochs.items() if name != "srl" or nodes[0] == nodes[1]}

    def lab(self, shape: str) -> Specimen:
        """The specimen as the lab has it."""
        described, lab = read_specimen(self.specimen(shape)), self.plan["lab"]
        coarse = described.mesh
        axes = [np.unique(np.round(coarse.vertices[:, k], 9)) for k in range(3)]
        cells = [lab["refinement"] * (len(axis) - 1) for axis in axes]
        mesh = HexMesh.box(cells, np.ptp(coarse.vertices, axis=0))
        return replace(
            described,
            mesh=mesh,
            material=Material(**lab["material"]),
            fixed=mesh.face_nodes("x-min"),
            loaded=mesh.face_nodes("x-max"),
            integrator=lab["integrator"],
            substeps=lab["substeps"],
        )

    def motions(self, shape: str) -> list[Motion]:
        """What happens in the lab, from its file where it stands there."""
        path, lab = self.out / shape / "truth.npy", self.lab(shape)
        loads = 1e-3 * np.array(self.plan["hung_g"])[list(self.split)]
        names = tuple(f"load{1e3 * load:03.0f}g" for load in loads)
        if not path.exists():
            simulator, parts = lab.simulator(1.0 / FPS), []
            for k in range(0, len(loads), TOGETHER):
                print(f"{shape}: releasing {', '.join(names[k : k + TOGETHER])}", flush=True)
                starts = hung(simulator, lab.loaded, loads[k : k + TOGETHER])
                parts.append(let_go(simulator, starts, self.frames, names[k : k + TOGETHER]))
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path.with_suffix(".part.npy"), np.concatenate(parts, axis=1))
            path.with_suffix(".part.npy").rename(path)
        truth = np.load(path)
        time = np.arange(self.frames) / FPS
        return [Motion(name, load, time, truth[:, b]) for b, (name, load) in enumerate(zip(names, loads, strict=True))]

    def record(self, shape: str) -> None:
        """Film, calibrate, track and capture."""
        folder = self.out / shape
        if (folder / f"{shape}.h5").exists():
            return
        motions, lab, look = self.motions(shape), self.lab(shape), Look()
        random = np.random.default_rng(self.plan["shapes"].index(shape))
        rig = side_cameras(lab, motions, random)
        if not (folder / "calib.yaml").exists():
            shutil.rmtree(folder / "calibration", ignore_errors=True)
            write_board_images(folder / "calibration", rig, look, random)
            command("rafl-calibrate", folder / "calibration", "--out", folder / "calib.yaml")
        with progress() as bar:
            task = bar.add_task(f"{shape}: filming", total=self.frames * len(motions) * len(rig.cameras))
            for number, motion in enumerate(motions):
                for view, (name, camera) in enumerate(rig.cameras.items()):
                    path = folder / "videos" / motion.name / f"{name}.mp4"
                    if not path.exists():
                        painter = Painter.of(lab, camera, look, random)
                        film(path, motion, painter, FPS, "h264", 97 * number + view, lambda: bar.advance(task))
        command(
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
        command(
            "rafl-capture",
            self.specimen(shape),
            folder / "tracks",
            "--recordings",
            folder / "recordings.csv",
            "--out",
            folder / f"{shape}.h5",
        )

    def fit(self, shape: str) -> None:
        """Every model that applies."""
        for name, epochs in self.models(shape).items():
            run, model = self.out / shape / name, MODELS[name]
            if (run / DONE).exists():
                continue
            print(f"{shape}: fitting {name}", flush=True)
            resume = ["--resume"] if (run / "checkpoint.pt").exists() else []
            if not resume:
                shutil.rmtree(run, ignore_errors=True)
            dataset = self.out / shape / f"{shape}.h5"
            start = ["--from", run.with_name(model.start)] if model.start else []
            options = ["--method", model.method, "--epochs", epochs, *model.options, *start, *resume]
            command("rafl-fit", dataset, "--out", run, *options)
            (run / DONE).touch()

    def tested(self, shape: str) -> pd.DataFrame:
        """Test errors of all models on one shape, by method and the shape trained on."""
        tables = []
        for trained in self.shapes:
            path = self.out / shape / "tested" / f"{trained}.csv"
            parts = [pd.read_csv(path)] if path.exists() else []
            known = {name for part in parts for name in part["method"]}
            missing = [name for name in self.models(trained) if f"{name}@{trained}" not in known]
            if missing:
                print(f"{shape}: testing what was trained on {trained}", flush=True)
                dataset = read_dataset(self.out / shape / f"{shape}.h5")
                unseen = {name: dataset.trajectories[name] for name in dataset.split("test")}
                nodes, models = len(dataset.simulator.mesh.vertices), {}
                for name in missing:
                    model = load_model(self.out / trained / name)
                    if model.network is None or model.network.nodes == nodes:
                        models[f"{name}@{trained}"] = model
                if models:
                    parts.append(test_errors(replace(dataset, trajectories=unseen), models))
                    write_text(path, pd.concat(parts).drop_duplicates("method").to_csv(index=False))
            tables += parts
        return pd.concat(tables).drop_duplicates("method")


def test_errors(dataset: Dataset, models: dict[str, FittedModel]) -> pd.DataFrame:
    """Errors by method; infinite where a model lets a simulation fail."""
    compared, failures = compare_those_that_simulate(dataset, models)
    for name, error in failures.items():
        print(f"{dataset.name}, {name}: {error}")
    failed = [{"dataset": dataset.name, "split": "test", "method": name, "mean_mm": np.inf} for name in failures]
    return pd.concat([split_table(compared), pd.DataFrame(failed)])


def show(title: str, table: pd.DataFrame) -> None:
    printed = Table("", *map(str, table.columns), title=title)
    for name, row in table.iterrows():
        printed.add_row(str(name), *map(str, row))
    Console(width=170).print(printed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("build/sim2real"))
    parser.add_argument("--results", type=Path, help="folder for the tables")
    options = parser.parse_args()
    torch.set_num_threads(1)
    study = Study(options.out / ("quick" if options.quick else "full"), QUICK if options.quick else FULL)
    results = options.results or study.out
    for shape in study.shapes:
        study.record(shape)
        study.fit(shape)
    tested = {shape: study.tested(shape) for shape in study.shapes}
    own = []
    for shape, errors in tested.items():
        chosen = errors[errors["method"].isin([ORIGINAL, *(f"{name}@{shape}" for name in study.effort.epochs)])]
        own.append(chosen.assign(method=chosen["method"].str.removesuffix(f"@{shape}")))
    table = pd.concat(own)
    write_text(results / "sim2real.csv", table.to_csv(index=False, float_format="%.4f"))
    write_text(results / "sim2real.tex", latex_table(table))
    value = table["mean_mm"].map("{:.3f}".format) + " +- " + table["std_mm"].map("{:.3f}".format)
    shown = table.assign(error=value).pivot(index="dataset", columns="method", values="error").loc[study.shapes]
    shown = shown.fillna("N/A")
    show(
        "mean marker error on the test recordings of the shape trained on [mm]", shown[[ORIGINAL, *study.effort.epochs]]
    )
    rows = []
    for method in study.effort.epochs:
        matrix = pd.DataFrame(
            {
                shape: errors.set_index("method")["mean_mm"].reindex([f"{method}@{name}" for name in study.shapes])
                for shape, errors in tested.items()
            }
        ).set_axis(study.shapes)
        original = pd.Series(
            {shape: errors.set_index("method")["mean_mm"][ORIGINAL] for shape, errors in tested.items()}
        )
        matrix = matrix.dropna(how="all").dropna(axis="columns", how="all")
        apart = matrix.index.to_numpy()[:, None] != matrix.columns.to_numpy()
        worse = int((matrix.gt(original[matrix.columns], axis="columns") & apart).to_numpy().sum())
        tried = int((matrix.notna() & apart).to_numpy().sum())
        show(
            f"{method}: trained on a row's shape, tested on a column's [mm]",
            matrix.map("{:.3f}".format).replace("nan", "N/A"),
        )
        print(f"{method}: negative transfer in {worse} of {tried} pairs of different shapes")
        rows.append(matrix.rename_axis("trained_on").reset_index().assign(method=method))
    write_text(results / "sim2real-transfer.csv", pd.concat(rows).to_csv(index=False, float_format="%.4f"))


if __name__ == "__main__":
    main()
