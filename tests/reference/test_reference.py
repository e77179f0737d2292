"""Comparison with trajectories, gradients and forces of the paper's simulator."""

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
sys.modules[_spec.name] = check  # dataclasses look up their module there
_spec.loader.exec_module(check)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.npz")) if FOLDER.is_dir() else [], ids=lambda path: path.stem)
def test_deviations_are_within_the_limits(path: Path) -> None:
    found = check.deviations(path)
    assert found, f"{path.name} is no reference file of a known kind"
    for item in found:
        assert item.passed, f"{item.quantity}: {item.value:.2e} {item.unit}, limit {item.limit:.0e}"
