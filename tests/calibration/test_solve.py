from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rafl.calibration.board import BoardFile, Move, View, WorldPose
from rafl.calibration.camera import Camera, OrthographicCamera, PinholeCamera
from rafl.calibration.solve import Solution, solve_rig
from rafl.common.errors import InputError

SIZE = (1280, 720)
DOT_GRID = BoardFile.model_validate(
    {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [10, 6], "spacing_mm": 10}}
)
BOARD = 0.01 * np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)
FACING = WorldPose(origin_mm=(5.0, 0.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
NEARER = WorldPose(origin_mm=(5.0, -20.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))


def side_camera(tilt_deg: tuple[float, float, float] = (1.0, -0.7, 0.5)) -> OrthographicCamera:
    """A camera that looks along +y, rotated a little."""
    facing = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rotation = Rotation.from_rotvec(np.radians(tilt_deg)).as_matrix() @ facing
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return OrthographicCamera(
        image_size=SIZE,
        scale=(9810.0, 9800.0),
        skew=12.0,
        rotation_vector=tuple(vector),
        offset=(150.0, 400.0),
        distortion=(2e-3, -1e-3),
    )


def view_of(camera: Camera, pose: WorldPose, name: str, known: bool, noise: float, random: np.random.Generator) -> View:
    world = pose.origin + BOARD @ pose.rotation[:, :2].T
    return View(
        name, name, BOARD, camera.project(world) + random.normal(0, noise, BOARD.shape), pose if known else None
    )


def views_of(
    camera: Camera,
    random: np.random.Generator,
    noise: float = 0.05,
    poses: tuple[WorldPose, ...] = (FACING, NEARER),
) -> list[View]:
    views = [view_of(camera, pose, f"left/{i}", True, noise, random) for i, pose in enumerate(poses)]
    for number in range(10):
        direction = np.radians(36 * number)
        axis = np.cos(direction) * FACING.rotation[:, 0] + np.sin(direction) * FACING.rotation[:, 1]
        rotation = Rotation.from_rotvec(np.radians(random.uniform(12, 38)) * axis).as_matrix() @ FACING.rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(rotation[:, 0]), y_axis=tuple(rotation[:, 1])
        )
        views.append(view_of(camera, pose, f"left/{number + 5}", False, noise, random))
    return views


def parameters(camera: OrthographicCamera) -> np.ndarray:
    matrix = 1e-3 * np.array([*camera.scale, camera.skew])
    return np.concatenate([matrix, camera.rotation_vector, camera.offset, camera.distortion])


def solve_one(views: list[View], signs: dict[str, int] | None = None, model: str = "orthographic") -> Solution:
    return solve_rig({"left": views}, {"left": SIZE}, DOT_GRID, signs or {}, model)


def left(solution: Solution) -> OrthographicCamera:
    camera = solution.rig.cameras["left"]
    assert isinstance(camera, OrthographicCamera)
    return camera


def test_views_without_noise_give_the_exact_camera(random: np.random.Generator) -> None:
    camera = side_camera()
    found = left(solve_one(views_of(camera, random, noise=0.0)))
    np.testing.assert_allclose(parameters(found), parameters(camera), atol=1e-5)
    assert found.residual < 1e-6
    assert found.plane is not None
    np.testing.assert_allclose(found.plane.normal, [0, 1, 0], atol=1e-12)


@pytest.mark.slow
def test_covariance_predicts_the_errors() -> None:
    """Over 30 noisy calibrations, the RMS of error / predicted sigma is 1 within 25 %."""
    camera = side_camera()
    scores = []
    for seed in range(30):
        random = np.random.default_rng(seed)
        found = left(solve_one(views_of(camera, random)))
        sigma = np.sqrt(np.diag(np.array(found.covariance)))
        scores.append((parameters(found) - parameters(camera)) / sigma)
        assert abs(found.scale[0] / camera.scale[0] - 1) < 3e-4
    rms = np.sqrt((np.array(scores) ** 2).mean(axis=0))
    assert rms.mean() == pytest.approx(1.0, abs=0.25)


def test_single_wrong_corners_have_little_effect(random: np.random.Generator) -> None:
    camera = side_camera()
    views = views_of(camera, random)
    for view in views[::3]:
        view.pixels[7] += [9.0, -6.0]
    found = left(solve_one(views))
    assert abs(found.scale[0] / camera.scale[0] - 1) < 3e-4


@pytest.mark.parametrize(
    "tilt",
    [
        (10.0, 0.0, 0.0),
        (0.0, -10.0, 0.0),
        *(pytest.param(tilt, marks=pytest.mark.slow) for tilt in ((-10.0, 0.0, 0.0), (0.0, 10.0, 0.0))),
    ],
)
def test_camera_tilt_is_not_mirrored(tilt: tuple[float, float, float]) -> None:
    """The sign follows from a board moved along its normal by a known or unknown distance, or from the user."""
    camera = side_camera(tilt)
    random = np.random.default_rng(1)
    views = views_of(camera, random)
    np.testing.assert_allclose(left(solve_one(views)).rotation, camera.rotation, atol=2e-3)
    unknown = [replace(view, known_pose=None) if view.name == "left/1" else view for view in views]
    moved = DOT_GRID.model_copy(update={"moved": [Move(from_="left/0", to="left/1", along=(0.0, -1.0, 0.0))]})
    found = solve_rig({"left": unknown}, {"left": SIZE}, moved, {}).rig.cameras["left"]
    np.testing.assert_allclose(found.rotation, camera.rotation, atol=2e-3)
    one_pose = views_of(camera, random, poses=(FACING,))
    found_both = [left(solve_one(one_pose, {"left": sign})) for sign in (1, -1)]
    errors = [np.abs(option.rotation - camera.rotation).max() for option in found_both]
    assert min(errors) < 2e-3
    assert max(errors) > 0.1


def test_positive_tilt_sign_means_right_edge_farther(random: np.random.Generator) -> None:
    """The sign is + if the right edge of the board is farther away."""
    for angle, sign in ((-10.0, 1), (10.0, -1)):
        facing = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        rotation = Rotation.from_rotvec(np.radians([0.0, angle, 0.0])).as_matrix() @ facing
        farther = (rotation @ [0.1, 0, 0])[2] > 0
        assert farther == (sign == 1)
        camera = replace(side_camera(), rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()))
        found = left(solve_one(views_of(camera, random, poses=(FACING,)), {"left": sign}))
        np.testing.assert_allclose(found.rotation, camera.rotation, atol=2e-3)


def test_ambiguous_tilt_is_refused(random: np.random.Generator) -> None:
    views = views_of(side_camera((10.0, 0.0, 0.0)), random, poses=(FACING,))
    with pytest.raises(InputError, match="which way"):
        solve_one(views)


def test_cameras_with_shared_boards_share_one_world(random: np.random.Generator) -> None:
    """Each camera sees one board of known pose, in different planes, and both see twelve boards together."""
    cameras = {"left": side_camera((8.0, 3.0, 0.0)), "top": top_camera()}
    above = WorldPose(origin_mm=(5.0, 30.0, 40.0), x_axis=(1, 0, 0), y_axis=(0, -1, 0))
    views: dict[str, list[View]] = {
        "left": [view_of(cameras["left"], FACING, "left/0", True, 0.05, random)],
        "top": [view_of(cameras["top"], above, "top/0", True, 0.05, random)],
    }
    for number in range(12):
        rotation = Rotation.from_rotvec(random.normal(0, 0.3, 3)).as_matrix()
        rotation = rotation @ Rotation.from_rotvec([np.radians(-45.0), 0, 0]).as_matrix() @ FACING.rotation
        pose = WorldPose.model_construct(
            origin_mm=(10.0, 10.0, 30.0), x_axis=tuple(rotation[:, 0]), y_axis=tuple(rotation[:, 1])
        )
        for name, camera in cameras.items():
            view = view_of(camera, pose, f"{name}/{number + 5}", False, 0.05, random)
            views[name].append(replace(view, pose_key=str(number + 5)))
    found = solve_rig(views, dict.fromkeys(cameras, SIZE), DOT_GRID, {}).rig.cameras
    for name, camera in cameras.items():
        np.testing.assert_allclose(found[name].rotation, camera.rotation, atol=2e-3)


def top_camera() -> OrthographicCamera:
    downward = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    rotation = Rotation.from_rotvec(np.radians([6.0, -4.0, 1.0])).as_matrix() @ downward
    return replace(side_camera(), rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()))


def test_insufficient_views_are_refused(random: np.random.Generator) -> None:
    camera = side_camera()
    with pytest.raises(InputError, match="at least 4 images"):
        solve_one(views_of(camera, random)[:3])
    flat = [view_of(camera, FACING, f"left/{i}", i == 0, 0.05, random) for i in range(6)]
    with pytest.raises(InputError, match="tilt the board"):
        solve_one(flat)
    one_direction = flat[:2]
    for number, tilt in enumerate((12.0, 18.0, 25.0, 33.0)):
        rotation = Rotation.from_rotvec(np.radians(tilt) * FACING.rotation[:, 0]).as_matrix() @ FACING.rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(rotation[:, 0]), y_axis=tuple(rotation[:, 1])
        )
        one_direction.append(view_of(camera, pose, f"left/{number + 5}", False, 0.05, random))
    with pytest.raises(InputError, match="three directions"):
        solve_one(one_direction)


def test_perspective_is_detected(random: np.random.Generator) -> None:
    """From 1 m, a marker 64 mm off-axis and 10 mm off its plane has an error of 0.64 mm; a pinhole camera has none."""
    facing = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    near = PinholeCamera(
        image_size=SIZE,
        rotation_vector=tuple(Rotation.from_matrix(facing).as_rotvec()),
        focal=(9810.0, 9800.0),
        centre=(639.5, 359.5),
        translation=(-0.05, 0.02, 1.0),
        distortion=(-0.3, 1.0, 0.0, 0.0, 0.0),
    )
    solution = solve_one(views_of(near, random))
    inverse_distance, sigma = solution.inverse_distances["left"]
    assert inverse_distance == pytest.approx(1.0, abs=0.05)
    assert sigma < 0.02
    assert solution.perspective_bias("left", 0.010) == pytest.approx(0.64e-3, rel=0.1)
    side = left(solution)
    points = random.uniform([0.0, -0.02, 0.0], [0.1, 0.02, 0.03], (500, 3))
    error, expected = near.project(points) - side.project(points), side.model_error(points, np.zeros(500))
    assert (expected**2).mean() == pytest.approx((error**2).mean(), rel=0.3)
    assert ((error - expected) ** 2).mean() < 0.15 * (error**2).mean()
    found = solve_one(views_of(near, random), model="pinhole").rig.cameras["left"]
    assert isinstance(found, PinholeCamera)
    points = random.uniform(0.0, 0.05, (50, 3))
    assert np.abs(found.project(points) - near.project(points)).max() < 0.15
    exact = solve_one(views_of(side_camera(), random))
    inverse_distance, sigma = exact.inverse_distances["left"]
    assert abs(inverse_distance) < 4 * sigma
    assert left(exact).perspective is None
    with pytest.raises(InputError, match="orthographic model"):
        solve_one(views_of(side_camera(), random), model="pinhole")


@pytest.mark.slow
def test_mirrored_rigs_are_never_accepted() -> None:
    """Random cameras and views are either solved correctly or refused."""
    refused = 0
    for seed in range(12):
        random = np.random.default_rng(seed)
        camera = side_camera(tuple(random.uniform(-15, 15, 3)))
        poses = (FACING, NEARER) if seed % 3 else (FACING,)
        try:
            found = left(solve_one(views_of(camera, random, poses=poses)))
        except InputError:
            refused += 1
            continue
        assert np.abs(found.rotation - camera.rotation).max() < 5e-3
    assert refused <= 4


def handheld_views(
    camera: PinholeCamera, board: np.ndarray, random: np.random.Generator, moved: np.ndarray
) -> list[View]:
    """Eight boards near a camera that looks along +z, tilted by 4 to 7 degrees; their points are `moved` (P, 2)."""
    views = []
    for number in range(8):
        axis = [np.cos(0.8 * number), np.sin(0.8 * number), 0.0]
        rotation = Rotation.from_rotvec(np.radians(random.uniform(4, 7)) * np.array(axis)).as_matrix()
        place = random.uniform([-0.06, -0.05, -0.06], [-0.03, -0.02, 0.06])
        world = np.column_stack([board + moved, np.zeros(len(board))]) @ rotation.T + place
        name = f"left/{number}"
        views.append(View(name, name, board, camera.project(world) + random.normal(0, 0.05, board.shape), None))
    return views


@pytest.mark.parametrize("printing_error", [0.0, 20e-6])
def test_handheld_board_gives_the_whole_lens_and_the_errors_of_the_board(
    printing_error: float, random: np.random.Generator
) -> None:
    """Small tilts do for a pinhole. A board printed 0.02 mm off leaves no more residual than an exact one."""
    camera = PinholeCamera(
        image_size=SIZE,
        rotation_vector=(0.0, 0.0, 0.0),
        focal=(900.0, 905.0),
        centre=(660.0, 345.0),
        translation=(0.0, 0.0, 0.15),
        distortion=(-0.2, 0.1, 1e-3, -2e-3, 0.02),
    )
    views = handheld_views(camera, BOARD, random, random.normal(0.0, printing_error, BOARD.shape))
    with pytest.raises(InputError, match=r"tilted.*--model pinhole"):
        solve_one(views)
    solution = solve_one(views, model="pinhole")
    found = solution.rig.cameras["left"]
    assert isinstance(found, PinholeCamera)
    assert found.residual == pytest.approx(0.05, rel=0.15)
    assert found.focal == pytest.approx(camera.focal, rel=4e-3)
    assert found.centre == pytest.approx(camera.centre, abs=4.0)
    assert solution.board_error == pytest.approx(1.4 * printing_error, rel=0.25)
