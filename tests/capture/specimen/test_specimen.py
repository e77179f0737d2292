from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from rafl.capture.specimen.specimen import read_specimen
from rafl.common.errors import InputError


@pytest.mark.parametrize("path", sorted((ROOT / "datasets" / "specimens").glob("*.yaml")), ids=lambda p: p.stem)
def test_all_shipped_specimens_can_be_read(path: Path) -> None:
    specimen = read_specimen(path)
    assert specimen.name == path.stem
    assert specimen.mesh.volumes.min() > 0
    assert len(specimen.fixed) >= 4
    assert specimen.markers(8e-3).weights.sum(axis=1) == pytest.approx(np.ones(len(specimen.layout.names)))


def test_the_canonical_beam_matches_the_paper() -> None:
    specimen = read_specimen(ROOT / "datasets" / "specimens" / "canonical.yaml")
    assert specimen.mesh.vertices.shape == (176, 3)
    assert specimen.mesh.hexes.shape == (90, 8)
    assert len(specimen.fixed) == len(specimen.loaded) == 16
    sides = specimen.layout.positions[:, 1]
    assert (sides == 0.0).sum() == (sides == 0.03).sum() == 16


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("rafl-specimen/1", "rafl-specimen/2", "newer"),
        ("element_mm: 10", "element_mm: 7", "whole multiples"),
        ("poissons_ratio: 0.4", "poissons_ratio: 0.5", "poissons_ratio"),
        ("face: x-min", "face: left", "clamp.face"),
        ("name: La0", "name: Lb0", "more than once"),
        ("mass: lumped", "mass: heavy", "material.mass"),
        ("mass: lumped", "preset: fancy", "material.preset"),
        ("mass: lumped", "law: jelly", "material.law: .* one of projective, .*yeoh.*, found 'jelly'"),
        ("mass: lumped", "viscosity: -1", "material.viscosity"),
        ("clamp:", "simulation: {substeps: 0}\nclamp:", "simulation.substeps"),
    ],
)
def test_errors_name_the_invalid_key(specimen_file: Path, old: str, new: str, part: str) -> None:
    text = specimen_file.read_text()
    assert old in text
    specimen_file.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=part):
        read_specimen(specimen_file)


@pytest.mark.parametrize(
    ("options", "law", "mass"),
    [
        ("", "corotated", "lumped"),
        (", preset: paper", "projective", "uniform"),
        (", preset: paper, mass: lumped", "projective", "lumped"),
        (", law: neo-hookean", "neo-hookean", "lumped"),
        (", law: mooney-rivlin", "mooney-rivlin", "lumped"),
    ],
)
def test_explicit_options_override_the_preset(specimen_file: Path, options: str, law: str, mass: str) -> None:
    text = specimen_file.read_text().replace(", mass: lumped", f"{options}, viscosity: 30")
    specimen_file.write_text(text.replace("clamp:", "simulation: {integrator: generalised-alpha, substeps: 2}\nclamp:"))
    specimen = read_specimen(specimen_file)
    assert (specimen.material.law, specimen.material.mass, specimen.material.viscosity) == (law, mass, 30.0)
    simulator = specimen.simulator(0.01)
    assert (simulator.integrator, simulator.substeps) == ("generalised-alpha", 2)


def test_a_marker_off_the_surface_is_refused_and_named(specimen_file: Path) -> None:
    specimen_file.write_text(specimen_file.read_text().replace("at_mm: [28, 0, 13]", "at_mm: [28, -3, 13]"))
    with pytest.raises(InputError, match=r"marker La2 .* 3.00 mm off the surface, expected at most 2 mm"):
        read_specimen(specimen_file).markers(2e-3)
