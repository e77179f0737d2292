from dataclasses import replace

import numpy as np
import pytest
from rafl.calibration.board import BoardFile, Move, View, WorldPose
from rafl.calibration.camera import Camera, OrthographicCamera, PinholeCamera
from rafl.calibration.solve import Solution, solve_rig
from scipy.spatial.transform import Rotation

from rafl.common.errors import InputError

SIZE = (1280, 720)
PLAIN = BoardFile.model_validate(
    {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [10, 6], "spacing_mm": 10}}
)
BOARD = 0.01 * np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)
FLAT = WorldPose(origin_mm=(5.0, 0.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))
NEARER = WorldPose(origin_mm=(5.0, -20.0, 25.0), x_axis=(1, 0, 0), y_axis=(0, 0, -1))


def side_camera(tilt_deg: tuple[float, float, float] = (1.0, -0.7, 0.5)) -> OrthographicCamera:
    """Looks along +y at a specimen, a little askew."""
    square = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rotation = Rotation.from_rotvec(np.radians(tilt_deg)).as_matrix() @ square
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return OrthographicCamera(
        image_size=SIZE,
        scale=(9810.0, 9800.0),
        skew=12.0,
        rotation_vector=tuple(vector),
        offset=(150.0, 400.0),
        distortion=(2e-3, -1e-3),
    )


def view_of(camera: Camera, pose: WorldPose, name: str, known: bool, noise: float, random) -> View:
    world = pose.origin + BOARD @ pose.rotation[:, :2].T
    return View(
        name, name, BOARD, camera.project(world) + random.normal(0, noise, BOARD.shape), pose if known else None
    )


def views_of(
    camera: Camera,
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


def solve_one(views: list[View], signs: dict[str, int] | None = None, model: str = "orthographic") -> Solution:
    return solve_rig({"left": views}, {"left": SIZE}, PLAIN, signs or {}, model)


def left(solution: Solution) -> OrthographicCamera:
    camera = solution.rig.cameras["left"]
    assert isinstance(camera, OrthographicCamera)
    return camera


def test_exact_views_give_the_exact_camera(random: np.random.Generator) -> None:
    camera = side_camera()
    found = left(solve_one(views_of(camera, random, noise=0.0)))
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
        found = left(solve_one(views_of(camera, random)))
        sigma = np.sqrt(np.diag(np.array(found.covariance)))
        scores.append((parameters(found) - parameters(camera)) / sigma)
        assert abs(found.scale[0] / camera.scale[0] - 1) < 3e-4
    spread = np.sqrt((np.array(scores) ** 2).mean(axis=0))
    assert spread.mean() == pytest.approx(1.0, abs=0.25)


def test_single_wrong_corners_do_not_matter(random: np.random.Generator) -> None:
    camera = side_camera()
    views = views_of(camera, random)
    for view in views[::3]:
        view.pixels[7] += [9.0, -6.0]
    found = left(solve_one(views))
    assert abs(found.scale[0] / camera.scale[0] - 1) < 3e-4


@pytest.mark.parametrize("tilt", [(10.0, 0.0, 0.0), (-10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, -10.0, 0.0)])
def test_the_tilt_of_a_camera_is_not_mirrored(tilt: tuple[float, float, float]) -> None:
    """A board moved along its normal, by a known distance or an unknown, tells the sign; so does the user."""
    camera = side_camera(tilt)
    random = np.random.default_rng(1)
    views = views_of(camera, random)
    np.testing.assert_allclose(left(solve_one(views)).rotation, camera.rotation, atol=2e-3)
    unknown = [replace(view, pose=None) if view.name == "left/1" else view for view in views]
    moved = PLAIN.model_copy(update={"moved": [Move(from_="left/0", to="left/1", along=(0.0, -1.0, 0.0))]})
    found = solve_rig({"left": unknown}, {"left": SIZE}, moved, {}).rig.cameras["left"]
    np.testing.assert_allclose(found.rotation, camera.rotation, atol=2e-3)
    alone = views_of(camera, random, poses=(FLAT,))
    found_both = [left(solve_one(alone, {"left": sign})) for sign in (1, -1)]
    away = [np.abs(option.rotation - camera.rotation).max() for option in found_both]
    assert min(away) < 2e-3
    assert max(away) > 0.1


def test_tilt_signs_mean_what_they_say(random: np.random.Generator) -> None:
    """Turned so that the board's right edge is farther, the sign is +."""
    for turn, sign in ((-10.0, 1), (10.0, -1)):
        square = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        rotation = Rotation.from_rotvec(np.radians([0.0, turn, 0.0])).as_matrix() @ square
        farther = (rotation @ [0.1, 0, 0])[2] > 0
        assert farther == (sign == 1)
        camera = replace(side_camera(), rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()))
        found = left(solve_one(views_of(camera, random, poses=(FLAT,)), {"left": sign}))
        np.testing.assert_allclose(found.rotation, camera.rotation, atol=2e-3)


def test_an_ambiguous_tilt_is_refused(random: np.random.Generator) -> None:
    views = views_of(side_camera((10.0, 0.0, 0.0)), random, poses=(FLAT,))
    with pytest.raises(InputError, match="which way"):
        solve_one(views)


def test_two_cameras_that_see_boards_together_agree(random: np.random.Generator) -> None:
    """One board of known place before each camera, in different planes, and twelve that both saw at once."""
    cameras = {"left": side_camera((8.0, 3.0, 0.0)), "top": top_camera()}
    above = WorldPose(origin_mm=(5.0, 30.0, 40.0), x_axis=(1, 0, 0), y_axis=(0, -1, 0))
    views: dict[str, list[View]] = {
        "left": [view_of(cameras["left"], FLAT, "left/0", True, 0.05, random)],
        "top": [view_of(cameras["top"], above, "top/0", True, 0.05, random)],
    }
    for number in range(12):
        turn = Rotation.from_rotvec(random.normal(0, 0.3, 3)).as_matrix()
        turn = turn @ Rotation.from_rotvec([np.radians(-45.0), 0, 0]).as_matrix() @ FLAT.rotation
        pose = WorldPose.model_construct(
            origin_mm=(10.0, 10.0, 30.0), x_axis=tuple(turn[:, 0]), y_axis=tuple(turn[:, 1])
        )
        for name, camera in cameras.items():
            view = view_of(camera, pose, f"{name}/{number + 5}", False, 0.05, random)
            views[name].append(replace(view, board=str(number + 5)))
    found = solve_rig(views, dict.fromkeys(cameras, SIZE), PLAIN, {}).rig.cameras
    for name, camera in cameras.items():
        np.testing.assert_allclose(found[name].rotation, camera.rotation, atol=2e-3)


def top_camera() -> OrthographicCamera:
    looks_down = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    rotation = Rotation.from_rotvec(np.radians([6.0, -4.0, 1.0])).as_matrix() @ looks_down
    return replace(side_camera(), rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()))


def test_too_few_or_too_flat_or_too_alike_views_are_refused(random: np.random.Generator) -> None:
    camera = side_camera()
    with pytest.raises(InputError, match="at least 4 pictures"):
        solve_one(views_of(camera, random)[:3])
    flat = [view_of(camera, FLAT, f"left/{i}", i == 0, 0.05, random) for i in range(6)]
    with pytest.raises(InputError, match="tilt the board"):
        solve_one(flat)
    alike = flat[:2]
    for number, tilt in enumerate((12.0, 18.0, 25.0, 33.0)):
        turn = Rotation.from_rotvec(np.radians(tilt) * FLAT.rotation[:, 0]).as_matrix() @ FLAT.rotation
        pose = WorldPose.model_construct(
            origin_mm=(20.0, 0.0, 25.0), x_axis=tuple(turn[:, 0]), y_axis=tuple(turn[:, 1])
        )
        alike.append(view_of(camera, pose, f"left/{number + 5}", False, 0.05, random))
    with pytest.raises(InputError, match="three directions"):
        solve_one(alike)


def test_a_real_lens_is_told_from_an_orthographic_one(random: np.random.Generator) -> None:
    """At 1 m a marker 10 mm off its plane is 0.64 mm wrong at 64 mm off-axis; the pinhole model is exact."""
    square = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    near = PinholeCamera(
        image_size=SIZE,
        rotation_vector=tuple(Rotation.from_matrix(square).as_rotvec()),
        focal=(9810.0, 9800.0),
        centre=(639.5, 359.5),
        translation=(-0.05, 0.02, 1.0),
        distortion=(-0.3, 1.0, 0.0, 0.0, 0.0),
    )
    solution = solve_one(views_of(near, random))
    nearness, sigma = solution.nearness["left"]
    assert nearness == pytest.approx(1.0, abs=0.05)
    assert sigma < 0.02
    assert solution.bias("left", 0.010) == pytest.approx(0.64e-3, rel=0.1)
    found = solve_one(views_of(near, random), model="pinhole").rig.cameras["left"]
    assert isinstance(found, PinholeCamera)
    points = random.uniform(0.0, 0.05, (50, 3))
    assert np.abs(found.project(points) - near.project(points)).max() < 0.15
    exact = solve_one(views_of(side_camera(), random))
    nearness, sigma = exact.nearness["left"]
    assert abs(nearness) < 4 * sigma
    with pytest.raises(InputError, match="orthographic model"):
        solve_one(views_of(side_camera(), random), model="pinhole")


def test_no_rig_is_mirrored_in_silence() -> None:
    """Random cameras and views: found as they are, or refused."""
    refused = 0
    for seed in range(12):
        random = np.random.default_rng(seed)
        camera = side_camera(tuple(random.uniform(-15, 15, 3)))
        poses = (FLAT, NEARER) if seed % 3 else (FLAT,)
        try:
            found = left(solve_one(views_of(camera, random, poses=poses)))
        except InputError:
            refused += 1
            continue
        assert np.abs(found.rotation - camera.rotation).max() < 5e-3
    assert refused <= 4
