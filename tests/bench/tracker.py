"""Tracking and calibration benchmark on newly rendered videos, compared with trackpy and OpenCV's blob detector.

    python tests/bench/tracker.py [--seed N] [--only localisation,linking,...] [--quick] [--out FILE.csv]

The true positions are known to 1e-4 px. Every row gives the value measured and the target.
"""

import argparse
import csv
import logging
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import trackpy
from following import (
    measure_gap_filling,
    measure_late_markers,
    measure_linking,
    measure_occlusion,
    measure_speed,
)
from footage import Measurement
from geometry import measure_calibration, measure_reconstruction
from localisation import measure_localisation
from rich.console import Console
from rich.markup import escape
from threadpoolctl import threadpool_limits

from rafl.common.command_line import create_table
from rafl.tracking.commands import THREAD_SWITCH_S

warnings.filterwarnings("ignore")
logging.getLogger("trackpy").setLevel(logging.ERROR)
trackpy.quiet()

SECTIONS: dict[str, Callable[..., Iterator[Measurement]]] = {
    "localisation": measure_localisation,
    "linking": measure_linking,
    "hiding": measure_occlusion,
    "filling": measure_gap_filling,
    "speed": measure_speed,
    "calibrating": measure_calibration,
    "reconstructing": measure_reconstruction,
    "late": measure_late_markers,
}
TITLES = {
    "hiding": "occlusion",
    "late": "late-detected markers",
    "filling": "gap filling",
    "calibrating": "calibration",
    "reconstructing": "reconstruction",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of the random videos and rigs [the time]")
    parser.add_argument("--only", default=",".join(SECTIONS), help=f"sections to run, of {', '.join(SECTIONS)}")
    parser.add_argument("--quick", action="store_true", help="fewer recordings and rigs")
    parser.add_argument("--real", type=Path, help="folder of C3D recordings whose motions are rendered and tracked")
    parser.add_argument("--out", type=Path, default=Path("build/bench-tracking.csv"), help="file for the results")
    options = parser.parse_args()
    if unknown := set(options.only.split(",")) - set(SECTIONS):
        parser.error(f"expected --only of {', '.join(SECTIONS)}, found {', '.join(sorted(unknown))}")
    cv2.setNumThreads(1)  # as rafl-track does
    threadpool_limits(1, user_api="blas")
    sys.setswitchinterval(THREAD_SWITCH_S)
    print(f"seed {options.seed}")
    results: list[tuple[str, Measurement]] = []
    for section in options.only.split(","):
        random = np.random.default_rng([options.seed, list(SECTIONS).index(section)])
        arguments = {"real": options.real} if section == "reconstructing" else {}
        table = create_table("quantity", "case", "value", "target", title=TITLES.get(section, section))
        for item in SECTIONS[section](random, options.quick, **arguments):
            results.append((section, item))
            table.add_row(escape(item.quantity), item.case, f"{item.value:.4g}", item.target)
        Console(width=120).print(table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["section", "what", "case", "value", "asked"])
        for section, item in results:
            writer.writerow([section, item.quantity.strip(), item.case, f"{item.value:.6g}", item.target])
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
