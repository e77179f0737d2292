"""Fixtures that several tests share: a small specimen, a random generator, a runner of commands."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from started import Started
from support import SMALL_SPECIMEN, Run

from rafl.capture.specimen.specimen import Specimen, read_specimen


def _delete_stale_kernels() -> None:
    """Delete compiled kernels that are older than a source file.

    numba compiles a function again if its own file changes, but not if a function changes that it calls.
    """
    for package in ("rafl", "tracking", "capture"):
        folder = Path(__file__).parents[1] / package
        newest = max(path.stat().st_mtime for path in folder.rglob("*.py"))
        for compiled in folder.rglob("*.nb[ic]"):
            with contextlib.suppress(FileNotFoundError):  # another worker has deleted it
                if compiled.stat().st_mtime < newest:
                    compiled.unlink()


_delete_stale_kernels()


def small_specimen_text() -> str:
    entries = [
        f"  - {{name: {side}{row}{column}, at_mm: [{x}, {y}, {z}]}}"
        for side, y in (("L", 0), ("R", 20))
        for row, z in (("a", 13), ("b", 7))
        for column, x in enumerate((8, 18, 28, 38, 52))
    ]
    return SMALL_SPECIMEN + "\n".join(entries) + "\n"


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
    """Run a command in a temporary folder and in its own process, a fork of a process that has the imports."""
    return lambda name, *arguments: Started(tmp_path, name, *arguments).result()


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(7)
