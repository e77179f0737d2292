"""`rafl-calibrate` on pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support import Run, assert_refused

from calibration.rig import read_rig

SCALE = 9.0  # px/mm


def dot_grid_picture(tilt: np.ndarray, supersampling: int = 4) -> np.ndarray:
    """A printed grid of 9 x 6 dots of 5 mm at 10 mm, turned by a rotation vector, seen from the front."""
    turned = SCALE * Rotation.from_rotvec(tilt).as_matrix()[:2, :2]
    size = (900, 640)
    u, v = np.meshgrid(*(np.arange(n * supersampling) / supersampling - 0.5 + 0.5 / supersampling for n in size))
    board = np.stack([u - 100.0, v - 90.0], axis=-1) @ np.linalg.inv(turned).T
    nearest = np.clip(np.rint(board / 10.0), 0, [8, 5]) * 10.0
    dark = np.linalg.norm(board - nearest, axis=-1) < 2.5
    picture = np.where(dark, 30.0, 210.0)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


@pytest.fixture
def dot_grid(tmp_path: Path) -> Path:
    folder = tmp_path / "grid"
    folder.mkdir()
    tilts = [
        [0, 0, 0],
        [0.4, 0, 0],
        [0, 0.45, 0],
        [0.3, 0.3, 0],
        [-0.3, 0.35, 0.05],
        [0.2, -0.4, 0],
        [-0.5, 0.1, 0],
    ]
    for number, tilt in enumerate(tilts):
        cv2.imwrite(str(folder / f"{number}.png"), dot_grid_picture(np.array(tilt)))
    (folder / "board.yaml").write_text(
        "format: rafl-board/1\npattern: {kind: dot-grid, dots: [9, 6], spacing_mm: 10}\n"
    )
    return folder


def test_a_dot_grid_before_one_camera(dot_grid: Path, run: Run, tmp_path: Path) -> None:
    result = run("rafl-calibrate", dot_grid, "--out", "calib.yaml")
    assert result.returncode == 0, result.stderr
    assert "next: rafl-track" in result.stdout
    (camera,) = read_rig(tmp_path / "calib.yaml").cameras.values()
    assert camera.scale == pytest.approx((9000.0, 9000.0), rel=1e-3)
    assert camera.residual < 0.1
    # The first picture's board is the world: its first dot is the origin, at pixel (100, 90).
    assert camera.offset == pytest.approx((100.0, 90.0), abs=0.1)


def test_bad_input(dot_grid: Path, run: Run, tmp_path: Path) -> None:
    board = (dot_grid / "board.yaml").read_text()

    def refused(*parts: str) -> None:
        assert_refused(run("rafl-calibrate", dot_grid, "--out", "calib.yaml"), *parts)
        assert not (tmp_path / "calib.yaml").exists()

    assert_refused(run("rafl-calibrate", "nowhere"), "nowhere", "check the path")
    (dot_grid / "board.yaml").unlink()
    refused("board.yaml", "found nothing")
    (dot_grid / "board.yaml").write_text(board.replace("dot-grid", "circles"))
    refused("pattern", "circles")
    (dot_grid / "board.yaml").write_text(board.replace("[9, 6]", "[12, 8]"))
    refused("camera grid", "at least 4 pictures")
    world = {"grid/9.png": {"origin_mm": [0, 0, 0], "x_axis": [1, 0, 0], "y_axis": [0, 1, 0]}}
    (dot_grid / "board.yaml").write_text(board + yaml.safe_dump({"world": world}))
    refused("grid/9.png", "not among the pictures")
    (dot_grid / "board.yaml").write_text(board)
    (dot_grid / "3.png").write_bytes(b"not a picture")
    refused("3.png", "cannot be read")
    cv2.imwrite(str(dot_grid / "3.png"), np.zeros((100, 100), np.uint8))
    refused("pictures of one size", "100 x 100")
