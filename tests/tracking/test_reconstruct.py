from dataclasses import replace

import numpy as np
import pytest

from calibration.camera import OrthographicCamera, Plane
from calibration.rig import Rig
from groundwork import InputError
from tracking.reconstruct import CameraPixels, fill_gaps, on_rig_clock, triangulate

SIDE = OrthographicCamera(
    (1280, 720), (6000.0, 6000.0), 0.0, (np.pi / 2, 0.0, 0.0), (600.0, 400.0),
    plane=Plane((0.0, -1.0, 0.0), -0.01, 5e-4),
)  # fmt: skip
ABOVE = replace(SIDE, rotation_vector=(np.pi, 0.0, 0.0), plane=None, distortion=(5e-3, 0.0))


def seen(camera: OrthographicCamera, points: np.ndarray, sigma: float = 0.02, noise: float = 0.0) -> CameraPixels:
    random = np.random.default_rng(int(any(camera.distortion)))  # another noise in each camera
    pixel = camera.project(points) + random.normal(0, noise, (*points.shape[:2], 2))
    return CameraPixels(pixel, np.full(points.shape[:2], sigma))


def test_two_cameras_give_exact_points(random: np.random.Generator) -> None:
    points = random.uniform(-0.05, 0.05, (6, 4, 3))
    rig = Rig({"side": SIDE, "above": ABOVE})
    pixels = {"side": seen(SIDE, points), "above": seen(ABOVE, points)}
    position, _, residual = triangulate(rig, pixels)
    np.testing.assert_allclose(position, points, atol=1e-9)
    assert max(values.max() for values in residual.values()) < 1e-4


def test_sigma_is_the_spread_of_noisy_points(random: np.random.Generator) -> None:
    points = np.broadcast_to(random.uniform(-0.05, 0.05, 3), (4000, 1, 3))
    rig = Rig({"side": SIDE, "above": ABOVE})
    pixels = {"side": seen(SIDE, points, 0.1, 0.1), "above": seen(ABOVE, points, 0.1, 0.1)}
    position, sigma, _ = triangulate(rig, pixels)
    np.testing.assert_allclose(position.std(axis=0)[0], sigma[0, 0], rtol=0.1)


def test_one_camera_puts_a_marker_on_its_plane() -> None:
    """y = 10 mm is the plane; there sigma is the plane's, across the picture the pixel's."""
    points = np.array([[[0.02, 0.01, 0.03]]])
    position, sigma, _ = triangulate(Rig({"side": SIDE}), {"side": seen(SIDE, points)})
    np.testing.assert_allclose(position, points, atol=1e-9)
    np.testing.assert_allclose(sigma[0, 0], [0.02 / 6000, 5e-4, 0.02 / 6000], rtol=1e-6)
    bare = replace(SIDE, plane=None)
    with pytest.raises(InputError, match=r"camera side alone .* no plane"):
        triangulate(Rig({"side": bare}), {"side": seen(bare, points)})


def test_unseen_markers_are_nan() -> None:
    points = np.zeros((2, 1, 3))
    pixels = seen(SIDE, points)
    pixels.pixel[1], pixels.sigma[1] = np.nan, np.nan
    position, sigma, residual = triangulate(Rig({"side": SIDE}), {"side": pixels})
    assert np.isfinite(position[0]).all()
    assert np.isnan(position[1]).all()
    assert np.isnan(sigma[1]).all()
    assert np.isnan(residual["side"][1]).all()


def test_short_gaps_are_filled_and_long_ones_left() -> None:
    time = 0.01 * np.arange(40)
    truth = np.stack([np.sin(20 * time), np.cos(15 * time), time], axis=-1)[:, None]
    position, sigma = truth.copy(), np.full((40, 1, 3), 1e-4)
    position[10:13] = np.nan
    position[20:30] = np.nan
    position[:2] = np.nan
    filled, grown, state = fill_gaps(position, sigma, time, 5)
    assert state[:, 0].tolist() == [0, 0, *[1] * 8, 2, 2, 2, *[1] * 7, *[0] * 10, *[1] * 10]
    assert np.abs(filled[10:13] - truth[10:13]).max() < 2e-3
    assert (np.abs(filled[10:13] - truth[10:13]) < 3 * grown[10:13]).all()
    assert (grown[10:13] > sigma[0]).all()
    assert np.isnan(filled[20:30]).all()


def test_a_late_camera_is_brought_to_the_rigs_clock() -> None:
    """A clock 3.7 ms ahead stamps at t what happened at t - 3.7 ms."""
    time = 0.01 * np.arange(50)

    def path(t: np.ndarray) -> np.ndarray:
        return np.stack([300 + 40 * np.sin(9 * t), 200 + 30 * np.cos(7 * t)], axis=-1)[:, None]

    stamped = CameraPixels(path(time - 0.0037), np.full((50, 1), 0.05))
    moved = on_rig_clock(stamped, time, 0.0037)
    inside = np.isfinite(moved.sigma[:, 0])
    assert inside.sum() >= 48
    np.testing.assert_allclose(moved.pixel[inside], path(time)[inside], atol=5e-3)
