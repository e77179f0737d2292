from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import stereo
from support import SHARED

from rafl.calibration.camera import PinholeCamera
from rafl.calibration.foreign.read import MAX_BYTES, read_any_calibration
from rafl.calibration.rig import Rig, write_calibration
from rafl.common.errors import InputError

EXAMPLES = SHARED / "cases/foreign/calibs"


def filmed(_count: int) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(stereo.MATRICES, stereo.SIZE)


def write_folder(folder: Path) -> None:
    folder.mkdir()
    for name, suffix in (("left", ".yml"), ("right", ".xml")):
        stereo.write_opencv(folder / f"{name}{suffix}", stereo.opencv_values(name))


def write_aniposelib(path: Path) -> None:
    path.write_text(stereo.aniposelib_text())


def test_a_folder_has_one_camera_a_file(tmp_path: Path) -> None:
    write_folder(tmp_path / "cameras")
    rig = read_any_calibration(tmp_path / "cameras", "mm")
    for name, camera in rig.cameras.items():
        np.testing.assert_allclose(camera.project(1e-3 * stereo.POINTS_MM), stereo.opencv_pixels(name), atol=1e-9)
    (tmp_path / "cameras/both.mat").write_bytes(b"")
    with pytest.raises(InputError, match=r"both\.mat: expected a MAT file"):
        read_any_calibration(tmp_path / "cameras", "mm")


def test_calib_yaml_is_read_and_states_its_unit(tmp_path: Path) -> None:
    write_aniposelib(tmp_path / "calibration.toml")
    rig = read_any_calibration(tmp_path / "calibration.toml", "mm")
    assert isinstance(rig.cameras["left"], PinholeCamera)
    skewed = Rig({"left": replace(rig.cameras["left"], skew=0.5)})
    write_calibration(tmp_path / "calib.yaml", skewed)
    back = read_any_calibration(tmp_path / "calib.yaml").cameras["left"]
    points = 1e-3 * stereo.POINTS_MM
    np.testing.assert_allclose(back.project(points), skewed.cameras["left"].project(points), atol=1e-9)
    assert np.abs(back.project(points) - rig.cameras["left"].project(points)).max() > 1e-3
    with pytest.raises(InputError, match="states its unit"):
        read_any_calibration(tmp_path / "calib.yaml", "mm")


def test_units_and_names_are_not_guessed(tmp_path: Path) -> None:
    write_aniposelib(tmp_path / "calibration.toml")
    with pytest.raises(InputError, match=r"does not state the unit of its translations; .*--calib-unit mm"):
        read_any_calibration(tmp_path / "calibration.toml")
    with pytest.raises(InputError, match="expected a unit out of mm, cm, m, found 'feet'"):
        read_any_calibration(tmp_path / "calibration.toml", "feet")
    stereo.write_dlt(tmp_path / "dlt.csv")
    with pytest.raises(InputError, match=r"as were filmed \(a, b, c\), found 2 without names"):
        read_any_calibration(tmp_path / "dlt.csv", "mm", lambda _: dict.fromkeys("abc", stereo.SIZE))
    text = stereo.aniposelib_text().replace("size = [1280, 720]\n", "")
    (tmp_path / "calibration.toml").write_text(text)
    with pytest.raises(InputError, match=r"image size of camera left.*among those of A, B"):
        read_any_calibration(tmp_path / "calibration.toml", "mm", lambda _: dict.fromkeys("AB", stereo.SIZE))
    assert read_any_calibration(tmp_path / "calibration.toml", "mm", filmed).cameras["left"].image_size == stereo.SIZE


def test_cameras_at_one_place_are_refused(tmp_path: Path) -> None:
    for name in ("left", "right"):
        stereo.write_opencv(tmp_path / f"{name}.yml", stereo.opencv_values("left"))
    with pytest.raises(InputError, match="found left and right at the same"):
        read_any_calibration(tmp_path, "mm")


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("text")
    (tmp_path / "huge.toml").write_bytes(b"#" * (MAX_BYTES + 1))
    (tmp_path / "empty").mkdir()
    messages = {
        "calib.txt": "file type '.txt'",
        "huge.toml": "found a file of 4 MB",
        "empty": "found none",
        "absent.toml": "found nothing there",
    }
    for name, message in messages.items():
        with pytest.raises(InputError, match=message):
            read_any_calibration(tmp_path / name, "mm")


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("camera.yml", lambda path: stereo.write_opencv(path, stereo.opencv_values("left"))),
        ("camera.xml", lambda path: stereo.write_opencv(path, stereo.opencv_values("left"))),
        ("calibration.toml", write_aniposelib),
        ("stereo.mat", stereo.write_matlab_stereo),
        ("dlt.csv", stereo.write_dlt),
    ],
)
def test_mutated_files_give_cameras_or_an_error(
    tmp_path: Path, name: str, write: Callable[[Path], None], random: np.random.Generator
) -> None:
    """Changed, missing and repeated bytes never give anything but finite cameras or an `InputError`."""
    path = tmp_path / name
    write(path)
    original = path.read_bytes()
    lines = []
    for number in range(150):
        changed = bytearray(original)
        position = int(random.integers(0, len(original)))
        if number % 3 == 0:
            for index in random.integers(0, len(original), int(random.integers(1, 12))):
                changed[int(index)] = int(random.integers(0, 256))
        elif number % 3 == 1:
            changed = changed[:position]
        else:
            changed[position:position] = original[position : position + int(random.integers(1, 200))]
        path.write_bytes(changed)
        try:
            rig = read_any_calibration(path, None if name == "stereo.mat" else "mm", filmed_one_or_two)
        except InputError as error:
            lines.append(str(error))
            continue
        for camera in rig.cameras.values():
            assert isinstance(camera, PinholeCamera)
            assert np.isfinite([*camera.focal, *camera.centre, *camera.translation, *camera.rotation_vector]).all()
    assert len(lines) > 30
    assert not any("\n" in line for line in lines)


def filmed_one_or_two(count: int) -> dict[str, tuple[int, int]]:
    return dict(list(filmed(count).items())[:count])


@pytest.mark.skipif(not EXAMPLES.is_dir(), reason=f"needs the calibrations in {EXAMPLES}")
def test_examples_of_other_programs_are_read() -> None:
    paths = [path for path in sorted(EXAMPLES.iterdir()) if path.is_file()]
    assert len(paths) >= 4
    for path in paths:
        rig = read_any_calibration(path, "mm", filmed_one_or_two)
        assert all(isinstance(camera, PinholeCamera) for camera in rig.cameras.values())
