"""Trajectories, gradients and forces of the paper's own simulator."""

import importlib.util
import sys
from pathlib import Path

import pytest
from support import SHARED

FOLDER = SHARED / "reference"
pytestmark = [
    pytest.mark.reference,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"reference data absent at {FOLDER}"),
]

_spec = importlib.util.spec_from_file_location("reference_check", Path(__file__).with_name("check.py"))
assert _spec is not None
assert _spec.loader is not None
check = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = check  # dataclasses look their module up
_spec.loader.exec_module(check)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.npz")) if FOLDER.is_dir() else [], ids=lambda path: path.stem)
def test_every_quantity_of_every_file(path: Path) -> None:
    found = check.deviations(path)
    assert found, f"{path.name} is no reference of a known kind"
    for item in found:
        assert item.passed, f"{item.what}: {item.value:.2e} {item.unit}, limit {item.limit:.0e}"
