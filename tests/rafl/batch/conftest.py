"""A folder of units, and small units for it."""

import sys
from pathlib import Path

import pytest
from counted import PROGRAM, Make

from rafl.batch.state import Book
from rafl.batch.unit import Unit, create_unit


@pytest.fixture
def book(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Book:
    monkeypatch.chdir(tmp_path)
    return Book(tmp_path / "units", tmp_path)


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Makes a unit of a name, what it does, and the names of units that it needs."""

    def unit(name: str, action: str = "", needs: tuple[str, ...] = ()) -> Unit:
        command = (sys.executable, "-c", PROGRAM, str(tmp_path), name, action)
        return create_unit(name, command, [f"{name}.out"], [f"{other}.out" for other in needs])

    return unit
