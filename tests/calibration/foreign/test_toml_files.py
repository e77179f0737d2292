from pathlib import Path

import numpy as np
import pytest
import stereo

from rafl.calibration.foreign.read import read_any_calibration
from rafl.common.errors import InputError


def test_aniposelib_projects_as_opencv_does(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(stereo.aniposelib_text())
    rig = read_any_calibration(path, "mm")
    assert list(rig.cameras) == ["left", "right"]
    for name, camera in rig.cameras.items():
        np.testing.assert_allclose(camera.project(1e-3 * stereo.POINTS_MM), stereo.opencv_pixels(name), atol=1e-9)


def test_caliscope_cameras_take_the_filmed_names_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """The tables stand in the order of text, 10 before 2. An ignored camera is left out."""
    tables = [
        f"[cameras.{number}]\ncam_id = {number}\nsize = [{stereo.SIZE[0]}, {stereo.SIZE[1]}]\nrotation_count = 0\n"
        f"error = 0.3\nmatrix = {stereo.MATRICES[name].tolist()}\ndistortions = {stereo.DISTORTIONS[name]}\n"
        f"translation = {(1e-3 * stereo.TRANSLATIONS_MM[name]).tolist()}\nfisheye = false\n"
        f"rotation = {(stereo.rotation(name) if number == 2 else stereo.ROTATIONS[name]).tolist()}\n"
        for number, name in ((10, "right"), (2, "left"))
    ]
    ignored = "[cameras.3]\nsize = [9, 9]\nmatrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nignore = true\n"
    path = tmp_path / "camera_array.toml"
    path.write_text("\n".join([*tables, ignored]))
    rig = read_any_calibration(path, "m", lambda _: dict.fromkeys(stereo.MATRICES, (0, 0)))
    for name, camera in rig.cameras.items():
        assert camera.image_size == stereo.SIZE
        np.testing.assert_allclose(camera.project(1e-3 * stereo.POINTS_MM), stereo.opencv_pixels(name), atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("matrix", "matrices", "expected a table with a `matrix`"),
        ("rotation", "rotations", "camera left: expected the camera's `rotation` in the world"),
        ("size = [1280, 720]", 'size = ["wide", 720]', "camera left, size: expected 2 numbers"),
        ("14400.0", "nan", "not finite"),
        ("14400.0", "'f'", "expected 9 numbers"),
        ("[-0.2, 0.7, -0.001, 0.0005, 0.0]", "[1, 2, 3, 4, 5, 6]", "k4 are not 0"),
        ('"right"', '"right"\nfisheye = true', "camera right: .* found a fisheye"),
        ('"right"', '"left"', "names that differ"),
        ('"right"', '"../right"', "a name without slashes"),
        ('"right"', "7.5\n[", "found: "),
    ],
)
def test_bad_values_are_refused_with_camera_and_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = stereo.aniposelib_text()
    assert old in text
    path = tmp_path / "calibration.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_any_calibration(path, "mm")
