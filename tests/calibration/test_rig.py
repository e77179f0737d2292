from pathlib import Path

import pytest

from rafl.calibration.camera import OrthographicCamera, Perspective, Plane
from rafl.calibration.rig import Rig, read_calibration, write_calibration
from rafl.common.errors import InputError

CAMERA = OrthographicCamera(
    image_size=(640, 480),
    scale=(9000.0, 9010.0),
    skew=3.0,
    rotation_vector=(0.1, 1.5, -0.2),
    offset=(12.0, 34.0),
    distortion=(1e-3, 0.0),
    plane=Plane((0.0, -1.0, 0.0), 0.03, 4e-4),
    time_offset=0.002,
    residual=0.05,
    perspective=Perspective(1.5, -0.002, (320.0, 250.0)),
    covariance=tuple(tuple(float(i * j) for j in range(10)) for i in range(10)),
)


def test_written_rig_reads_back(tmp_path: Path) -> None:
    write_calibration(tmp_path / "calib.yaml", Rig({"left": CAMERA}))
    back = read_calibration(tmp_path / "calib.yaml").cameras["left"]
    assert isinstance(back, OrthographicCamera)
    for key in ("scale", "rotation_vector", "offset", "distortion"):
        assert getattr(back, key) == pytest.approx(getattr(CAMERA, key))
    assert back.plane is not None
    assert back.plane.normal == (0.0, -1.0, 0.0)
    assert back.plane.offset == pytest.approx(0.03)
    assert back.plane.sigma == pytest.approx(4e-4)
    assert (back.skew, back.time_offset, back.residual) == pytest.approx((3.0, 0.002, 0.05))
    assert back.covariance == CAMERA.covariance
    assert back.perspective == CAMERA.perspective


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rafl-calibration/1", "rafl-calibration/2", "newer"),
        ("orthographic", "fisheye", "left"),
        ("orthographic", "pinhole", "focal_px"),
        ("skew", "skewed", "skewed"),
        ("[640, 480]", "[640, 0]", "positive"),
        ("[0.0, -1.0, 0.0]", "[0.0, -2.0, 0.0]", "length 1"),
    ],
)
def test_error_in_a_bad_file_names_the_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "calib.yaml"
    write_calibration(path, Rig({"left": CAMERA}))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_calibration(path)
