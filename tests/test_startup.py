"""Help and refusals of wrong arguments answer without importing heavy packages; options agree with the library."""

import json
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
# Imports the modules of some scripts, then runs each command line in a fork. Prints the exit code and the imported
# modules of the imports alone, then of each line.
PROGRAM = """
import json, os, sys
from importlib.metadata import entry_points
names, lines = json.loads(sys.argv[1])
scripts = {script.name: script.load() for script in entry_points(group="console_scripts") if script.name in names}
output = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
print(json.dumps([0, *sys.modules]), file=output, flush=True)
for line in lines:
    child = os.fork()
    if not child:
        sys.argv, code = line, 0
        try:
            scripts[line[0]]()
        except SystemExit as end:
            code = end.code
        print(json.dumps([code, *sys.modules]), file=output, flush=True)
        os._exit(0)
    os.waitpid(child, 0)
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


Imported = dict[str, tuple[int, set[str]]]
HELP = [[name, "--help"] for name in COMMANDS]


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    """Exit code and imported modules at the end of every command line, and of the imports alone, with the key ""."""
    lines = [*HELP, *REFUSED]
    program = [sys.executable, "-c", PROGRAM, json.dumps([COMMANDS, lines])]
    folder = tmp_path_factory.mktemp("startup")
    done = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=True)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    names = ["", *(" ".join(line) for line in lines)]
    return {name: (code, set(modules)) for name, (code, *modules) in zip(names, found, strict=True)}


def test_modules_of_commands_import_nothing_heavy(imported: Imported) -> None:
    _, modules = imported[""]
    assert "rafl.capture.cli" in modules
    assert not modules & HEAVY


@pytest.mark.parametrize("line", HELP, ids=" ".join)
def test_help_imports_nothing_heavy(line: list[str], imported: Imported) -> None:
    code, modules = imported[" ".join(line)]
    assert code == 0
    assert not modules & HEAVY


@pytest.mark.parametrize("line", REFUSED, ids=" ".join)
def test_refusal_imports_nothing_heavy(line: list[str], imported: Imported) -> None:
    code, modules = imported[" ".join(line)]
    assert code == 2
    assert not modules & HEAVY


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
