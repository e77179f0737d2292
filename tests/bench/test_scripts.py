"""The benchmarks take hours; importing them shows that they match the interfaces that they measure."""

import importlib.util
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
SCRIPTS = [path for path in sorted(TESTS.glob("bench/*.py")) if path != Path(__file__)]


@pytest.mark.parametrize("path", [*SCRIPTS, TESTS / "reference" / "check.py"], ids=lambda path: path.stem)
def test_benchmark_can_be_imported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(path.parent))
    name = f"bench_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
