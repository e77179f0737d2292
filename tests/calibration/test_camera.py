from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rafl.calibration.camera import OrthographicCamera

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
