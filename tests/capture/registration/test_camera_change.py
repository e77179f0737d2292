"""Cameras that were turned, shifted and have another clock than calibrated."""

import numpy as np
import pytest
from filmed_markers import side_camera

from rafl.calibration.camera import Camera, PinholeCamera
from rafl.capture.registration.camera_change import CameraChange, positions_at
from rafl.data.views import View

PINHOLE = PinholeCamera(
    image_size=(1280, 720),
    rotation_vector=(np.pi / 2, 0.1, 0.0),
    focal=(9000.0, 9000.0),
    centre=(640.0, 360.0),
    translation=(0.0, 0.0, 1.0),
    distortion=(0.1, 0.0, 0.0, 0.0, 0.0),
)
CENTRE = np.array([0.05, 0.01, 0.02])
VALUE = np.array([0.01, -0.02, 0.03, 1e-3, -2e-3, 5e-4, 0.0])


def test_a_turned_camera_sees_the_body_turned_the_other_way(random: np.random.Generator) -> None:
    """A camera that only turns about the line of sight through a point turns the image about that point."""
    camera = side_camera(0.3)
    axis = camera.viewing_direction
    change = CameraChange(np.concatenate([0.1 * axis, np.zeros(4)]), CENTRE)
    middle = camera.project_undistorted(CENTRE)
    points = CENTRE + 1e-3 * random.normal(size=(5, 3))
    before, after = (own.project_undistorted(points) - middle for own in (camera, change.moved(camera)))
    turn = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    np.testing.assert_allclose(after, before @ turn.T, atol=1e-9)


@pytest.mark.parametrize("camera", [side_camera(0.3), PINHOLE])
def test_slope_is_that_of_differences(camera: Camera, random: np.random.Generator) -> None:
    points = CENTRE + 0.02 * random.normal(size=(5, 3))
    found = CameraChange(VALUE, CENTRE).pose_slope(CameraChange(VALUE, CENTRE).moved(camera), points)
    for k in range(3, 6):
        step = np.eye(7)[k] * 1e-6
        plus, minus = (CameraChange(VALUE + s * step, CENTRE).moved(camera).project(points) for s in (1, -1))
        np.testing.assert_allclose(found[..., k], (plus - minus) / 2e-6, rtol=1e-5, atol=1e-3)
    none = np.zeros(7)
    found = CameraChange(none, CENTRE).pose_slope(camera, points)
    for k in range(3):
        step = np.eye(7)[k] * 1e-6
        plus, minus = (CameraChange(s * step, CENTRE).moved(camera).project(points) for s in (1, -1))
        np.testing.assert_allclose(found[..., k], (plus - minus) / 2e-6, rtol=1e-5, atol=1e-2)


def test_positions_are_those_at_the_times_of_the_frames() -> None:
    """Cameras with different clocks film points that move evenly; at its first time a camera shows its first frame."""
    time = 0.01 * np.arange(8)
    start, velocity = np.array([[0.03, 0.01, 0.02], [0.05, 0.02, 0.01]]), np.array([0.02, -0.01, 0.03])

    def moving(lag: float) -> np.ndarray:
        return start + (time + lag)[:, None, None] * velocity

    views = {}
    for name, angle, lag in (("left", -0.7, 0.0), ("right", 0.7, 0.004)):
        pixel = side_camera(angle).project(moving(lag))
        covariance = np.broadcast_to(0.01 * np.eye(2), (*pixel.shape[:2], 2, 2))
        views[name] = View(side_camera(angle), pixel, covariance, np.full(8, lag))
    position, sigma = positions_at(views, time)
    np.testing.assert_allclose(position[1:], moving(0.0)[1:], atol=1e-9)
    late = np.linalg.norm(position[0] - start, axis=-1)
    assert (late > 1e-7).all()
    assert (late < 2.0 * 0.004 * np.linalg.norm(velocity)).all()
    assert (sigma < 1e-4).all()
