from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import stereo

from rafl.calibration.foreign.read import read_any_calibration
from rafl.common.errors import InputError


def test_stereo_parameters_project_as_opencv_does(tmp_path: Path) -> None:
    """The world is the frame of camera 1. Unit and image size are in the file, the names are not."""
    stereo.write_matlab_stereo(tmp_path / "stereo.mat")
    rig = read_any_calibration(tmp_path / "stereo.mat", None, lambda _: dict.fromkeys(stereo.MATRICES, (0, 0)))
    in_left = stereo.POINTS_MM @ stereo.rotation("left").T + stereo.TRANSLATIONS_MM["left"]
    for name, camera in rig.cameras.items():
        assert camera.image_size == stereo.SIZE
        np.testing.assert_allclose(camera.project(1e-3 * in_left), stereo.opencv_pixels(name), atol=1e-9)


@pytest.mark.parametrize("of_rows", [True, False])
def test_cameras_with_pose_in_either_convention(tmp_path: Path, of_rows: bool) -> None:
    structs = {}
    for name in stereo.MATRICES:
        struct = stereo.matlab_struct(name)
        matrix, rotation = np.asarray(struct.pop("IntrinsicMatrix")), stereo.rotation(name)
        structs[name] = struct | {
            "K": matrix if of_rows else matrix.T,
            "R": rotation.T if of_rows else rotation,
            "t": stereo.TRANSLATIONS_MM[name],
        }
    scipy.io.savemat(tmp_path / "rig.mat", structs)
    for name, camera in read_any_calibration(tmp_path / "rig.mat").cameras.items():
        np.testing.assert_allclose(camera.project(1e-3 * stereo.POINTS_MM), stereo.opencv_pixels(name), atol=1e-9)


def test_one_camera_of_plain_variables(tmp_path: Path) -> None:
    one = {"K": stereo.MATRICES["left"], "R": stereo.rotation("left"), "t": stereo.TRANSLATIONS_MM["left"]}
    scipy.io.savemat(tmp_path / "camera.mat", one)
    with pytest.raises(InputError, match="does not state the unit"):
        read_any_calibration(tmp_path / "camera.mat")
    with pytest.raises(InputError, match="expected the image size"):
        read_any_calibration(tmp_path / "camera.mat", "mm")
    rig = read_any_calibration(tmp_path / "camera.mat", "mm", lambda _: {"left": stereo.SIZE})
    pixels = rig.cameras["left"].project(1e-3 * stereo.POINTS_MM)
    np.testing.assert_allclose(pixels, stereo.opencv_pixels("left", distorted=False) - 1.0, atol=1e-9)


def test_a_unit_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    stereo.write_matlab_stereo(tmp_path / "stereo.mat")
    with pytest.raises(InputError, match=r"states a unit of 0\.001 m, found --calib-unit cm"):
        read_any_calibration(tmp_path / "stereo.mat", "cm")


def test_what_only_matlab_can_read_says_how_to_export(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        file["K"] = np.eye(3)
    with (tmp_path / "new.mat").open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    scipy.io.savemat(tmp_path / "other.mat", {"stereoParams": [1.0, 2.0]})
    (tmp_path / "text.mat").write_text("K = eye(3)")
    for name, message in (("new", "found 7.3"), ("other", "found the array"), ("text", "found none")):
        with pytest.raises(InputError, match=rf"{message}.*toStruct\(stereoParams\)"):
            read_any_calibration(tmp_path / f"{name}.mat", "mm")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("IntrinsicMatrix", np.ones((3, 3)), "CameraParameters1, IntrinsicMatrix: expected an intrinsic matrix"),
        ("IntrinsicMatrix", np.eye(3) + 1j, "expected 9 numbers"),
        ("IntrinsicMatrix", "eye", "expected 9 numbers"),
        ("RadialDistortion", [np.nan, 0.0], "not finite"),
        ("ImageSize", [0.0, 5.0], "a width and a height in px"),
        ("ImageSize", [1e9, 5.0], "a width and a height in px"),
    ],
)
def test_bad_values_are_refused(tmp_path: Path, key: str, value: object, message: str) -> None:
    pair = {"CameraParameters1": stereo.matlab_struct("left") | {key: value}, "CameraParameters2": np.zeros(3)}
    scipy.io.savemat(tmp_path / "stereo.mat", {"s": pair})
    with pytest.raises(InputError, match=message):
        read_any_calibration(tmp_path / "stereo.mat", "mm")
