"""Tracking and calibration measured on footage made fresh, beside trackpy and OpenCV's blob detector.

    python tests/bench/tracker.py [--seed N] [--only localisation,linking,...] [--quick] [--out FILE.csv]

Every row says what is asked and what was found; places are known to 1e-4 px.
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
from following import filling, hiding, linking, speed
from footage import Row
from geometry import calibrating, reconstructing
from localisation import localisation
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from threadpoolctl import threadpool_limits

from rafl.tracking.commands import THREAD_SWITCH_S

warnings.filterwarnings("ignore")
logging.getLogger("trackpy").setLevel(logging.ERROR)
trackpy.quiet()

SECTIONS: dict[str, Callable[..., Iterator[Row]]] = {
    "localisation": localisation,
    "linking": linking,
    "hiding": hiding,
    "filling": filling,
    "speed": speed,
    "calibrating": calibrating,
    "reconstructing": reconstructing,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--only", default=",".join(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="fewer recordings and rigs")
    parser.add_argument("--real", type=Path, help="folder of real C3D recordings to film again")
    parser.add_argument("--out", type=Path, default=Path("build/bench-tracking.csv"))
    options = parser.parse_args()
    if unknown := set(options.only.split(",")) - set(SECTIONS):
        parser.error(f"expected --only of {', '.join(SECTIONS)}, found {', '.join(sorted(unknown))}")
    cv2.setNumThreads(1)  # as the command does
    threadpool_limits(1, user_api="blas")
    sys.setswitchinterval(THREAD_SWITCH_S)
    print(f"seed {options.seed}")
    rows: list[tuple[str, Row]] = []
    for section in options.only.split(","):
        random = np.random.default_rng([options.seed, list(SECTIONS).index(section)])
        more = {"real": options.real} if section == "reconstructing" else {}
        table = Table("what", "case", "value", "asked", title=section)
        for row in SECTIONS[section](random, options.quick, **more):
            rows.append((section, row))
            table.add_row(escape(row.what), row.case, f"{row.value:.4g}", row.asked)
        Console(width=120).print(table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["section", "what", "case", "value", "asked"])
        writer.writerows([section, row.what.strip(), row.case, f"{row.value:.6g}", row.asked] for section, row in rows)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
