"""Hexahedral meshes of specimens of different shapes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from support import ROOT

from rafl.capture.specimen.geometry import Geometry, fill_surface, read_surface
from rafl.capture.specimen.specimen import read_specimen
from rafl.common.errors import InputError
from rafl.fem.mesh import HexMesh

SPECIMENS = ROOT / "datasets" / "specimens"
COUNTS = {  # vertices, elements, clamped, tip (paper)
    "canonical": (176, 90, 16, 16),
    "longer-scaled": (176, 90, 16, 16),
    "shorter-scaled": (176, 90, 16, 16),
    "thicker-scaled": (176, 90, 16, 16),
    "thinner-scaled": (176, 90, 16, 16),
    "longer": (208, 108, 16, 16),
    "shorter": (144, 72, 16, 16),
    "thicker": (275, 160, 25, 25),
    "thinner": (99, 40, 9, 9),
    "fishtail-crude": (154, 56, 20, 18),
    "fishtail-fine": (3074, 1938, 204, 68),
}


def saved(folder: Path, shape: trimesh.Trimesh, name: str = "shape.stl") -> Path:
    shape.export(folder / name)
    return folder / name


def box(size: tuple[float, float, float], corner: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    shape = trimesh.creation.box(size)
    shape.apply_translation(np.array(corner) + np.array(size) / 2)
    return shape


@pytest.mark.parametrize("name", COUNTS)
def test_shapes_match_the_paper(name: str) -> None:
    specimen = read_specimen(SPECIMENS / f"{name}.yaml")
    mesh = specimen.mesh
    assert (len(mesh.vertices), len(mesh.hexes), len(specimen.fixed), len(specimen.loaded)) == COUNTS[name]
    assert mesh.volumes.sum() == pytest.approx(specimen.volume)
    specimen.markers(1e-6)  # raises unless all markers are on the surface


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_filling_the_surface_of_a_box_gives_the_box_mesh(tmp_path: Path, suffix: str) -> None:
    solid = fill_surface(saved(tmp_path, box((100, 30, 30)), f"beam.{suffix}"), 0.01, "x-min")
    expected = HexMesh.box((10, 3, 3), (0.1, 0.03, 0.03))
    np.testing.assert_allclose(solid.mesh.vertices, expected.vertices, atol=1e-9)
    np.testing.assert_array_equal(solid.mesh.hexes, expected.hexes)
    assert solid.volume == pytest.approx(9e-5)


@pytest.mark.parametrize("shape", [{"box_mm": (90, 30, 30)}, {"rectangles": [(60, 60)] * 180}])
def test_more_elements_than_fit_into_memory_are_refused(shape: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"geometry: expected at most 200000 elements, found 648000; choose a larger"):
        Geometry(element_mm=0.5, **shape).build_solid(tmp_path, "x-min")


def test_filling_a_surface_keeps_its_position_and_volume(tmp_path: Path) -> None:
    """A shifted cylinder along x; its ends lie on cell faces, and finer elements come within 2 % of its volume."""
    shape = trimesh.creation.cylinder(15.0, 60.0, sections=96)
    shape.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], [1, 0, 0]))
    shape.apply_translation([40.0, -20.0, 7.0])
    path = saved(tmp_path, shape)
    gaps = []
    for element in (0.006, 0.003, 0.0015):
        mesh, volume = (solid := fill_surface(path, element, "x-max")).mesh, solid.volume
        assert volume == pytest.approx(np.pi * 0.015**2 * 0.06, rel=2e-3)
        np.testing.assert_allclose(mesh.vertices[:, 0].min(), 0.010, atol=1e-9)
        np.testing.assert_allclose(mesh.vertices[:, 0].max(), 0.070, atol=1e-9)
        np.testing.assert_allclose(mesh.vertices.mean(0)[1:], [-0.020, 0.007], atol=1e-9)  # symmetric
        radius = np.linalg.norm(mesh.vertices[mesh.hexes].mean(1)[:, 1:] - [-0.020, 0.007], axis=1)
        assert radius.max() < 0.015
        gaps.append(abs(mesh.volumes.sum() / volume - 1.0))
    assert gaps[-1] < 0.02


def test_cells_start_at_the_clamp(tmp_path: Path) -> None:
    """In 24 mm two cells of 10 mm have their centres inside; the remainder is at the free end."""
    path = saved(tmp_path, box((24, 20, 20)))
    for face, low in (("x-min", 0.0), ("x-max", 0.004)):
        mesh = fill_surface(path, 0.01, face).mesh
        assert mesh.vertices[:, 0].min() == pytest.approx(low, abs=1e-9)
        assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(0.02)


def test_an_inside_out_surface_is_repaired(tmp_path: Path) -> None:
    shape = box((30, 20, 20))
    shape.invert()
    assert len(fill_surface(saved(tmp_path, shape), 0.01, "x-min").mesh.hexes) == 12


def test_invalid_surfaces_are_refused(tmp_path: Path) -> None:
    open_shape = box((30, 20, 20))
    open_shape.update_faces(np.arange(len(open_shape.faces)) > 1)
    with pytest.raises(InputError, match=r"watertight.*found [45] of"):
        read_surface(saved(tmp_path, open_shape, "open.stl"))
    with pytest.raises(InputError, match=r"expected elements inside it.*100 mm"):
        fill_surface(saved(tmp_path, trimesh.creation.torus(30, 5), "ring.stl"), 0.1, "x-min")
    two = trimesh.util.concatenate([box((20, 20, 20)), box((20, 20, 20), (60, 0, 0))])
    with pytest.raises(InputError, match="expected one body, found 2"):
        fill_surface(saved(tmp_path, two, "two.stl"), 0.01, "x-min")
    with pytest.raises(InputError, match="are all lengths in mm"):
        fill_surface(saved(tmp_path, box((3000, 3000, 3000)), "huge.stl"), 0.01, "x-min")
    (tmp_path / "bad.stl").write_bytes(b"solid nothing\nendsolid")
    (tmp_path / "bad.obj").write_bytes(bytes(range(256)))
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex x")
    (tmp_path / "shape.step").write_bytes(b"ISO-10303-21;")
    for name in ("bad.stl", "bad.obj", "bad.ply", "shape.step", "nowhere.stl"):
        with pytest.raises(InputError, match=name):
            read_surface(tmp_path / name)


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        ({"element_mm": 10}, "one of box_mm"),
        ({"box_mm": [10, 10, 10], "rectangles": [[1, 1]], "element_mm": 1}, "one of box_mm"),
        ({"box_mm": [10, 10, 10]}, "element_mm"),
        ({"surface": "a.stl", "cells": [1, 1, 1]}, "cells"),
        ({"box_mm": [10, 10, 10], "element_mm": 5, "cells": [2, 2, 2]}, "instead of element_mm"),
        ({"box_mm": [10, 10, 0], "element_mm": 5}, "longer than 0"),
        ({"ellipses": [[1, -1]], "element_mm": 5}, "a width and a height"),
        ({"rectangles": [[0, 1]], "element_mm": 5}, "a width and a height"),
    ],
)
def test_invalid_geometries_are_refused(geometry: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Geometry.model_validate(geometry)
