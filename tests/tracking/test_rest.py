"""`rafl-calibrate --from-rest`: cameras calibrated from videos of a specimen at rest."""

from pathlib import Path

import av
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import ROOT, Run, assert_refused
from synthetic import Scene, draw, expose
from typer.testing import CliRunner

from rafl.calibration.camera import Camera, OrthographicCamera, PinholeCamera
from rafl.calibration.rest_pose import camera_from_points
from rafl.calibration.rig import read_calibration
from rafl.common.errors import InputError
from rafl.tracking.cli import calibrate_app
from rafl.tracking.linking.layout import read_layout

SPECIMEN = ROOT / "datasets/specimens/canonical.yaml"
LAYOUT = read_layout(SPECIMEN)
SIZE = (960, 400)
FACING = {"y-min": [[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], "y-max": [[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]]}


def camera(face: str, tilt_deg: list[float], scale: float = 7.3e3) -> OrthographicCamera:
    rotation = Rotation.from_rotvec(np.radians(tilt_deg)).as_matrix() @ FACING[face]
    middle = scale * rotation[:2] @ [0.05, 0.015, 0.015]
    return OrthographicCamera(
        image_size=SIZE,
        scale=(scale, scale),
        rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()),
        offset=(480.0 - middle[0], 200.0 - middle[1]),
    )


def write_rest_video(path: Path, truth: Camera, face: str, shift: float = 0.0) -> None:
    """Ten frames of the dots of a face. In the last frame they are shifted by `shift` px."""
    path.parent.mkdir(exist_ok=True)
    markers = [k for k, name in enumerate(LAYOUT.names) if name.startswith("L" if face == "y-min" else "R")]
    pixels = truth.project(LAYOUT.positions[markers])
    scene, random = Scene(size=SIZE, noise=2.0, light_falloff=0.2), np.random.default_rng(5)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("ffv1", rate=100)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "gray"
        for frame in range(10):
            now = pixels + shift * (frame == 9)
            dots = np.column_stack([now, np.full((len(now), 2), 9.0), np.zeros(len(now))])
            image = expose(draw(scene, dots, random, np.zeros((len(now), 2))), scene, random)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        output.mux(stream.encode())


def test_two_cameras_with_one_face_each(run: Run, tmp_path: Path) -> None:
    """One camera is tilted and needs --tilt-sign; the other faces the specimen and needs none."""
    truth = {"left": camera("y-min", [3.0, 12.0, 2.0]), "right": camera("y-max", [0.0, 0.0, -4.0])}
    for (name, own), face in zip(truth.items(), FACING, strict=True):
        write_rest_video(tmp_path / f"rest/{name}.mkv", own, face)
    options = ["--from-rest", "rest", "--specimen", SPECIMEN, "--face", "left=y-min", "--face", "right=y-max"]
    assert_refused(run("rafl-calibrate", *options), "left", "--tilt-sign left=+", "12.")
    assert not (tmp_path / "calib.yaml").exists()
    depth = (truth["left"].rotation @ [1.0, 0.0, 0.0])[2]
    result = run("rafl-calibrate", *options, "--tilt-sign", f"left={'+' if depth > 0 else '-'}")
    assert result.returncode == 0, result.stderr
    assert "next: rafl-track" in result.stdout
    found = read_calibration(tmp_path / "calib.yaml").cameras
    for name, own in truth.items():
        item = found[name]
        assert isinstance(item, OrthographicCamera)
        assert item.scale == pytest.approx(own.scale, rel=2e-4)
        assert item.residual < 0.05
        assert (Rotation.from_matrix(item.rotation @ own.rotation.T)).magnitude() < np.radians(0.5)
        side = LAYOUT.positions[:16] if name == "left" else LAYOUT.positions[16:]
        np.testing.assert_allclose(item.project(side), own.project(side), atol=0.05)


def test_a_stereo_pair_of_another_program_is_placed_on_the_specimen(run: Run, tmp_path: Path) -> None:
    """Both cameras film one face; the file's world is the left camera's frame, and its unit the centimetre."""
    truth, tables = {}, []
    for name, angle in (("left", -12.0), ("right", 14.0)):
        rotation = Rotation.from_euler("y", angle, degrees=True).as_matrix() @ FACING["y-min"]
        translation = np.array([0.0, 0.0, 1.0]) - rotation @ [0.05, 0.015, 0.015]
        truth[name] = PinholeCamera(
            image_size=SIZE,
            rotation_vector=tuple(Rotation.from_matrix(rotation).as_rotvec()),
            focal=(7.3e3, 7.3e3),
            centre=(480.0, 200.0),
            translation=tuple(translation),
            distortion=(-0.5, 0.0, 0.0, 0.0, 0.0),
        )
        write_rest_video(tmp_path / f"rest/{name}.mkv", truth[name], "y-min")
        turn = rotation @ truth["left"].rotation.T
        shift = translation - turn @ np.array(truth["left"].translation)
        tables.append(
            f'[{name}]\nname = "{name}"\nmatrix = [[7300.0, 0.0, 480.0], [0.0, 7300.0, 200.0], [0.0, 0.0, 1.0]]\n'
            f"distortions = [-0.5, 0.0, 0.0, 0.0, 0.0]\nrotation = {turn.tolist()}\n"
            f"translation = {(1e2 * shift).tolist()}\n"
        )
    (tmp_path / "stereo.toml").write_text("\n".join(tables))
    options = ["--from-rest", "rest", "--specimen", SPECIMEN, "--calib", "stereo.toml", "--calib-unit", "cm"]
    faces = ["--face", "left=y-min", "--face", "right=y-min"]
    assert_refused(run("rafl-calibrate", *options, "--tilt-sign", "left=+"), "--tilt-sign")
    result = run("rafl-calibrate", *options, *faces)
    assert result.returncode == 0, result.stderr
    found = read_calibration(tmp_path / "calib.yaml").cameras
    for name, own in truth.items():
        np.testing.assert_allclose(found[name].project(LAYOUT.positions), own.project(LAYOUT.positions), atol=0.2)
        assert found[name].residual < 0.05
    (tmp_path / "rest/right.mkv").rename(tmp_path / "rest/far.mkv")
    (tmp_path / "calib.yaml").unlink()
    assert_refused(run("rafl-calibrate", *options, *faces), "image size of camera right", "left")
    assert not (tmp_path / "calib.yaml").exists()


def test_unsuitable_rest_videos_are_refused(run: Run, tmp_path: Path) -> None:
    write_rest_video(tmp_path / "still/left.mkv", camera("y-min", [0.0, 0.0, 0.0]), "y-min")
    write_rest_video(tmp_path / "moving/left.mkv", camera("y-min", [0.0, 0.0, 0.0]), "y-min", shift=6.0)
    rest = ["--from-rest", tmp_path / "still", "--specimen", SPECIMEN]
    assert_refused(run("rafl-calibrate", *rest), "camera left", "y-min, y-max equally well", "--face left=y-min")
    for given, words in (
        (["--from-rest", tmp_path / "moving", *rest[2:]], ("left.mkv", "at rest", "move by")),
        ([*rest, "--face", "left=front"], ("--face", "y-min", "left=front")),
        ([*rest, "--face", "left=x-max"], ("left.mkv", "x-max")),
        (rest[:2], ("--specimen",)),
        (["--from-rest", tmp_path / "nowhere", *rest[2:]], ("nowhere",)),
        ([], ("--from-rest",)),
    ):
        result = CliRunner().invoke(calibrate_app, [*map(str, given)])
        assert result.exit_code == 2
        assert all(word in result.stderr for word in words), result.stderr


@pytest.mark.parametrize("seed", range(20))
def test_markers_on_two_faces_determine_the_camera(seed: int) -> None:
    """Markers that are not coplanar leave no mirror ambiguity. The errors are within 4 sigma."""
    random = np.random.default_rng(seed)
    truth = camera("y-min", list(random.uniform(-1, 1, 3) * [10.0, 10.0, 180.0] + [-40.0, 0.0, 0.0]))
    points = np.concatenate([LAYOUT.positions[:16], LAYOUT.positions[:16][:, [0, 2, 1]] + [0.0, 0.0, 0.03]])
    pixels = truth.project(points) + random.normal(0, 0.3, (32, 2))
    found = camera_from_points(points, pixels, SIZE, "left").camera
    assert (Rotation.from_matrix(found.rotation @ truth.rotation.T)).magnitude() < np.radians(1.0)
    sigma = np.sqrt(np.diagonal(np.array(found.covariance)))
    assert abs(found.scale[0] - truth.scale[0]) < 4e3 * sigma[0]
    np.testing.assert_array_less(np.abs(np.array(found.offset) - truth.offset), 4 * sigma[6:8])


def test_collinear_or_too_few_markers_are_refused(random: np.random.Generator) -> None:
    truth = camera("y-min", [0.0, 0.0, 0.0])
    for points, words in ((LAYOUT.positions[:8], "one line"), (LAYOUT.positions[[0, 3, 9, 12]], "found 4")):
        with pytest.raises(InputError, match=words):
            camera_from_points(points, truth.project(points), SIZE, "left")
