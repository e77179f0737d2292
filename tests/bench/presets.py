"""Presets of the untouched simulator beside the real beam, before and after identifying E, nu and viscosity.

    python tests/bench/presets.py ../shared/real/clamped_beam --out build/presets

Prints frequency, damping ratio and static drop of the tip, and the marker error, recorded and simulated.
What stands under --out is not computed again.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from rafl.capture.dataset.build import CaptureSettings, build_dataset
from rafl.capture.dataset.table import read_recording_rows
from rafl.capture.specimen.specimen import read_specimen
from scipy.optimize import curve_fit

from rafl.data.dataset import Dataset
from rafl.data.objective import Recordings, frame_errors
from rafl.fem.material import Material
from rafl.fitting.run_folder import Settings
from rafl.fitting.sysid import identify_material
from rafl.simulation.rollout import equilibrium

SPECIMENS = Path(__file__).parents[2] / "datasets" / "specimens"
REST = ("beam_gravity_V2_b", 65)  # the beam is held straight there

IDENTIFIED_FRAMES = 100  # leading frames that identification looks at

CHOICES = [
    ("paper", "implicit-euler", 1, {"law": "projective", "mass": "uniform"}),
    ("paper", "generalised-alpha", 1, {"law": "projective", "mass": "uniform"}),
    ("projective, lumped", "implicit-euler", 1, {"law": "projective", "mass": "lumped"}),
    ("physical", "implicit-euler", 1, {"law": "corotated", "mass": "lumped"}),
    ("physical", "implicit-euler", 4, {"law": "corotated", "mass": "lumped"}),
    ("physical", "generalised-alpha", 1, {"law": "corotated", "mass": "lumped"}),
    ("physical, selective", "generalised-alpha", 1, {"law": "corotated", "mass": "lumped", "integration": "selective"}),
    ("neo-Hookean, lumped", "generalised-alpha", 1, {"law": "neo-hookean", "mass": "lumped"}),
]


def swing(time: np.ndarray, z: np.ndarray) -> tuple[float, float]:
    """Frequency [Hz] and damping ratio of the tip: the best c + a e^(-d t) cos(w t + p)."""

    def model(t: np.ndarray, c: float, a: float, d: float, w: float, p: float) -> np.ndarray:
        return c + a * np.exp(-d * t) * np.cos(w * t + p)

    gap = z - z[len(z) // 2 :].mean()
    padded = np.abs(np.fft.rfft(gap, 16 * len(gap)))
    guess = 2 * np.pi * np.argmax(padded) / (16 * len(gap)) / (time[1] - time[0])
    best = min(
        (curve_fit(model, time, z, (z[-1], np.ptp(z) / 2, d, guess, 0.0), maxfev=20000)[0] for d in (1.0, 5.0, 15.0)),
        key=lambda found: ((model(time, *found) - z) ** 2).sum(),
    )
    _, _, decay, w, _ = best
    return abs(w) / (2 * np.pi), decay / np.hypot(decay, w)


def describe(dataset: Dataset, material: Material) -> list[dict[str, float | str]]:
    """Frequency, damping, drop and error of every recording."""
    simulator = replace(dataset.simulator, material=material)
    names = list(dataset.trajectories)
    recordings = Recordings.of(replace(dataset, simulator=simulator), names)
    with torch.no_grad():
        markers, _ = recordings.simulate()
        still = equilibrium(simulator, dataset.start(names).force)
        settled = dataset.markers.positions(still)[..., 2].mean(-1).numpy()
    straight = dataset.markers.rest[:, 2].mean()
    errors = frame_errors(recordings, markers)
    rows = []
    for b, name in enumerate(names):
        item = dataset.trajectories[name]
        frames = len(item.time)
        time, recorded = item.time - item.time[0], item.markers[..., 2].mean(-1)
        # The first moments hold higher modes.
        frequency, damping = swing(time[5:], markers[5:frames, b, :, 2].mean(-1).numpy())
        true_frequency, true_damping = swing(time[5:], recorded[5:])
        rows.append(
            {
                "recording": name,
                "recorded Hz": true_frequency,
                "Hz": frequency,
                "recorded damping": true_damping,
                "damping": damping,
                "recorded drop mm": 1e3 * (straight - recorded[-40:].mean()),
                "drop mm": 1e3 * (straight - settled[b]),
                "error mm": 1e3 * errors[b].mean(),
            }
        )
    return rows


def identified(dataset: Dataset, run: Path) -> Material:
    """E, nu and viscosity that explain all recordings best."""
    items = {name: replace(item, split="train") for name, item in dataset.trajectories.items()}
    settings = Settings("sysid-damping", (dataset.name,), 25, 1e-3, 0.0, 25, IDENTIFIED_FRAMES, 0)
    model = identify_material([replace(dataset, trajectories=items)], settings, run, lambda row: None)
    values: dict[str, Any] = dict(model.material or {})
    return replace(dataset.simulator.material, **values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    described = read_specimen(SPECIMENS / "clamped_beam.yaml")
    rows = read_recording_rows(SPECIMENS / "clamped_beam_recordings.csv")
    settings = CaptureSettings(8e-3, 3e-3, 100.0, REST, True)
    tables = []
    for number, (name, integrator, substeps, values) in enumerate(CHOICES):
        path = arguments.out / f"{number}.csv"
        if not path.exists():
            plain = Material(described.material.youngs_modulus, described.material.poissons_ratio, **values)
            specimen = replace(described, material=plain, integrator=integrator, substeps=substeps)
            dataset = build_dataset(specimen, arguments.recordings, rows, settings, "", lambda: None)
            fitted = identified(dataset, arguments.out / str(number))
            found = []
            for stage, material in (("assumed", plain), ("identified", fitted)):
                note = (
                    f"{1e-3 * material.youngs_modulus:.1f} kPa, {material.poissons_ratio:.4f}, {material.viscosity:.1f}"
                )
                head = {"preset": name, "integrator": f"{integrator} x{substeps}", "stage": stage, "E, nu, Pa s": note}
                found += [head | row for row in describe(dataset, material)]
            pd.DataFrame(found).to_csv(path, index=False)
        tables.append(pd.read_csv(path))
        print(tables[-1].round(3).to_string(), flush=True)
    everything = pd.concat(tables)
    everything.to_csv(arguments.out / "presets.csv", index=False)
    keys = ["preset", "integrator", "stage", "E, nu, Pa s"]
    print(everything.groupby(keys, sort=False)["error mm"].mean().round(3).to_string())


if __name__ == "__main__":
    main()
