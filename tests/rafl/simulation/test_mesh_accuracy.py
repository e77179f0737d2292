"""The specimens' own meshes compared with converged solutions, which `make bench-mesh` computes."""

import importlib
from types import ModuleType

import pandas as pd
import pytest
from support import ROOT

REFERENCES = pd.read_csv(ROOT / "datasets" / "results" / "mesh-references.csv").set_index(["solid", "poissons_ratio"])
# Largest errors of sag and frequency [%] with three or more cells across, and with fewer.
FINE_BARS, COARSE_BARS = (3.0, 1.5), (4.0, 2.0)
BEAM_AGREEMENT, TAIL_AGREEMENT = 0.5, 1.0  # of the references [%]
POISSONS_RATIOS = (0.3, 0.45, 0.499)
NAMES = ("canonical", "thinner", "fishtail-crude")

by_name = pytest.mark.parametrize("name", NAMES)
by_ratio = pytest.mark.parametrize("nu", POISSONS_RATIOS)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tests" / "bench"))
    return importlib.import_module("mesh")


@by_name
@by_ratio
def test_physical_specimens_are_near_the_converged_solution(bench: ModuleType, name: str, nu: float) -> None:
    """Sag under the own weight, geometrically nonlinear, and first frequency."""
    shape = bench.Shape.of(name)
    bars = FINE_BARS if shape.cells_across >= 3 else COARSE_BARS
    found = bench.simulated_response(shape, 1, bench.CUT_SCHEME, nu)
    exact = REFERENCES.loc[(shape.solid, nu)]
    assert abs(100.0 * (found.sag_mm / exact.sag_mm - 1.0)) < bars[0]
    assert abs(100.0 * (found.frequency_hz / exact.frequency_hz - 1.0)) < bars[1]


@pytest.mark.parametrize("scheme", ["selective", "enhanced"])
def test_references_agree(scheme: str) -> None:
    """Quadratic mixed elements of another code, and the simulator extrapolated to infinitely fine meshes."""
    tails = REFERENCES.index.get_level_values("solid").str.startswith("fishtail")
    for key in ("sag_mm", "frequency_hz"):
        difference = 100.0 * (REFERENCES[f"{scheme}_{key}"] / REFERENCES[key] - 1.0).abs()
        assert difference[~tails].max() < BEAM_AGREEMENT
        assert difference[tails].max() < TAIL_AGREEMENT
