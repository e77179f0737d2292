"""Fit of the first frame of the canonical beam: the direct fit compared with the sequence of forces of earlier work.

    python tests/bench/first_frame.py [--iterations 300]

The markers are those of the beam under a load at the tip, with noise of 5 micrometres.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.initial import fit_first_frame
from rafl.capture.registration.sequence import ITERATIONS, fit_by_sequence
from rafl.capture.specimen.specimen import read_specimen
from rafl.common.command_line import create_table
from rafl.data.synthetic import loaded_equilibria

CANONICAL = Path(__file__).parents[2] / "datasets" / "specimens" / "canonical.yaml"
NOISE_SIGMA = 5e-6  # of the markers [m]
LOADS_KG = (0.05, 0.12, 0.22)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="Adam iterations of the sequence of forces")
    options = parser.parse_args()
    torch.set_num_threads(1)
    specimen, random = read_specimen(CANONICAL), np.random.default_rng(0)
    simulator, markers = specimen.simulator(0.01), specimen.markers(1e-6)
    table = create_table(
        "load [g]",
        "method",
        "time [s]",
        "marker residual / sigma",
        "largest vertex error [mm]",
        title="fit of the first frame",
    )
    seconds: dict[str, list[float]] = {"direct": [], "sequence": []}
    for number, load in enumerate((LOADS_KG[0], *LOADS_KG)):  # the first round compiles the kernels
        truth = loaded_equilibria(simulator, specimen.loaded, np.array([load]))[0]
        exact = markers.positions(torch.from_numpy(truth)).numpy()
        sigma = np.full_like(exact, NOISE_SIGMA)
        observed = exact + random.normal(0, NOISE_SIGMA, exact.shape)
        frame = FirstFrame(simulator, markers, specimen.loaded, observed, sigma, "")
        methods = {"direct": fit_first_frame, "sequence": lambda frame: fit_by_sequence(frame, options.iterations)}
        for method, fit in methods.items():
            if method == "sequence" and number != 1:
                continue  # takes minutes: one load is enough
            start = time.perf_counter()
            state = fit(frame)
            duration = time.perf_counter() - start
            if number > 0:
                seconds[method].append(duration)
                vertex_error = 1e3 * np.linalg.norm(state.q - truth, axis=1).max()
                relative = state.residual / np.sqrt(3.0) / NOISE_SIGMA
                table.add_row(f"{1e3 * load:.0f}", method, f"{duration:.2f}", f"{relative:.2f}", f"{vertex_error:.3f}")
    Console(width=100).print(table)
    ratio = np.mean(seconds["sequence"]) / np.mean(seconds["direct"])
    print(f"the direct fit is {ratio:.0f} times as fast")


if __name__ == "__main__":
    main()
