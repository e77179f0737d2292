"""A specimen whose dots are up to 0.5 mm off: are their places found, and is E as exact as with the true layout?

    python tests/bench/places.py [--specimens 3] [--out build/places]

The canonical beam as the laboratory `rubber` of the sim-to-real study has it, on a finer mesh, released from four loads
and recorded with 0.01 mm of noise. Only E is identified; Poisson's ratio and loss factor are the true ones.
"""

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from sim2real import SHORT, Study, misplaced

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.dataset.table import RecordingRow
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.command_line import create_table
from rafl.data.dataset import Dataset
from rafl.data.synthetic import loaded_equilibria, simulate_release
from rafl.fitting.methods import METHODS
from rafl.fitting.run_folder import Settings
from rafl.tracking.linking.layout import MarkerLayout
from rafl.tracking.reconstruction.tracks import write_tracks

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from synthetic_tracks import tracks_of_positions

LOADS_G = {"train": (30, 60, 75), "val": (45,)}
FRAMES, FPS = 60, 100.0
NOISE_SIGMA = 1e-5  # of the markers [m]
DOTS_OFF_MM = 0.5
METHOD, EPOCHS = "sysid-e", 15
TRUE, FOUND, DESCRIBED = "true places", "places found", "as described"


def simulated_motion(laboratory: Specimen, path: Path) -> np.ndarray:
    """Node positions [m], (T, B, N, 3), after the release of every load; read if they were simulated before."""
    if not path.exists():
        simulator = laboratory.simulator(1.0 / FPS)
        loads = 1e-3 * np.array([load for loads in LOADS_G.values() for load in loads], dtype=float)
        starts = loaded_equilibria(simulator, laboratory.loaded, loads)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, simulate_release(simulator, starts, FRAMES, tuple(f"{1e3 * load:.0f} g" for load in loads)))
    result: np.ndarray = np.load(path)
    return result


def record(laboratory: Specimen, motion: np.ndarray, folder: Path, seed: int) -> list[RecordingRow]:
    """Write one tracks file for every release, with noise."""
    markers, random = laboratory.markers(1e-6), np.random.default_rng(100 + seed)
    rows = [RecordingRow(recording=f"load{g}", load_g=g, split=split) for split in LOADS_G for g in LOADS_G[split]]
    for b, row in enumerate(rows):
        exact = markers.positions(torch.from_numpy(motion[:, b])).numpy()
        position = exact + random.normal(0.0, NOISE_SIGMA, exact.shape)
        tracks = tracks_of_positions(markers.names, position, NOISE_SIGMA, FPS)
        write_tracks(folder / f"{row.recording}.h5", tracks)
    return rows


def with_layout(specimen: Specimen, positions: np.ndarray, sigma: float) -> Specimen:
    return replace(specimen, layout=MarkerLayout(specimen.layout.names, positions, sigma))


def identified_modulus(dataset: Dataset, run: Path) -> float:
    """Young's modulus that fits the training recordings best [Pa]."""
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir(parents=True)
    settings = Settings(METHOD, (dataset.name,), EPOCHS, 0.0, 0.0, 0, FRAMES, 0)
    METHODS[METHOD]([dataset], settings, run, lambda row: None)
    table = pd.read_csv(run / "parameters.csv")
    return float(table.set_index("name").loc["youngs_modulus", "value"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--specimens", type=int, default=3, help="with dots at other places [3]")
    parser.add_argument("--out", type=Path, default=Path("build/places"), help="folder for recordings and runs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    study = Study("rubber", options.out, SHORT)
    described, laboratory = read_specimen(study.specimen("canonical")), study.laboratory_specimen("canonical")
    known = {"youngs_modulus": described.material.youngs_modulus, "law": described.material.law}
    described = replace(described, material=replace(laboratory.material, **known))
    motion = simulated_motion(laboratory, options.out / "motion.npy")
    size = np.ptp(described.mesh.vertices, axis=0)
    table = create_table("specimen", "layout", "places off [mm]", "E [kPa]", "from true places")
    for seed in range(options.specimens):
        folder = options.out / str(seed)
        off = misplaced(described.layout.positions, size, {"dots_off_mm": DOTS_OFF_MM}, 50 + seed)
        true = described.layout.positions + off
        rows = record(with_layout(laboratory, true, 0.0), motion, folder / "tracks", seed)
        variants = {
            TRUE: with_layout(described, true, 0.0),
            FOUND: with_layout(described, described.layout.positions, 1e-3 * DOTS_OFF_MM),
            DESCRIBED: with_layout(described, described.layout.positions, 0.0),
        }
        reference = np.nan
        for name, specimen in variants.items():
            dataset = build_dataset(specimen, folder / "tracks", rows, CaptureSettings(), "", lambda: None)
            modulus = identified_modulus(dataset, folder / name.replace(" ", "-"))
            reference = modulus if name == TRUE else reference
            # The direction off the face does not matter: dots stay on it.
            on_face = np.where(off == 0.0, np.nan, dataset.markers.rest - true)
            distance = 1e3 * float(np.sqrt(np.nanmean(on_face**2)))
            difference = f"{100 * (modulus / reference - 1):+.2f} %"
            table.add_row(str(seed), name, f"{distance:.3f}", f"{1e-3 * modulus:.2f}", difference)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
