"""Help and refusals of wrong arguments answer without importing heavy packages; options agree with the library."""

import subprocess
import sys
from pathlib import Path

import pytest

from rafl import cli
from rafl.capture import cli as capture_cli
from rafl.capture.rendering.film import ENCODINGS
from rafl.common.units import METRES, Unit
from rafl.fitting.methods import METHODS
from rafl.simulation.time_integration import INTEGRATORS
from rafl.tracking import cli as tracking_cli
from rafl.tracking.reconstruction.export import WRITERS

HEAVY = {"cv2", "fastapi", "h5py", "matplotlib", "numba", "numpy", "pandas", "scipy", "sympy", "torch", "trimesh"}
PROGRAM = """
import sys
from importlib.metadata import entry_points
sys.argv = sys.argv[1:]
(script,) = entry_points(group="console_scripts", name=sys.argv[0])
try:
    script.load()()
finally:
    print("imported:", *sys.modules, file=sys.stderr)
"""

REFUSED = [
    ["rafl-render", "absent.yaml", "--out", "out"],
    ["rafl-calibrate", "absent"],
    ["rafl-calibrate", "absent", "--model", "fisheye"],
    ["rafl-track", "absent", "--calib", "absent.yaml"],
    ["rafl-track", "absent", "--calib", "absent.yaml", "--export", "xls"],
    ["rafl-track", ".", "--calib", ".", "--calib-unit", "feet"],
    ["rafl-specimen", "absent.h5", "--box", "100x30x30"],
    ["rafl-specimen", "absent.h5", "--box", "100x30"],
    ["rafl-specimen", "--stencil", "--surface", "absent.stl"],
    ["rafl-capture", "absent.yaml"],
    ["rafl-capture", "absent.yaml", "tracks", "--recordings", "absent.csv"],
    ["rafl-capture", "--verify", "absent.h5"],
    ["rafl-fit", "absent.h5"],
    ["rafl-fit", "absent.h5", "--method", "magic"],
    ["rafl-eval", "run"],
    ["rafl-eval", "run", "absent.h5"],
    ["rafl-fit", __file__, "--on", "local", "--cluster", "absent.yaml"],
    ["rafl-sweep", "absent.yaml"],
    ["rafl-sweep", "absent", "--status"],
    ["rafl-sweep", ".", "--on", "slurm"],
    ["rafl-review", "absent"],
    ["rafl-review", "absent.h5"],
    ["rafl-review", ".", "--videos", "absent"],
]
COMMANDS = sorted({line[0] for line in REFUSED})


def imported(line: list[str], folder: Path, code: int) -> set[str]:
    """The modules that a command has imported when it ends, with this exit code."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, *line], cwd=folder, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return set(done.stderr.rpartition("imported: ")[2].split())


@pytest.mark.parametrize("name", COMMANDS)
def test_help_imports_nothing_heavy(name: str, tmp_path: Path) -> None:
    assert not imported([name, "--help"], tmp_path, 0) & HEAVY


@pytest.mark.parametrize("line", REFUSED, ids=" ".join)
def test_refusal_imports_nothing_heavy(line: list[str], tmp_path: Path) -> None:
    assert not imported(line, tmp_path, 2) & HEAVY


def test_laws_of_the_package_need_no_sympy(tmp_path: Path) -> None:
    """Their derivatives are in files, so a simulation starts without it."""
    program = "import sys; import rafl; rafl.Material(law='yeoh'); print('sympy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_options_name_what_the_library_has() -> None:
    assert tuple(METHODS) == cli.METHODS
    assert tuple(INTEGRATORS) == cli.INTEGRATORS
    assert tuple(WRITERS) == tracking_cli.EXPORT_FORMATS
    assert set(Unit) <= set(METRES)
    assert {codec.value for codec in capture_cli.Codec} == set(ENCODINGS)
