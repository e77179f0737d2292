"""Reader of C3D files, in a process of its own: the library ends the process on some damaged files, or never ends.

python -m rafl.capture.dataset.c3d FILE.c3d CONTENT.npz
"""

import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import InputError
from rafl.tracking.reconstruction.export import check_c3d_length

Array = NDArray[Any]

TIMEOUT = 120.0  # [s]
MAX_MEMORY_BYTES, MEMORY_PER_BYTE = 2_000_000_000, 40  # for the library, and for each byte of the file


@dataclass(frozen=True)
class C3dContent:
    """Content of a C3D file.

    Attributes:
        names: of the points, (M).
        unit: of the points.
        rate: [1/s].
        points: (T, M, 3).
        residuals: negative where a point is missing, (T, M).
        exported: whether `rafl-track` wrote the file.
    """

    names: tuple[str, ...]
    unit: str
    rate: float
    points: Array
    residuals: Array
    exported: bool


def read_c3d(path: Path) -> C3dContent:
    """Read a C3D file.

    Raises:
        InputError: the file is cut short or damaged.
    """
    check_c3d_length(path)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "content.npz"
        command = [sys.executable, "-m", "rafl.capture.dataset.c3d", str(path), str(out)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(f"expected a C3D file in {path}, which is damaged; export it again") from None
        if done.returncode or not out.exists():
            reason = (done.stderr.strip().splitlines() or ["its parts contradict one another"])[-1]
            raise InputError(f"expected a C3D file in {path}, which cannot be read: {reason}; export it again")
        with np.load(out, allow_pickle=False) as content:
            names = tuple(str(name) for name in content["names"])
            points, residuals = content["points"], content["residuals"]
            unit, rate, exported = str(content["unit"]), float(content["rate"]), bool(content["exported"])
    if not names:
        raise InputError(f"{path}: expected the names of the points (POINT:LABELS), found none; export it again")
    if not (len(names) == points.shape[1] == residuals.shape[1] and len(points) == len(residuals)):
        raise InputError(
            f"{path}: expected as many points as names, found {points.shape[1]} and {len(names)}; export it again"
        )
    if not (np.isfinite(rate) and rate > 0.0):
        raise InputError(f"{path}: expected a frame rate above 0, found {rate:g}; export it again")
    return C3dContent(names, unit, rate, points, residuals, exported)


def _extract(source: Path, out: Path) -> None:
    """Read a file by the library and write what is needed of it as arrays."""
    import ezc3d

    limit = MAX_MEMORY_BYTES + MEMORY_PER_BYTE * source.stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    file = ezc3d.c3d(str(source))
    group = file["parameters"]["POINT"]
    # A list of labels holds 255; more markers are in LABELS2, LABELS3 and so on.
    keys = ["LABELS", *(key for number in range(2, len(group) + 2) if (key := f"LABELS{number}") in group)]
    names = [str(name) for key in keys for name in group[key]["value"]]
    unit = str(group["UNITS"]["value"][0]).strip() if group["UNITS"]["value"] else "mm"
    count = len(names)
    np.savez(
        out,
        names=np.array(names, dtype=str),
        unit=unit,
        rate=float(group["RATE"]["value"][0]),
        points=np.asarray(file["data"]["points"], dtype=float)[:3, :count].transpose(2, 1, 0),
        residuals=np.asarray(file["data"]["meta_points"]["residuals"], dtype=float)[0, :count].T,
        exported="RAFL" in file["parameters"],
    )


if __name__ == "__main__":
    _extract(Path(sys.argv[1]), Path(sys.argv[2]))
