"""Presets of the baseline simulator compared with the real beam, before and after identifying E, nu and viscosity.

    python tests/bench/presets.py ../shared/real/clamped_beam --out build/presets

Prints the frequency, damping ratio and static deflection of the tip, recorded and simulated, and the marker error.
Resumable: results under --out are not computed again.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.optimize import curve_fit

from rafl.capture.dataset.build import CaptureSettings, build_dataset
from rafl.capture.dataset.table import read_recording_rows
from rafl.capture.registration.registration import RestPose
from rafl.capture.specimen.specimen import read_specimen
from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, frame_errors
from rafl.fem.material import Material
from rafl.fitting.run_folder import Settings
from rafl.fitting.sysid import identify_material
from rafl.simulation.rollout import equilibrium

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
REST = RestPose("beam_gravity_V2_b", 65, 65)  # recording and frame in which the beam is held straight
IDENTIFICATION_FRAMES = 100  # leading frames that identification simulates

CONFIGURATIONS: list[tuple[str, str, int, dict[str, Any]]] = [  # name, integrator, substeps, material
    ("paper", "implicit-euler", 1, {"law": "projective", "mass": "uniform"}),
    ("paper", "generalised-alpha", 1, {"law": "projective", "mass": "uniform"}),
    ("projective, lumped", "implicit-euler", 1, {"law": "projective", "mass": "lumped"}),
    ("physical", "implicit-euler", 1, {"law": "corotated", "mass": "lumped"}),
    ("physical", "implicit-euler", 4, {"law": "corotated", "mass": "lumped"}),
    ("physical", "generalised-alpha", 1, {"law": "corotated", "mass": "lumped"}),
    ("physical, selective", "generalised-alpha", 1, {"law": "corotated", "mass": "lumped", "integration": "selective"}),
    ("neo-Hookean, lumped", "generalised-alpha", 1, {"law": "neo-hookean", "mass": "lumped"}),
]


def frequency_and_damping(time: np.ndarray, z: np.ndarray) -> tuple[float, float]:
    """Frequency [Hz] and damping ratio of the tip, from the least-squares fit of c + a e^(-d t) cos(w t + p)."""

    def model(t: np.ndarray, c: float, a: float, d: float, w: float, p: float) -> np.ndarray:
        return c + a * np.exp(-d * t) * np.cos(w * t + p)

    oscillation = z - z[len(z) // 2 :].mean()
    spectrum = np.abs(np.fft.rfft(oscillation, 16 * len(oscillation)))
    guess = 2 * np.pi * np.argmax(spectrum) / (16 * len(oscillation)) / (time[1] - time[0])
    best = min(
        (curve_fit(model, time, z, (z[-1], np.ptp(z) / 2, d, guess, 0.0), maxfev=20000)[0] for d in (1.0, 5.0, 15.0)),
        key=lambda fitted: ((model(time, *fitted) - z) ** 2).sum(),
    )
    _, _, decay, w, _ = best
    return abs(w) / (2 * np.pi), decay / np.hypot(decay, w)


def compare_with_recordings(dataset: Dataset, material: Material) -> list[dict[str, float | str]]:
    """Frequency, damping ratio, static deflection and marker error of every recording."""
    simulator = replace(dataset.simulator, material=material)
    names = list(dataset.trajectories)
    recordings = Recordings.of(replace(dataset, simulator=simulator), names)
    with torch.no_grad():
        markers, _ = recordings.simulate()
        at_rest = equilibrium(simulator, dataset.start(names).force)
        static_height = dataset.markers.positions(at_rest)[..., 2].mean(-1).numpy()
    straight_height = dataset.markers.rest[:, 2].mean()
    errors = frame_errors(recordings, markers)
    rows = []
    for b, name in enumerate(names):
        item = dataset.trajectories[name]
        frames = len(item.time)
        time, recorded = item.time - item.time[0], item.markers[..., 2].mean(-1)
        # The first five frames contain higher modes.
        frequency, damping = frequency_and_damping(time[5:], markers[5:frames, b, :, 2].mean(-1).numpy())
        recorded_frequency, recorded_damping = frequency_and_damping(time[5:], recorded[5:])
        rows.append(
            {
                "recording": name,
                "recorded Hz": recorded_frequency,
                "Hz": frequency,
                "recorded damping": recorded_damping,
                "damping": damping,
                "recorded drop mm": 1e3 * (straight_height - recorded[-40:].mean()),
                "drop mm": 1e3 * (straight_height - static_height[b]),
                "error mm": 1e3 * errors[b].mean(),
            }
        )
    return rows


def identify(dataset: Dataset, run: Path) -> Material:
    """The material whose E, nu and viscosity fit all recordings best."""
    items = {name: replace(item, split="train") for name, item in dataset.trajectories.items()}
    settings = Settings("sysid-damping", (dataset.name,), 25, 1e-3, 0.0, 25, IDENTIFICATION_FRAMES, 0)
    model = identify_material([replace(dataset, trajectories=items)], settings, run, lambda row: None)
    values: dict[str, Any] = dict(model.material or {})
    return replace(dataset.simulator.material, **values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder of the beam's recordings")
    parser.add_argument("--out", type=Path, required=True, help="folder for runs and results")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    described = read_specimen(SPECIMENS / "clamped_beam.yaml")
    rows = read_recording_rows(SPECIMENS / "clamped_beam_recordings.csv")
    settings = CaptureSettings(8e-3, 3e-3, 100.0, REST, True)
    tables = []
    for number, (name, integrator, substeps, values) in enumerate(CONFIGURATIONS):
        path = options.out / f"{number}.csv"
        if not path.exists():
            assumed = Material(described.material.youngs_modulus, described.material.poissons_ratio, **values)
            specimen = replace(described, material=assumed, integrator=integrator, substeps=substeps)
            dataset = build_dataset(specimen, options.recordings, rows, settings, "", lambda: None)
            identified = identify(dataset, options.out / str(number))
            results = []
            for stage, material in (("assumed", assumed), ("identified", identified)):
                parameters = (
                    f"{1e-3 * material.youngs_modulus:.1f} kPa, {material.poissons_ratio:.4f}, {material.viscosity:.1f}"
                )
                labels = {
                    "preset": name,
                    "integrator": f"{integrator} x{substeps}",
                    "stage": stage,
                    "E, nu, Pa s": parameters,
                }
                results += [labels | row for row in compare_with_recordings(dataset, material)]
            pd.DataFrame(results).to_csv(path, index=False)
        tables.append(pd.read_csv(path))
        print(tables[-1].round(3).to_string(), flush=True)
    table = pd.concat(tables)
    table.to_csv(options.out / "presets.csv", index=False)
    keys = ["preset", "integrator", "stage", "E, nu, Pa s"]
    print("mean marker error [mm]")
    print(table.groupby(keys, sort=False)["error mm"].mean().round(3).to_string())


if __name__ == "__main__":
    main()
