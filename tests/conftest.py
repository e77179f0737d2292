"""Specimens, datasets and recordings that several tests start from."""

import contextlib
import multiprocessing
import subprocess
import tempfile
from multiprocessing.reduction import DupFd
from pathlib import Path

import numpy as np
import pytest
from rafl.capture.specimen.specimen import Specimen, read_specimen
from support import Run, enter_command


def _forget_stale_kernels() -> None:
    """numba renews a compiled function when its own file changes, not when one that it calls does."""
    for package in ("rafl", "tracking", "capture"):
        folder = Path(__file__).parents[1] / package
        newest = max(path.stat().st_mtime for path in folder.rglob("*.py"))
        for compiled in folder.rglob("*.nb[ic]"):
            with contextlib.suppress(FileNotFoundError):  # another worker was first
                if compiled.stat().st_mtime < newest:
                    compiled.unlink()


_forget_stale_kernels()

# Imports what commands need once; each of them is a fork of that.
COMMANDS = multiprocessing.get_context("forkserver")
COMMANDS.set_forkserver_preload(["support", "rafl.capture.commands", "rafl.commands", "rafl.tracking.commands"])

SMALL = """format: rafl-specimen/1
name: small
geometry: {box_mm: [60, 20, 20], element_mm: 10}
material: {youngs_modulus: 150000, poissons_ratio: 0.4, density: 1070, mass: lumped}
clamp: {face: x-min}
markers:
"""


def small_specimen_text() -> str:
    entries = [
        f"  - {{name: {side}{row}{column}, at_mm: [{x}, {y}, {z}]}}"
        for side, y in (("L", 0), ("R", 20))
        for row, z in (("a", 13), ("b", 7))
        for column, x in enumerate((8, 18, 28, 38, 52))
    ]
    return SMALL + "\n".join(entries) + "\n"


@pytest.fixture
def specimen_file(tmp_path: Path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(small_specimen_text())
    return path


@pytest.fixture(scope="session")
def small_specimen(tmp_path_factory: pytest.TempPathFactory) -> Specimen:
    path = tmp_path_factory.mktemp("specimen") / "small.yaml"
    path.write_text(small_specimen_text())
    return read_specimen(path)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run a command in a temporary folder and a process of its own, as a stranger would, imports made before."""

    def command(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        line = [name, *map(str, arguments)]
        with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            child = COMMANDS.Process(
                target=enter_command, args=(line, tmp_path, DupFd(out.fileno()), DupFd(err.fileno()))
            )
            child.start()
            child.join(600)
            if child.exitcode is None:
                child.kill()
                pytest.fail(f"{line} did not end")
            out.seek(0)
            err.seek(0)
            return subprocess.CompletedProcess(line, child.exitcode, out.read(), err.read())

    return command


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(7)
