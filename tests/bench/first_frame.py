"""The first frame of the canonical beam: the direct fit beside the sequence of forces of earlier work, in one run.

    python tests/bench/first_frame.py [--iterations 300]

Markers of the beam under a weight, with noise of 5 micrometres.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from rafl.capture.registration.initial import FirstFrame, fit_first_frame
from rafl.capture.registration.sequence import ITERATIONS, fit_by_sequence
from rafl.capture.specimen.specimen import read_specimen
from rich.console import Console
from rich.table import Table

from rafl.data.synthetic import hung

CANONICAL = Path(__file__).parents[2] / "datasets" / "specimens" / "canonical.yaml"
SIGMA = 5e-6
LOADS = (0.05, 0.12, 0.22)  # kg


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="of the sequence's optimiser")
    options = parser.parse_args()
    torch.set_num_threads(1)
    specimen, random = read_specimen(CANONICAL), np.random.default_rng(0)
    simulator, markers = specimen.simulator(0.01), specimen.markers(1e-6)
    table = Table("load [g]", "way", "seconds", "markers / sigma", "worst vertex [mm]", title="first frame")
    seconds: dict[str, list[float]] = {"direct": [], "sequence": []}
    for number, load in enumerate((LOADS[0], *LOADS)):  # the first is to compile the kernels
        truth = hung(simulator, specimen.loaded, np.array([load]))[0]
        exact = markers.positions(torch.from_numpy(truth)).numpy()
        sigma = np.full_like(exact, SIGMA)
        frame = FirstFrame(simulator, markers, specimen.loaded, exact + random.normal(0, SIGMA, exact.shape), sigma, "")
        ways = {"direct": fit_first_frame, "sequence": lambda it: fit_by_sequence(it, options.iterations)}
        for way, fit in ways.items():
            if way == "sequence" and number != 1:
                continue  # takes minutes: one load is enough
            begun = time.perf_counter()
            found = fit(frame)
            took = time.perf_counter() - begun
            if number > 0:
                seconds[way].append(took)
                off = 1e3 * np.linalg.norm(found.q - truth, axis=1).max()
                size = found.residual / np.sqrt(3.0) / SIGMA
                table.add_row(f"{1e3 * load:.0f}", way, f"{took:.2f}", f"{size:.2f}", f"{off:.3f}")
    Console(width=100).print(table)
    ratio = np.mean(seconds["sequence"]) / np.mean(seconds["direct"])
    print(f"the direct fit is {ratio:.0f} times as fast")


if __name__ == "__main__":
    main()
