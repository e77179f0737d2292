import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.board import View, WorldPose
from calibration.camera import OrthographicCamera
from calibration.solve import Solution, solve_camera
from groundwork import InputError

SIZE = (1280, 720)
BOARD = 0.01 * np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)
FLAT = WorldPose(origin_mm=(5.0, 0.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
NEARER = WorldPose(origin_mm=(5.0, -20.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))


def side_camera(tilt_deg: tuple[float, float, float] = (1.0, -0.7, 0.5)) -> OrthographicCamera:
    """Looks along +y at a specimen, a little askew."""
    square = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rotation = Rotation.from_rotvec(np.radians(tilt_deg)).as_matrix() @ square
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return OrthographicCamera(
        image_size=SIZE, scale=(9810.0, 9800.0), skew=12.0, rotation_vector=tuple(vector), offset=(150.0, 400.0),
        distortion=(2e-3, -1e-3),
    )  # fmt: skip


def view_of(camera: OrthographicCamera, pose: WorldPose, name: str, known: bool, noise: float, random) -> View:  # type: ignore[no-untyped-def]
    world = pose.origin + BOARD @ pose.rotation[:, :2].T
    return View(name, BOARD, camera.project(world) + random.normal(0, noise, BOARD.shape), pose if known else None)


def views_of(
    camera: OrthographicCamera,
    random: np.random.Generator,
    noise: float = 0.05,
    poses: tuple[WorldPose, ...] = (FLAT, NEARER),
) -> list[View]:
    views = [view_of(camera, pose, f"left/{i}", True, noise, random) for i, pose in enumerate(poses)]
    for number in range(10):
        direction = np.radians(36 * number)
        axis = np.cos(direction) * FLAT.rotation[:, 0] + np.sin(direction) * FLAT.rotation[:, 1]
        turn = Rotation.from_rotvec(np.radians(random.uniform(12, 38)) * axis).as_matrix() @ FLAT.rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(turn[:, 0]), y_axis=tuple(turn[:, 1])
        )
        views.append(view_of(camera, pose, f"left/{number + 5}", False, noise, random))
    return views


def parameters(camera: OrthographicCamera) -> np.ndarray:
    matrix = 1e-3 * np.array([*camera.scale, camera.skew])
    return np.concatenate([matrix, camera.rotation_vector, camera.offset, camera.distortion])


def test_exact_views_give_the_exact_camera(random: np.random.Generator) -> None:
    camera = side_camera()
    found = solve_camera("left", views_of(camera, random, noise=0.0), SIZE).camera
    np.testing.assert_allclose(parameters(found), parameters(camera), atol=1e-5)
    assert found.residual < 1e-6
    assert found.plane is not None
    np.testing.assert_allclose(found.plane.normal, [0, 1, 0], atol=1e-12)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """Over 30 noisy calibrations, errors in predicted standard deviations have size 1 (within 25 %)."""
    camera = side_camera()
    scores = []
    for seed in range(30):
        random = np.random.default_rng(seed)
        found: Solution = solve_camera("left", views_of(camera, random), SIZE)
        sigma = np.sqrt(np.diag(np.array(found.camera.covariance)))
        scores.append((parameters(found.camera) - parameters(camera)) / sigma)
        assert abs(found.camera.scale[0] / camera.scale[0] - 1) < 3e-4
    spread = np.sqrt((np.array(scores) ** 2).mean(axis=0))
    assert spread.mean() == pytest.approx(1.0, abs=0.25)


def test_the_tilt_of_a_camera_is_not_mirrored() -> None:
    """With a board moved along its normal, the sign of a 10 degree tilt is found, whichever it is."""
    for tilt in ((10.0, 0.0, 0.0), (-10.0, 0.0, 0.0), (0.0, 0.0, 10.0), (0.0, 0.0, -10.0)):
        camera = side_camera(tilt)
        found = solve_camera("left", views_of(camera, np.random.default_rng(1)), SIZE).camera
        np.testing.assert_allclose(found.rotation, camera.rotation, atol=2e-3)


def test_an_ambiguous_tilt_is_refused(random: np.random.Generator) -> None:
    views = views_of(side_camera((10.0, 0.0, 0.0)), random, poses=(FLAT,))
    with pytest.raises(InputError, match="which way"):
        solve_camera("left", views, SIZE)


def test_too_few_or_too_flat_views_are_refused(random: np.random.Generator) -> None:
    camera = side_camera()
    with pytest.raises(InputError, match="at least 4 pictures"):
        solve_camera("left", views_of(camera, random)[:3], SIZE)
    flat = [view_of(camera, FLAT, f"left/{i}", i == 0, 0.05, random) for i in range(6)]
    with pytest.raises(InputError, match="tilt the board"):
        solve_camera("left", flat, SIZE)
