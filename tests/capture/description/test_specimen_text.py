"""Descriptions of bodies, and the text of specimen files."""

from pathlib import Path

import pytest
import trimesh
from support import ROOT

from rafl.capture.description.specimen_text import body_like, body_of_box, body_of_surface, specimen_text
from rafl.capture.specimen.specimen import read_specimen
from rafl.common.errors import InputError

REMARKS = {"": "a test", "clamp": "to check"}
MARKER = {"name": "L1", "at_mm": [10.0, 0.0, 10.5], "at_sigma_mm": 0.12}


def test_elements_are_near_ten_millimetres_and_two_across() -> None:
    assert body_of_box("a", (100.0, 30.0, 30.0), None).geometry.element_mm == 10.0
    assert body_of_box("a", (100.0, 15.0, 40.0), None).geometry.cells == (13, 2, 5)
    assert body_of_box("a", (100.0, 15.0, 40.0), 5.0).geometry.element_mm == 5.0
    with pytest.raises(InputError, match="the body is thin: choose --element-mm"):
        body_of_box("a", (100.0, 1.0, 40.0), None)


def test_a_written_file_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "beam.yaml"
    path.write_text(
        specimen_text(
            body_of_box("beam", (100.0, 30.0, 30.0), None).with_material(youngs_modulus=123456.0), [MARKER], REMARKS
        )
    )
    specimen = read_specimen(path)
    assert specimen.name == "beam"
    assert specimen.material.youngs_modulus == 123500.0
    assert specimen.layout.names == ("L1",)
    assert specimen.layout.sigma == pytest.approx(0.12e-3)
    assert "# to check\nclamp: {face: x-min}" in specimen.text


def test_a_body_like_another_keeps_all_but_name_and_markers(tmp_path: Path) -> None:
    canonical = ROOT / "datasets" / "specimens" / "canonical.yaml"
    path = tmp_path / "other.yaml"
    path.write_text(specimen_text(body_like("other", canonical, tmp_path), [MARKER], REMARKS))
    found, expected = read_specimen(path), read_specimen(canonical)
    assert found.material == expected.material
    assert (found.mesh.vertices == expected.mesh.vertices).all()
    assert found.integrator == expected.integrator


def test_a_surface_lies_in_the_folder_of_the_specimen(tmp_path: Path) -> None:
    (tmp_path / "shapes").mkdir()
    trimesh.creation.box((60.0, 20.0, 20.0)).export(tmp_path / "shapes" / "box.stl")
    body = body_of_surface("s", tmp_path / "shapes" / "box.stl", None, tmp_path)
    assert body.geometry.surface == "shapes/box.stl"
    assert body.geometry.element_mm == 5.0
    path = tmp_path / "s.yaml"
    path.write_text(specimen_text(body, [MARKER], REMARKS))
    assert read_specimen(path).volume == pytest.approx(24e-6)
    with pytest.raises(InputError, match="choose --element-mm"):
        body_of_surface("s", tmp_path / "shapes" / "box.stl", 0.5, tmp_path)
    with pytest.raises(
        InputError, match=r"box\.stl beside the specimen file, in .*out, found it elsewhere; copy it there"
    ):
        body_of_surface("s", tmp_path / "shapes" / "box.stl", None, tmp_path / "out")
