"""A stand-in laboratory: a known material on a finer mesh, recorded on several shapes, and the models fitted to it."""

import sys
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml

from rafl.api import fit
from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset, write_dataset
from rafl.data.objective import Recordings, training_loss
from rafl.data.synthetic import loaded_equilibria, simulate_release
from rafl.evaluation.metrics import BASELINE, compare
from rafl.evaluation.oscillation import fit_oscillation, most_active_coordinate
from rafl.fem.material import Material
from rafl.fem.maxwell import complex_modulus
from rafl.fitting.run_folder import FittedModel, load_model
from rafl.tracking.reconstruction.tracks import write_tracks

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from synthetic_tracks import tracks_of_positions

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
TRAINED_ON = "canonical"
FPS = 100.0
TRACKED_SIGMA = 1e-5  # that tracking would state [m]; the recorded markers themselves have no error
SIMULATION_BATCH = 4  # recordings simulated at once
FINISHED_MARK = "done"  # file in a run folder after the fit

# Loads of the sim-to-real study (datasets/experiments/sim2real.yaml).
TIP_WEIGHTS_KG = (
    *(0.020, 0.024, 0.028, 0.040, 0.036, 0.032, 0.044, 0.048),
    *(0.060, 0.038, 0.052, 0.056, 0.064, 0.068, 0.080, 0.072),
)
LAB_SUBSTEPS = 4
LAB_REFINEMENT = 2  # cells of a laboratory along the edge of one of the specimen's
LABS: dict[str, dict[str, Any]] = {  # material sections of specimen files
    "viscous": {
        "law": "corotated",
        "youngs_modulus": 130e3,
        "poissons_ratio": 0.499,
        "density": 1070,
        "viscosity": 100.0,
    },
    "rubber": {
        "law": "neo-hookean",
        "youngs_modulus": 130e3,
        "poissons_ratio": 0.499,
        "density": 1070,
        "branches": [{"modulus_share": 0.06, "time_s": tau} for tau in (0.01, 0.1, 1.0)],
    },
}
ASSUMED = {"youngs_modulus": 215856, "poissons_ratio": 0.45, "density": 1070}


@dataclass(frozen=True)
class Model:
    """A model: how the specimen is described, and the method that identifies its material.

    Attributes:
        method: of rafl-fit; empty for the laboratory's own material.
        material, simulation: additions to these sections of the specimen files.
    """

    method: str
    material: dict[str, Any] = field(default_factory=dict)
    simulation: dict[str, Any] = field(default_factory=dict)

    @property
    def setup(self) -> str:
        """Name of the description, for files."""
        values = {**self.material, **self.simulation}
        return "-".join(["physical", *(f"{key}-{value}" for key, value in values.items())])


LAB_MATERIAL = "the lab's material"
NEO_HOOKEAN = {"law": "neo-hookean"}
MODELS = {
    "sysid-damping": Model("sysid-damping"),
    "sysid-loss": Model("sysid-loss"),
    "sysid-branches": Model("sysid-branches"),
    LAB_MATERIAL: Model(""),
    "sysid-branches, neo-Hookean": Model("sysid-branches", NEO_HOOKEAN),
    f"{LAB_MATERIAL}, neo-Hookean": Model("", NEO_HOOKEAN),
    "auto": Model("auto"),
    "sysid-damping, full": Model("sysid-damping", {"integration": "full"}),
    "sysid-damping, selective": Model("sysid-damping", {"integration": "selective"}),
}
JUDGED = ("sysid-branches", "sysid-branches, neo-Hookean")  # by the bars of the benchmark


@dataclass(frozen=True)
class Size:
    """Size of the benchmark: shapes, frames of each recording, and split by the index of the tip weight."""

    shapes: tuple[str, ...]
    frames: int
    train: tuple[int, ...]
    val: tuple[int, ...]
    test: tuple[int, ...]


FULL = Size(("canonical", "shorter", "thicker", "longer", "thinner"), 150, (0, 8, 14), (5,), (1, 2, 7, 9, 11))
QUICK = Size(("canonical", "shorter", "longer"), 60, (0, 8, 14), (5,), (2, 11))


def describe(path: Path, shape: str, cells_per_edge: int, material: dict[str, Any], simulation: dict[str, Any]) -> Path:
    """Write a specimen file: a shape of the package with another mesh, material and time integration."""
    content = yaml.safe_load((SPECIMENS / f"{shape}.yaml").read_text())
    content["geometry"]["element_mm"] /= cells_per_edge
    content["material"] = {"preset": "physical", **material}
    content["simulation"] = simulation
    write_text(path, yaml.safe_dump(content, sort_keys=False))
    return path


def material_of(model: FittedModel, assumed: Material) -> Material:
    """The assumed material with a model's identified values."""
    values: dict[str, Any] = dict(model.material or {})
    return replace(assumed, **{key: tuple(x) if isinstance(x, list) else x for key, x in values.items()})


def loss_factor(material: Material, frequency: float) -> float:
    """Loss factor in tension, and so in bending, at a frequency [Hz], of branches and viscosity together.

    A viscous stress 2 G dE/dt dissipates by the whole strain, of components 1, -nu and -nu times that along the beam.
    """
    shares, times = (torch.tensor(x, dtype=torch.float64) for x in (material.branch_shares, material.branch_times))
    storage, loss = complex_modulus(shares, times, torch.tensor([frequency], dtype=torch.float64))
    viscous = 2.0 * np.pi * frequency * material.viscosity / material.lame[0]
    nu = material.poissons_ratio
    in_tension = (1.0 + 2.0 * nu**2) / (1.0 + nu)  # of 2 mu sum e_i^2, relative to E e^2
    return in_tension * (float(loss) + viscous) / (1.0 + in_tension * (float(storage) - 1.0))


class Laboratory:
    """One laboratory and its recordings, in one folder."""

    def __init__(self, name: str, out: Path, size: Size) -> None:
        self.name, self.out, self.size = name, out / name, size

    def specimen(self, shape: str, refinement: int = LAB_REFINEMENT, substeps: int = LAB_SUBSTEPS) -> Specimen:
        """The specimen as it is simulated in the laboratory."""
        path = self.out / shape / f"lab-{refinement}-{substeps}.yaml"
        return read_specimen(describe(path, shape, refinement, LABS[self.name], {"substeps": substeps}))

    @property
    def material(self) -> Material:
        """The true material."""
        return self.specimen(TRAINED_ON).material

    def splits(self, shape: str) -> dict[int, str]:
        """Split of every recording of a shape, by the index of its tip weight."""
        splits = dict.fromkeys(self.size.test, "test")
        if shape == TRAINED_ON:
            splits |= dict.fromkeys(self.size.train, "train") | dict.fromkeys(self.size.val, "val")
        return splits

    def record(self, shape: str) -> None:
        """Simulate the recordings of a shape and write their tracks."""
        tracks = self.out / shape / "tracks"
        missing = [k for k in self.splits(shape) if not (tracks / f"w{k:02d}.h5").exists()]
        specimen = self.specimen(shape)
        names = specimen.layout.names
        for first in range(0, len(missing), SIMULATION_BATCH):
            chosen = missing[first : first + SIMULATION_BATCH]
            start = time.perf_counter()
            positions = self.markers(specimen, chosen, self.size.frames)
            for b, k in enumerate(chosen):
                write_tracks(tracks / f"w{k:02d}.h5", tracks_of_positions(names, positions[:, b], TRACKED_SIGMA, FPS))
            print(f"{self.name}, {shape}: recorded weights {chosen} in {time.perf_counter() - start:.0f} s", flush=True)

    def markers(self, specimen: Specimen, weights: list[int], frames: int) -> np.ndarray:
        """Marker positions [m], (T, B, M, 3), after the release of weights at the tip, by their indices."""
        simulator = specimen.simulator(1.0 / FPS)
        starts = loaded_equilibria(simulator, specimen.loaded, np.array([TIP_WEIGHTS_KG[k] for k in weights]))
        names = tuple(f"weight {k}" for k in weights)
        positions = torch.from_numpy(simulate_release(simulator, starts, frames, names))
        return specimen.markers(1e-9).positions(positions).numpy()

    def dataset(self, shape: str, model: Model) -> Dataset:
        """The dataset of a shape as a model describes it; built as rafl-capture does."""
        path = self.out / shape / f"{model.setup}.h5"
        if not path.exists():
            start = time.perf_counter()
            described = describe(path.with_suffix(".yaml"), shape, 1, ASSUMED | model.material, model.simulation)
            rows = [
                RecordingRow(recording=f"w{k:02d}", load_g=1e3 * TIP_WEIGHTS_KG[k], split=split, first_frame=0)
                for k, split in self.splits(shape).items()
            ]
            settings, folder = CaptureSettings(fps=FPS), self.out / shape / "tracks"
            dataset = build_dataset(read_specimen(described), folder, rows, settings, "", lambda: None)
            write_dataset(path, dataset)
            residual = max(float(str(item.attributes["fit_residual_mm"])) for item in dataset.trajectories.values())
            print(
                f"{self.name}, {shape}, {model.setup}: dataset in {time.perf_counter() - start:.0f} s, "
                f"first frames within {residual:.3f} mm (root mean square)",
                flush=True,
            )
        return read_dataset(path)

    def fit(self, name: str) -> FittedModel:
        """The model of a name, fitted on the canonical beam."""
        model = MODELS[name]
        integration = self.dataset(TRAINED_ON, model).simulator.time_integration
        if not model.method:
            true = self.material
            keys = ("youngs_modulus", "poissons_ratio", "viscosity", "branch_shares", "branch_times")
            values = {key: getattr(true, key) for key in keys}
            material = {key: list(x) if isinstance(x, tuple) else x for key, x in values.items()}
            return FittedModel(name, material=material, time_integration=integration)
        run = self.out / "runs" / name.replace(", ", "-").replace(" ", "-")
        if not (run / FINISHED_MARK).exists():
            start = time.perf_counter()
            resume = (run / "config.yaml").exists()
            dataset = self.out / TRAINED_ON / f"{model.setup}.h5"
            fit(dataset, run, model.method, resume=resume, report=lambda row: show_row(f"{self.name}, {name}", row))
            write_text(run / FINISHED_MARK, f"{time.perf_counter() - start:.0f} s\n")
        return load_model(run)

    def errors(self, shape: str, name: str) -> pd.DataFrame:
        """Mean and first-frame error [mm] of the test recordings of a shape, for a model and for its baseline."""
        path = self.out / shape / "tested" / f"{name}.csv"
        if not path.exists():
            dataset = self.dataset(shape, MODELS[name])
            held_out = {key: dataset.trajectories[key] for key in dataset.split("test")}
            tested = compare(replace(dataset, trajectories=held_out), {name: self.fit(name)})
            rows = {
                method: {
                    "mean_mm": 1e3 * np.mean([item.errors[method].mean() for item in tested]),
                    "first_frame_mm": 1e3 * np.mean([item.errors[method][0] for item in tested]),
                }
                for method in (name, BASELINE)
            }
            write_text(path, pd.DataFrame.from_dict(rows, orient="index").rename_axis("method").to_csv())
        return pd.read_csv(path).set_index("method")

    @cached_property
    def swing_frequency(self) -> float:
        """Mean frequency [Hz] of the canonical beam's test recordings."""
        frequencies = []
        dataset = self.dataset(TRAINED_ON, MODELS[JUDGED[0]])
        for key in dataset.split("test"):
            item = dataset.trajectories[key]
            marker, axis = most_active_coordinate(item.markers)
            frequencies.append(fit_oscillation(item.time, item.markers[:, marker, axis]).frequency)
        return float(np.mean(frequencies))

    def training_loss(self, name: str) -> float:
        """The training loss of a model, as its fit minimises it."""
        dataset, model = self.dataset(TRAINED_ON, MODELS[name]), self.fit(name)
        recordings = Recordings.of(dataset, dataset.split("train"))
        with torch.no_grad():
            simulated, forces = recordings.simulate(parameters=model.parameters(dataset.simulator))
        return float(training_loss(recordings, simulated, forces))

    def convergence(self) -> pd.DataFrame:
        """The canonical beam's sag with the laboratory's mesh and a finer one, and the effect of half the time step."""
        path = self.out / "convergence.csv"
        if not path.exists():
            rows = []
            own, weights = self.specimen(TRAINED_ON), [self.size.test[0], self.size.test[-1]]
            finer = self.specimen(TRAINED_ON, 2 * LAB_REFINEMENT)
            sags = [self.sag(specimen, weights) for specimen in (own, finer)]
            halved = self.specimen(TRAINED_ON, substeps=2 * LAB_SUBSTEPS)
            moved = [self.markers(specimen, weights, self.size.frames) for specimen in (own, halved)]
            distance = 1e3 * np.linalg.norm(moved[0] - moved[1], axis=-1).mean((0, 2))
            for b, k in enumerate(weights):
                rows.append(
                    {
                        "weight": k,
                        "sag_mm": 1e3 * sags[0][b],
                        "finer_sag_mm": 1e3 * sags[1][b],
                        "half_step_distance_mm": distance[b],
                    }
                )
            write_text(path, pd.DataFrame(rows).to_csv(index=False))
        return pd.read_csv(path)

    def sag(self, specimen: Specimen, weights: list[int]) -> np.ndarray:
        """Mean sag of the tip [m], (B), under weights."""
        loads = np.array([TIP_WEIGHTS_KG[k] for k in weights])
        q = loaded_equilibria(specimen.simulator(1.0 / FPS), specimen.loaded, loads)
        sag: np.ndarray = (specimen.mesh.vertices - q)[:, specimen.loaded, 2].mean(1)
        return sag


def show_row(label: str, row: dict[str, float]) -> None:
    print(label + ": " + ", ".join(f"{key} {value:.6g}" for key, value in row.items()), flush=True)
