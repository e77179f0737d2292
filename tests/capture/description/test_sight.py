"""Places of dots that one camera saw: they lie on its lines of sight, whatever plane the calibration assumes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filmed_markers import pinhole_camera, side_camera
from scipy.spatial.transform import Rotation
from stills import SIDES, TOP_AND_TIP, box_body, filmed_still

from rafl.calibration.camera import Camera, Plane
from rafl.capture.description.describe import Description, describe
from rafl.capture.description.still import Dots, dots_at_rest
from rafl.capture.description.undeformed import Shape, carry_back
from rafl.common.errors import InputError
from rafl.fem.mesh import HexMesh

FRONT, TOP = SIDES[SIDES[:, 1] == 0.0], TOP_AND_TIP[TOP_AND_TIP[:, 0] < 100.0]
STIFFNESS = 1.4
OBLIQUE = Rotation.from_rotvec([0.0, 0.0, np.radians(30.0)]).as_matrix()


def front_plane(y: float) -> Plane:
    """The plane that the side y = 0 is taken for."""
    return Plane((0.0, -1.0, 0.0), -y, 5e-4)


def above(plane: float) -> Camera:
    """A camera that looks down on the top at 60 degrees, whose plane is z = `plane` [m]."""
    down = Rotation.from_rotvec([np.radians(-60.0), 0.0, 0.0]).as_matrix()
    return replace(side_camera(0.0).in_frame(down, np.zeros(3)), plane=Plane((0.0, 0.0, 1.0), plane, 5e-4))


CAMERAS: dict[str, Callable[[float], Camera]] = {
    "orthographic": lambda y: replace(side_camera(0.5), plane=front_plane(y)),
    "pinhole": lambda y: replace(pinhole_camera(0.4), plane=front_plane(y)),
    "oblique pinhole": lambda y: replace(pinhole_camera(0.4).in_frame(OBLIQUE, np.zeros(3)), plane=front_plane(y)),
}


def described(folder: Path, places: np.ndarray, cameras: dict[str, Camera], seed: int = 1) -> Description:
    return describe(filmed_still(folder, places, cameras, STIFFNESS, seed), box_body(), Path(), False, "still.h5")


def errors_mm(found: Description, places: np.ndarray) -> np.ndarray:
    return np.linalg.norm(1e3 * found.undeformed.carried.rest - places, axis=1)


@pytest.mark.parametrize("kind", CAMERAS)
def test_places_do_not_depend_on_the_assumed_plane(kind: str, tmp_path: Path) -> None:
    """Taken for positions, the dots would be 0.15 mm (pinhole) to 1.15 mm (oblique) off by a plane 2 mm off."""
    found = [described(tmp_path, FRONT, {"front": CAMERAS[kind](y)}) for y in (0.0, 0.002, -0.002)]
    for each in found:
        assert errors_mm(each, FRONT).max() < 0.08
        assert (errors_mm(each, FRONT) < 1e3 * each.undeformed.sigma).all()
        assert each.youngs_modulus == pytest.approx(STIFFNESS * box_body().material.youngs_modulus, rel=0.01)
        assert set(each.faces) == {"y-min"}
    for each in found[1:]:
        np.testing.assert_allclose(each.undeformed.carried.rest, found[0].undeformed.carried.rest, atol=5e-6)
        np.testing.assert_allclose(each.undeformed.sigma, found[0].undeformed.sigma, rtol=0.05)


def test_dots_on_the_top_sag_out_of_the_assumed_plane(tmp_path: Path) -> None:
    """The tip sags by some 9 mm from the plane in which the camera's calibration assumes the dots."""
    for plane in (0.020, 0.022):
        found = described(tmp_path, TOP, {"top": above(plane)})
        assert errors_mm(found, TOP).max() < 0.08
        assert found.youngs_modulus == pytest.approx(STIFFNESS * box_body().material.youngs_modulus, rel=0.02)


def test_errors_of_places_by_hand_are_as_large_as_sigma_says(tmp_path: Path) -> None:
    random, scaled = np.random.default_rng(3), []
    for seed in range(6):
        places = FRONT + random.normal(0.0, 0.5, FRONT.shape) * [1.0, 0.0, 1.0]
        found = described(tmp_path, places, {"front": CAMERAS["oblique pinhole"](0.002)}, seed)
        scaled.append(errors_mm(found, places) / (1e3 * found.undeformed.sigma))
    assert 0.3 < np.sqrt(np.mean(np.square(scaled))) < 1.3


def test_two_cameras_measure_the_depth(tmp_path: Path) -> None:
    """Their planes do not count, and what they measured is no plane."""
    rigs = [
        {name: replace(side_camera(a), plane=front_plane(y)) for name, a in (("a", -0.8), ("b", 0.8))}
        for y in (0.0, 0.002)
    ]
    dots = [dots_at_rest(filmed_still(tmp_path, FRONT, rig), "still.h5") for rig in rigs]
    assert dots[0].measured.all()
    np.testing.assert_allclose(dots[1].position, dots[0].position, atol=1e-12)


def test_a_dot_lies_on_the_side_that_its_camera_sees() -> None:
    """On a plate 3 mm thick the assumed plane is nearer to the other side."""
    mesh = HexMesh.box((10, 1, 2), (0.1, 0.003, 0.02))
    places = 1e-3 * np.array([(20.0, 0.0, 7.0), (60.0, 0.0, 12.0)])
    away = np.array([np.sin(0.4), np.cos(0.4), 0.0])
    axes = np.stack([[np.cos(0.4), -np.sin(0.4), 0.0], [0.0, 0.0, 1.0], away])
    sigma = np.broadcast_to([1e-5, 1e-5, np.inf], (2, 3))
    for sign, y in ((1.0, 0.0), (-1.0, 0.003)):
        own = places + np.array([0.0, y, 0.0])
        seen = axes * [[1.0], [1.0], [sign]]
        dots = Dots(("a", "b"), own + 2.5e-3 * sign * away, np.broadcast_to(seen, (2, 3, 3)), sigma)
        carried = carry_back(Shape(mesh), mesh.vertices, dots)
        np.testing.assert_allclose(carried.rest, own, atol=1e-6)
        np.testing.assert_allclose(carried.position, own, atol=1e-6)
        np.testing.assert_allclose(carried.sigma, 1e-5 / np.cos(0.4), rtol=1e-3)  # the face is oblique


def test_a_plane_far_off_the_body_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"within 3 mm of .* moved by about 4, -8, -\d mm along x, y, z"):
        described(tmp_path, FRONT, {"front": CAMERAS["orthographic"](0.008)})
