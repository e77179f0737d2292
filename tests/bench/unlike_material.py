"""First frames of a specimen whose material is not the assumed one: the markers and E against the truth.

    python tests/bench/unlike_material.py [--out build/unlike_material] [--seed 0]

The canonical beam is of a neo-Hookean rubber of 130 kPa on cells half as large. A weight hangs on it, exactly along
gravity, or by an angle off and beside the middle. It is described as a corotated body of 216 kPa. One camera, or two,
see the markers of the front to 0.02 px. Errors are root mean squares over the markers of the front and, which no camera
sees, of the back.
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from image_objective import RIGS, front_specimen, write_recordings
from rich.console import Console
from stand_in_lab import ASSUMED, describe

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.command_line import create_table
from rafl.simulation.simulator import Simulator

RUBBER = {"law": "neo-hookean", "youngs_modulus": 130e3, "poissons_ratio": 0.499, "density": 1070}
WEIGHTS = (0.03, 0.06)  # [kg]
OFF_GRAVITY, OFF_MIDDLE = 0.02, 2e-3  # [rad], [m]
STANDARD_GRAVITY = 9.81


def hung(specimen: Specimen, simulator: Simulator, mass: float, angle: float, aside: float) -> np.ndarray:
    """Node positions [m], (N, 3), under a mass [kg] that pulls at an angle to gravity [rad], beside the middle [m]."""
    force, nodes = simulator.weight.copy(), specimen.loaded
    pull = mass * STANDARD_GRAVITY
    force[nodes] += pull / len(nodes) * np.array([0.0, np.sin(angle), -np.cos(angle)])
    arms = simulator.mesh.vertices[nodes] - simulator.mesh.vertices[nodes].mean(axis=0)
    around = np.cross([1.0, 0.0, 0.0], arms)
    force[nodes] += pull * aside * around / (around**2).sum()
    return simulator.equilibrium(force[None], label="weight")[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/unlike_material"), help="for tracks")
    parser.add_argument("--seed", type=int, default=0, help="of the pixels' errors [0]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    fine = read_specimen(describe(options.out / "fine.yaml", "canonical", 2, RUBBER, {}))
    coarse = read_specimen(describe(options.out / "coarse.yaml", "canonical", 1, ASSUMED, {}))
    front = front_specimen().layout
    seen = np.isin(coarse.layout.names, front.names)
    simulator, true, described = fine.simulator(0.01), fine.markers(1e-6), coarse.markers(1e-6)
    table = create_table(
        "weight [g]", "hangs", "cameras", "image [mm]", "depth [mm]", "back [mm]", "sigma [mm]", "loaded by"
    )
    for mass in WEIGHTS:
        for hangs, angle, aside in (("along gravity", 0.0, 0.0), ("off", OFF_GRAVITY, OFF_MIDDLE)):
            q = hung(fine, simulator, mass, angle, aside)
            exact = true.positions(torch.from_numpy(q)).numpy()
            for rig, cameras in RIGS.items():
                folder = options.out / f"{mass} {hangs} {rig}".replace(" ", "-")
                shutil.rmtree(folder, ignore_errors=True)
                still = np.repeat(q[None, None], 2, axis=1).repeat(8, axis=0)
                own = replace(fine, layout=front)
                rows = write_recordings(folder, own, still, dict(cameras), True, options.seed)[1:]
                settings = CaptureSettings(start=0, initial="rest", fit_tolerance=2e-2)
                dataset = build_dataset(replace(coarse, layout=front), folder, rows, settings, "", lambda: None)
                item = dataset.trajectories["b"]
                error = 1e3 * (described.positions(torch.from_numpy(item.q)).numpy() - exact)
                image, depth = (np.sqrt((error[seen][:, k] ** 2).sum(-1).mean()) for k in ([0, 2], [1]))
                back = np.sqrt((error[~seen] ** 2).sum(-1).mean())
                sigma = np.nanmax(np.asarray(item.attributes["fit_sigma_mm"]))
                values = (f"{value:.3f}" for value in (image, depth, back, sigma))
                table.add_row(f"{1e3 * mass:.0f}", hangs, rig, *values, str(item.attributes["loading"]))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
