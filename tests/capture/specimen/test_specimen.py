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
        ("substeps: 1", "substeps: 0", "simulation.substeps"),
        ("face: x-min", "face: x-min, split: 1.0", "clamp.split"),
        ("face: x-min", "face: x-max", "expected the load on another face than the clamp, found both on x-max"),
        ("mass: lumped", "loss: {tan_delta: 0.1, from_hz: 50, to_hz: 5}", "material.loss: .*from_hz below to_hz"),
        ("mass: lumped", "branches: [{modulus_share: 0.1, time_s: 0}]", "material.branches.0.time_s"),
        (
            "mass: lumped",
            "branches: [{modulus_share: 0.1, time_s: 1}], loss: {tan_delta: 0.1, from_hz: 1, to_hz: 50}",
            "material: .*either branches or loss",
        ),
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
    specimen_file.write_text(text.replace("implicit-euler, substeps: 1", "generalised-alpha, substeps: 3"))
    specimen = read_specimen(specimen_file)
    assert (specimen.material.law, specimen.material.mass, specimen.material.viscosity) == (law, mass, 30.0)
    simulator = specimen.simulator(0.01)
    assert (simulator.integrator, simulator.substeps) == ("generalised-alpha", 3)


@pytest.mark.parametrize(
    ("preset", "integration", "integrator", "substeps", "layers"),
    [("physical", "enhanced", "generalised-alpha", 3, 8), ("paper", "full", "implicit-euler", 1, 7)],
)
def test_presets(
    specimen_file: Path, preset: str, integration: str, integrator: str, substeps: int, layers: int
) -> None:
    """Preset physical cuts the first cell at the clamp in two, so that there is one more layer of nodes."""
    text = specimen_file.read_text().replace("simulation: {integrator: implicit-euler, substeps: 1}\n", "")
    specimen_file.write_text(text.replace("mass: lumped, integration: full", f"preset: {preset}"))
    specimen = read_specimen(specimen_file)
    assert (specimen.material.integration, specimen.integrator, specimen.substeps) == (
        integration,
        integrator,
        substeps,
    )
    along = np.unique(np.round(specimen.mesh.vertices[:, 0], 9))
    assert len(along) == layers
    assert along[1] == pytest.approx(0.003 if layers == 8 else 0.01)


def test_loss_becomes_branches(specimen_file: Path) -> None:
    """A constant loss factor between two frequencies, and branches that are given one by one."""
    text = specimen_file.read_text()
    specimen_file.write_text(text.replace("mass: lumped", "loss: {tan_delta: 0.1, from_hz: 0.5, to_hz: 50}"))
    material = read_specimen(specimen_file).material
    assert len(material.branch_times) == len(material.branch_shares) == 3
    specimen_file.write_text(text.replace("mass: lumped", "branches: [{modulus_share: 0.1, time_s: 0.02}]"))
    material = read_specimen(specimen_file).material
    assert (material.branch_shares, material.branch_times) == ((0.1,), (0.02,))


def test_a_marker_off_the_surface_is_refused_and_named(specimen_file: Path) -> None:
    specimen_file.write_text(specimen_file.read_text().replace("at_mm: [28, 0, 13]", "at_mm: [28, -3, 13]"))
    with pytest.raises(InputError, match=r"marker La2 .* 3.00 mm off the surface, expected at most 2 mm"):
        read_specimen(specimen_file).markers(2e-3)


@pytest.mark.parametrize(("right", "wrong"), [("poissons_ratio: 0.45", "poissons_ratio: 0,45"), ("[10, ", "[10,5, ")])
def test_a_decimal_comma_is_named(right: str, wrong: str, tmp_path: Path) -> None:
    text = (ROOT / "datasets/specimens/canonical.yaml").read_text()
    assert right in text
    path = tmp_path / "canonical.yaml"
    path.write_text(text.replace(right, wrong, 1))
    with pytest.raises(InputError, match="if a comma is a decimal sign, write a point"):
        read_specimen(path)
