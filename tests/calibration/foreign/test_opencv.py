from pathlib import Path

import numpy as np
import pytest
import stereo

from rafl.calibration.foreign.read import read_any_calibration
from rafl.common.errors import InputError


def read_one(path: Path) -> np.ndarray:
    """Pixels of the points by the only camera of a file."""
    rig = read_any_calibration(path, "mm", lambda _: {"left": stereo.SIZE})
    return rig.cameras["left"].project(1e-3 * stereo.POINTS_MM)


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml"])
def test_opencvs_own_files_project_as_opencv_does(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"camera{suffix}"
    stereo.write_opencv(path, stereo.opencv_values("left"))
    np.testing.assert_allclose(read_one(path), stereo.opencv_pixels("left"), atol=1e-9)


@pytest.mark.parametrize(
    "pose",
    [
        {"R": stereo.rotation("left"), "T": stereo.TRANSLATIONS_MM["left"]},
        {"extrinsics": np.column_stack([stereo.rotation("left"), stereo.TRANSLATIONS_MM["left"]])},
        {"extrinsic_parameters": np.concatenate([stereo.ROTATIONS["left"], stereo.TRANSLATIONS_MM["left"]])[None]},
    ],
    ids=lambda pose: "+".join(pose),
)
def test_poses_are_read_in_all_forms(tmp_path: Path, pose: dict[str, object]) -> None:
    values = {key: value for key, value in stereo.opencv_values("left").items() if key not in ("rvec", "tvec")}
    stereo.write_opencv(tmp_path / "camera.yml", values | pose)
    np.testing.assert_allclose(read_one(tmp_path / "camera.yml"), stereo.opencv_pixels("left"), atol=1e-9)


def test_plain_lists_and_the_old_directive_are_read(tmp_path: Path) -> None:
    lines = ["%YAML:1.0", "---"]
    lines += [f"{key}: {np.asarray(value).tolist()}" for key, value in stereo.opencv_values("left").items()]
    (tmp_path / "camera.yml").write_text("\n".join(lines))
    np.testing.assert_allclose(read_one(tmp_path / "camera.yml"), stereo.opencv_pixels("left"), atol=1e-9)


@pytest.mark.parametrize("split", [False, True], ids=["one file", "two files"])
def test_stereo_pair_has_the_first_camera_as_world(tmp_path: Path, split: bool) -> None:
    turn, shift = stereo.relative_pose()
    intrinsics: dict[str, object] = {}
    for k, name in enumerate(stereo.MATRICES):
        intrinsics |= {f"M{k + 1}": stereo.MATRICES[name], f"D{k + 1}": np.array([stereo.DISTORTIONS[name]])}
    pose = {"R": turn, "T": shift, "R1": np.eye(3), "Q": np.eye(4)}
    if split:
        stereo.write_opencv(tmp_path / "intrinsics.yml", intrinsics)
        stereo.write_opencv(tmp_path / "extrinsics.yml", pose)
    else:
        stereo.write_opencv(tmp_path / "stereo.yml", intrinsics | pose)
    path = tmp_path if split else tmp_path / "stereo.yml"
    rig = read_any_calibration(path, "cm", lambda _: dict.fromkeys(stereo.MATRICES, stereo.SIZE))
    in_left = stereo.POINTS_MM @ stereo.rotation("left").T + stereo.TRANSLATIONS_MM["left"]
    for name in stereo.MATRICES:
        pixels = rig.cameras[name].project(1e-2 * in_left)
        np.testing.assert_allclose(pixels, stereo.opencv_pixels(name), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_matrix": np.eye(4)}, "cameramatrix: expected 9 numbers"),
        ({"camera_matrix": -np.eye(3)}, "positive fx"),
        ({"camera_matrix": stereo.MATRICES["left"].T}, "intrinsic matrix"),
        ({"distortion_coefficients": np.array([0, 0, 0, 0, 0, 0.1, 0, 0])}, "k4 are not 0; calibrate without"),
        ({"fisheye_model": 1}, "found a fisheye"),
        ({"rvec": 2 * np.eye(3)}, "no rotation"),
        ({"rvec": np.full(3, np.nan)}, "rvec: expected"),
        ({"tvec": np.zeros(2)}, "tvec: expected 3 numbers"),
        ({"image_width": -5}, "imagewidth and imageheight"),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, dict) else None,
)
def test_numbers_that_are_no_pinhole_camera_are_refused(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    stereo.write_opencv(tmp_path / "camera.yml", stereo.opencv_values("left") | changes)
    with pytest.raises(InputError, match=message):
        read_one(tmp_path / "camera.yml")


def test_zero_coefficients_of_further_models_are_accepted(tmp_path: Path) -> None:
    longer = {"distortion_coefficients": np.array([*stereo.DISTORTIONS["left"], 0, 0, 0, 0, 0, 0, 0, 0, 0])}
    stereo.write_opencv(tmp_path / "camera.yml", stereo.opencv_values("left") | longer)
    np.testing.assert_allclose(read_one(tmp_path / "camera.yml"), stereo.opencv_pixels("left"), atol=1e-9)


def test_calibration_of_the_lens_alone_is_refused(tmp_path: Path) -> None:
    values = {key: value for key, value in stereo.opencv_values("left").items() if key not in ("rvec", "tvec")}
    stereo.write_opencv(tmp_path / "camera.yml", values)
    with pytest.raises(InputError, match="of the lens alone"):
        read_one(tmp_path / "camera.yml")
    stereo.write_opencv(tmp_path / "camera.yml", values | {"extrinsic_parameters": np.zeros((20, 6))})
    with pytest.raises(InputError, match="found 120 numbers; keep the pose"):
        read_one(tmp_path / "camera.yml")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yml", "%YAML:1.0\n---\na: &a [1, 1]\nb: [*a, *a]\n", "aliases"),
        ("a.yml", "%YAML 1.2\n---\ncamera_matrix: " + "[" * 3000, "not readable"),
        ("a.yml", "%YAML 1.2\n---\ncamera_matrix: !!python/object:os.system {}\n", "not readable"),
        ("a.yml", "%YAML 1.2\n---\n- 1\n", "no keys and values"),
        (
            "a.yml",
            "camera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  data: [1, 2]\n",
            "found 2 numbers for 3 x 3",
        ),
        ("a.yml", "camera_matrix: !!opencv-matrix [1, 2]\n", "not readable"),
        ("a.xml", "<opencv_storage><camera_matrix>", "not readable"),
        ("a.xml", "<opencv_storage><a>1</a></opencv_storage>", "expected an intrinsic matrix"),
        ("a.xml", '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><x><M>&e;</M></x>', "not readable"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_one(tmp_path / name)
