from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import stereo

from rafl.calibration.camera import OrthographicCamera, Perspective, PinholeCamera, Plane
from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rig import Rig, write_calibration
from rafl.common.errors import InputError
from rafl.tracking.reconstruction.triangulation import CameraPixels, resample_pixels, triangulate

SIDE = OrthographicCamera(
    image_size=(1280, 720),
    scale=(6000.0, 6000.0),
    rotation_vector=(np.pi / 2, 0.0, 0.0),
    offset=(600.0, 400.0),
    plane=Plane((0.0, -1.0, 0.0), -0.01, 5e-4),
)
ABOVE = replace(SIDE, rotation_vector=(np.pi, 0.0, 0.0), plane=None, distortion=(5e-3, 0.0))


def film(camera: OrthographicCamera, points: np.ndarray, sigma: float = 0.02, noise: float = 0.0) -> CameraPixels:
    random = np.random.default_rng(int(any(camera.distortion)))  # different noise in each camera
    pixel = camera.project(points) + random.normal(0, noise, (*points.shape[:2], 2))
    return CameraPixels(pixel, np.full(pixel.shape, sigma))


def test_two_cameras_give_exact_points(random: np.random.Generator) -> None:
    points = random.uniform(-0.05, 0.05, (6, 4, 3))
    rig = Rig({"side": SIDE, "above": ABOVE})
    pixels = {"side": film(SIDE, points), "above": film(ABOVE, points)}
    position, _, residual = triangulate(rig, pixels)
    np.testing.assert_allclose(position, points, atol=1e-9)
    assert max(values.max() for values in residual.values()) < 1e-4


def test_sigma_is_the_standard_deviation_of_noisy_points(random: np.random.Generator) -> None:
    points = np.broadcast_to(random.uniform(-0.05, 0.05, 3), (4000, 1, 3))
    rig = Rig({"side": SIDE, "above": ABOVE})
    pixels = {"side": film(SIDE, points, 0.1, 0.1), "above": film(ABOVE, points, 0.1, 0.1)}
    position, sigma, _ = triangulate(rig, pixels)
    np.testing.assert_allclose(position.std(axis=0)[0], sigma[0, 0], rtol=0.1)


def test_one_camera_places_a_marker_on_its_plane() -> None:
    """The plane is y = 10 mm. Sigma is the plane's along y, and follows from the pixels along x and z."""
    points = np.array([[[0.02, 0.01, 0.03]]])
    position, sigma, _ = triangulate(Rig({"side": SIDE}), {"side": film(SIDE, points)})
    np.testing.assert_allclose(position, points, atol=1e-9)
    np.testing.assert_allclose(sigma[0, 0], [0.02 / 6000, 5e-4, 0.02 / 6000], rtol=1e-6)
    bare = replace(SIDE, plane=None)
    with pytest.raises(InputError, match=r"camera side alone .* no plane"):
        triangulate(Rig({"side": bare}), {"side": film(bare, points)})


def test_sigma_contains_the_perspective_that_the_model_leaves_out() -> None:
    """From 2 m away, a marker 5 mm behind where the scale is exact is taken to be 1/400 nearer to the centre."""
    centre = (630.0, 340.0)
    camera = replace(SIDE, perspective=Perspective(2.0, 0.005, centre), plane=Plane((0.0, -1.0, 0.0), -0.01, 1e-9))
    points = np.array([[[0.02, 0.01, 0.03]]])
    expected = np.abs(camera.project(points)[0, 0] - centre) * 0.005 / 2.0 / 6000.0
    pixels = {"side": film(camera, points, sigma=1e-4)}
    _, sigma, _ = triangulate(Rig({"side": camera}), pixels)
    np.testing.assert_allclose(sigma[0, 0, [0, 2]], expected, rtol=1e-3)
    by_plane = replace(camera, plane=Plane((0.0, -1.0, 0.0), -0.01, 0.012))
    _, sigma, _ = triangulate(Rig({"side": by_plane}), pixels)
    np.testing.assert_allclose(sigma[0, 0, [0, 2]], expected * 13 / 5, rtol=1e-3)


def test_unseen_markers_are_nan() -> None:
    points = np.zeros((2, 1, 3))
    pixels = film(SIDE, points)
    pixels.pixel[1], pixels.sigma[1] = np.nan, np.nan
    position, sigma, residual = triangulate(Rig({"side": SIDE}), {"side": pixels})
    assert np.isfinite(position[0]).all()
    assert np.isnan(position[1]).all()
    assert np.isnan(sigma[1]).all()
    assert np.isnan(residual["side"][1]).all()


def test_a_camera_is_resampled_to_the_rigs_clock() -> None:
    """A clock 3.7 ms ahead gives the time t to what happened at t - 3.7 ms."""
    time = 0.01 * np.arange(50)

    def path(t: np.ndarray) -> np.ndarray:
        return np.stack([300 + 40 * np.sin(9 * t), 200 + 30 * np.cos(7 * t)], axis=-1)[:, None]

    stamped = CameraPixels(path(time - 0.0037), np.full((50, 1, 2), 0.05))
    resampled = resample_pixels(stamped, time - 0.0037, time)
    inside = np.isfinite(resampled.sigma[:, 0, 0])
    assert inside.sum() >= 48
    np.testing.assert_allclose(resampled.pixel[inside], path(time)[inside], atol=5e-3)


def test_dropped_frames_are_not_interpolated() -> None:
    """Nothing is interpolated across a dropped frame. Frames of the same time are taken unchanged."""
    own = np.delete(0.01 * np.arange(20), [7, 8])
    pixels = CameraPixels(np.ones((18, 1, 2)) * own[:, None, None], np.full((18, 1, 2), 0.05))
    resampled = resample_pixels(pixels, own, 0.01 * np.arange(20))
    assert np.flatnonzero(np.isnan(resampled.pixel[:, 0, 0])).tolist() == [7, 8]
    np.testing.assert_array_equal(resampled.pixel[[0, 6, 9, 19], 0, 0], [0.0, 0.06, 0.09, 0.19])


ASKEW = replace(SIDE, rotation_vector=(2.0, 0.7, 0.3), plane=None)


def test_an_outlying_camera_is_left_out_if_the_others_agree(random: np.random.Generator) -> None:
    points = random.uniform(-0.03, 0.03, (5, 3, 3))
    rig = Rig({"side": SIDE, "above": ABOVE, "askew": ASKEW})
    pixels = {name: film(camera, points) for name, camera in rig.cameras.items()}
    pixels["askew"].pixel[2, 1] += [80.0, -30.0]
    position, _, residual = triangulate(rig, pixels)
    np.testing.assert_allclose(position, points, atol=1e-7)
    assert residual["askew"][2, 1] > 50


def test_a_marker_on_which_two_cameras_disagree_counts_as_not_seen(random: np.random.Generator) -> None:
    points = random.uniform(-0.03, 0.03, (5, 3, 3))
    pixels = {"side": film(SIDE, points), "above": film(ABOVE, points)}
    pixels["above"].pixel[2, 1] += [80.0, 0.0]
    position, _, _ = triangulate(Rig({"side": SIDE, "above": ABOVE}), pixels)
    assert np.isnan(position[2, 1]).all()
    assert np.isfinite(position).all(axis=2).sum() == 14


def test_pinhole_and_orthographic_cameras_together(random: np.random.Generator) -> None:
    near = PinholeCamera(
        image_size=(1280, 720),
        rotation_vector=(np.pi, 0.0, 0.0),
        focal=(6000.0, 6010.0),
        centre=(600.0, 400.0),
        translation=(0.01, 0.02, 1.0),
        distortion=(-0.1, 0.02, 1e-3, -1e-3, 0.0),
    )
    points = random.uniform(-0.03, 0.03, (5, 3, 3))
    rig = Rig({"side": SIDE, "near": near})
    position, sigma, _ = triangulate(rig, {name: film(camera, points) for name, camera in rig.cameras.items()})
    np.testing.assert_allclose(position, points, atol=1e-8)
    assert (sigma < 2e-5).all()


def test_calibrations_of_other_programs_give_the_same_points_as_calib_yaml(tmp_path: Path) -> None:
    """The same pixels, through aniposelib's file, calib.yaml and MATLAB's, whose world is the left camera's frame."""
    (tmp_path / "calibration.toml").write_text(stereo.aniposelib_text())
    stereo.write_matlab_stereo(tmp_path / "stereo.mat")
    rigs = {
        "toml": read_any_calibration(tmp_path / "calibration.toml", "mm"),
        "mat": read_any_calibration(
            tmp_path / "stereo.mat", None, lambda _: dict.fromkeys(stereo.MATRICES, stereo.SIZE)
        ),
    }
    write_calibration(tmp_path / "calib.yaml", rigs["toml"])
    rigs["yaml"] = read_any_calibration(tmp_path / "calib.yaml")
    pixels = {name: stereo.opencv_pixels(name)[None] for name in stereo.MATRICES}
    pixels["left"][0, 5], pixels["right"][0, 5] = np.nan, np.nan  # seen by neither
    pixels["right"][0, 7] = np.nan  # seen by one, which gives no depth
    film = {name: CameraPixels(pixel, np.where(np.isfinite(pixel), 0.02, np.nan)) for name, pixel in pixels.items()}
    found = {name: triangulate(rig, film)[0][0] for name, rig in rigs.items()}
    points = 1e-3 * stereo.POINTS_MM
    points[[5, 7]] = np.nan
    np.testing.assert_allclose(found["toml"], points, atol=1e-9)
    np.testing.assert_allclose(found["yaml"], points, atol=1e-9)
    left = rigs["toml"].cameras["left"]
    assert isinstance(left, PinholeCamera)
    np.testing.assert_allclose(found["mat"], points @ left.rotation.T + left.translation, atol=1e-9)
