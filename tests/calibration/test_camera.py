from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import Camera, OrthographicCamera, Perspective, PinholeCamera, Plane

FACING = OrthographicCamera(
    image_size=(1280, 720), scale=(10_000.0, 9_900.0), skew=50.0, rotation_vector=(0.0, 0.0, 0.0), offset=(600.0, 300.0)
)


def test_projection_by_hand() -> None:
    """u = mx x + skew y + u0, v = my y + v0 with R = I; z does not matter."""
    pixels = FACING.project(np.array([[0.01, 0.02, 5.0]]))
    np.testing.assert_allclose(pixels, [[600 + 100 + 1, 300 + 198]])


def test_rotation_maps_world_to_camera() -> None:
    """A quarter turn about z takes world x to camera y (down)."""
    camera = replace(FACING, rotation_vector=(0.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(camera.project(np.array([0.01, 0.0, 0.0])), [600 + 0.5, 300 + 99])
    np.testing.assert_allclose(camera.viewing_direction, [0, 0, 1], atol=1e-15)


def test_distortion_radius_is_in_half_diagonals() -> None:
    """At the image corner r is about 1, so distortion moves a point by k1 + k2 of its radius."""
    camera = replace(FACING, distortion=(0.02, -0.005))
    centre = np.array([639.5, 359.5])
    corner = centre + np.array([640.0, 360.0])
    np.testing.assert_allclose(camera.distort(corner) - centre, 1.015 * (corner - centre))


@settings(deadline=None)
@given(st.floats(0, 1279), st.floats(0, 719), st.floats(-0.05, 0.05), st.floats(-0.02, 0.02))
def test_undistort_inverts_distort(u: float, v: float, k1: float, k2: float) -> None:
    camera = replace(FACING, distortion=(k1, k2))
    pixel = np.array([[u, v]])
    np.testing.assert_allclose(camera.distort(camera.undistort(pixel)), pixel, atol=1e-6)


def test_undistort_keeps_nan() -> None:
    camera = replace(FACING, distortion=(0.01, 0.0))
    result = camera.undistort(np.array([[np.nan, np.nan], [5.0, 6.0]]))
    assert np.isnan(result[0]).all()
    assert result[1] == pytest.approx([5.0, 6.0], abs=10)


ORTHOGRAPHIC = OrthographicCamera(
    image_size=(1280, 720),
    rotation_vector=(0.3, -0.2, 1.1),
    scale=(9800.0, 9700.0),
    skew=12.0,
    offset=(600.0, 300.0),
    distortion=(0.02, -0.01),
    plane=Plane((0.0, 1.0, 0.0), 0.01, 5e-4),
    perspective=Perspective(0.9, 0.02, (640.0, 360.0)),
)
PINHOLE = PinholeCamera(
    image_size=(1280, 720),
    rotation_vector=(0.3, -0.2, 1.1),
    focal=(5000.0, 5100.0),
    centre=(630.0, 350.0),
    translation=(0.02, -0.01, 0.8),
    distortion=(0.05, -0.02, 1e-3, -2e-3, 0.01),
)


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, PINHOLE])
def test_a_camera_in_another_frame_gives_the_same_pixels(camera: Camera) -> None:
    random = np.random.default_rng(0)
    points, translation = random.normal(0.0, 0.03, (20, 3)), np.array([0.1, -0.05, 0.02])
    rotation = Rotation.from_rotvec([0.4, 0.5, -0.7]).as_matrix()
    moved, elsewhere = camera.in_frame(rotation, translation), points @ rotation.T + translation
    np.testing.assert_allclose(moved.project(elsewhere), camera.project(points), atol=1e-9)
    depth_sigma = np.full(20, 1e-3)
    before, after = camera.model_error(points, depth_sigma), moved.model_error(elsewhere, depth_sigma)
    assert np.abs(after - before).max() <= 0.2 * np.abs(before).max()  # its scale changes with the distance
    if camera.plane is not None:
        assert moved.plane is not None
        on_plane = points - np.outer(points @ camera.plane.normal - camera.plane.offset, camera.plane.normal)
        np.testing.assert_allclose(
            (on_plane @ rotation.T + translation) @ moved.plane.normal, moved.plane.offset, atol=1e-12
        )


@pytest.mark.parametrize("camera", [ORTHOGRAPHIC, PINHOLE])
def test_jacobian_is_the_limit_of_differences(camera: Camera) -> None:
    points, step = np.random.default_rng(1).normal(0.0, 0.03, (20, 3)), 1e-6
    differences = [
        (camera.project(points + step * e) - camera.project(points - step * e)) / (2 * step) for e in np.eye(3)
    ]
    np.testing.assert_allclose(camera.jacobian(points), np.stack(differences, axis=-1), rtol=1e-6, atol=1e-2)
