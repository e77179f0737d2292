"""First frames of specimens whose material is not the assumed one: errors of the markers, and their sigmas.

    python tests/bench/unlike_material.py [--out build/unlike_material] [--seed 0]

Beams of three materials of 130 kPa and of three shapes, on cells half as large. A weight hangs on them, exactly along
gravity, or by an angle off and beside the middle. They are described as corotated bodies of 216 kPa. One camera, or
two, see the markers of the front to 0.02 px. Errors are root mean squares over the markers of the front and, which no
camera sees, of the back. Errors over sigma are those of the front: one, on average, where the sigmas are right.
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from image_objective import RIGS, front_layout, write_recordings
from rich.console import Console
from rich.table import Table
from stand_in_lab import ASSUMED, describe

from rafl.capture.dataset.build import build_dataset
from rafl.capture.dataset.settings import CaptureSettings
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.common.command_line import create_table
from rafl.simulation.simulator import Simulator

RUBBER = {"youngs_modulus": 130e3, "poissons_ratio": 0.499, "density": 1070}
SPECIMENS = (  # shapes and laws
    ("canonical", "neo-hookean"),
    ("canonical", "mooney-rivlin"),
    ("canonical", "corotated"),
    ("thicker", "neo-hookean"),
    ("shorter", "neo-hookean"),
)
WEIGHTS = (0.03, 0.06)  # [kg]
HANGING = {"along gravity": (0.0, 0.0), "off": (0.02, 2e-3)}  # angle to gravity [rad], distance from the middle [m]
STANDARD_GRAVITY = 9.81
FIT_TOLERANCE = 2e-2  # [m]; no fit is refused


def hung(specimen: Specimen, simulator: Simulator, mass: float, angle: float, aside: float) -> np.ndarray:
    """Node positions [m], (N, 3), under a mass [kg] that pulls at an angle to gravity [rad], beside the middle [m]."""
    force, nodes = simulator.weight.copy(), specimen.loaded
    pull = mass * STANDARD_GRAVITY
    force[nodes] += pull / len(nodes) * np.array([0.0, np.sin(angle), -np.cos(angle)])
    arms = simulator.mesh.vertices[nodes] - simulator.mesh.vertices[nodes].mean(axis=0)
    around = np.cross([1.0, 0.0, 0.0], arms)
    force[nodes] += pull * aside * around / (around**2).sum()
    return simulator.equilibrium(force[None], label="weight")[0]


def compare(shape: str, law: str, out: Path, seed: int, table: Table) -> dict[str, list[float]]:
    """Add a specimen's rows to a table.

    Returns:
        Root mean square errors over sigma, by the rig.
    """
    fine = read_specimen(describe(out / f"{shape}-{law}.yaml", shape, 2, {"law": law, **RUBBER}, {}))
    coarse = read_specimen(describe(out / f"{shape}.yaml", shape, 1, ASSUMED, {}))
    front = front_layout(coarse)
    seen = np.isin(coarse.layout.names, front.names)
    simulator, true, described = fine.simulator(0.01), fine.markers(1e-6), coarse.markers(1e-6)
    ratios: dict[str, list[float]] = {rig: [] for rig in RIGS}
    for mass in WEIGHTS:
        for hangs, (angle, aside) in HANGING.items():
            q = hung(fine, simulator, mass, angle, aside)
            exact = true.positions(torch.from_numpy(q)).numpy()
            for rig, cameras in RIGS.items():
                folder = out / f"{shape} {law} {mass} {hangs} {rig}".replace(" ", "-")
                shutil.rmtree(folder, ignore_errors=True)
                still = np.repeat(q[None, None], 2, axis=1).repeat(8, axis=0)
                rows = write_recordings(folder, replace(fine, layout=front), still, dict(cameras), True, seed)[1:]
                settings = CaptureSettings(start=0, initial="rest", fit_tolerance=FIT_TOLERANCE)
                dataset = build_dataset(replace(coarse, layout=front), folder, rows, settings, "", lambda: None)
                item = dataset.trajectories["b"]
                error = 1e3 * (described.positions(torch.from_numpy(item.q)).numpy() - exact)
                image, depth = (np.sqrt((error[seen][:, k] ** 2).sum(-1).mean()) for k in ([0, 2], [1]))
                back = np.sqrt((error[~seen] ** 2).sum(-1).mean())
                sigma = np.asarray(item.attributes["fit_sigma_mm"])
                ratio = np.sqrt(((error[seen] ** 2).sum(-1) / sigma**2).mean())
                ratios[rig].append(ratio)
                values = (f"{value:.3f}" for value in (image, depth, back, sigma.max()))
                specimen = (shape, law, f"{1e3 * mass:.0f}", hangs, rig)
                table.add_row(*specimen, *values, f"{ratio:.2f}", str(item.attributes["loading"]))
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/unlike_material"), help="for tracks")
    parser.add_argument("--seed", type=int, default=0, help="of the pixels' errors [0]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    errors = ("image [mm]", "depth [mm]", "back [mm]", "sigma [mm]", "over sigma")
    table = create_table("shape", "law", "weight [g]", "hangs", "cameras", *errors, "loaded by")
    compared = [compare(*specimen, options.out, options.seed, table) for specimen in SPECIMENS]
    Console(width=160).print(table)
    for rig in RIGS:
        ratios = np.concatenate([item[rig] for item in compared])
        mean = np.exp(np.log(ratios).mean())
        print(f"{rig}: error over sigma {mean:.2f} (geometric mean of {len(ratios)}), at most {ratios.max():.2f}")


if __name__ == "__main__":
    main()
