"""The command `rafl-calibrate` on rendered board images."""

import functools
import itertools
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support import Run, assert_refused

from rafl.calibration.rig import read_calibration

SCALE = 9.0  # px/mm


@functools.cache
def board_image(tilt: tuple[float, float, float], kind: str = "dots", supersampling: int = 4) -> np.ndarray:
    """A tilted board: 9 x 6 dots of 5 mm, 10 mm apart, or a chessboard with as many inner corners."""
    to_board = np.linalg.inv(SCALE * Rotation.from_rotvec(tilt).as_matrix()[:2, :2])
    u, v = np.arange(900)[None] - 100.0, np.arange(640)[:, None] - 90.0
    dark = np.zeros((640, 900))
    offsets = (np.arange(supersampling) + 0.5) / supersampling - 0.5
    for du, dv in itertools.product(offsets, offsets):  # one array of all samples would not fit in the caches
        x, y = (row[0] * (u + du) + row[1] * (v + dv) for row in to_board)
        if kind == "squares":
            inside = (x > -10) & (x < 90) & (y > -10) & (y < 60)
            dark += inside & ((np.floor(x / 10.0) + np.floor(y / 10.0)) % 2 == 0)
        else:
            to_centre = (x - 10.0 * np.clip(np.rint(x / 10.0), 0, 8)) ** 2 + (
                y - 10.0 * np.clip(np.rint(y / 10.0), 0, 5)
            ) ** 2
            dark += to_centre < 2.5**2
    return np.asarray(210.0 - 180.0 * dark / supersampling**2).astype(np.uint8)


TILTS = [[0, 0, 0], [0.4, 0, 0], [0, 0.45, 0], [0.3, 0.3, 0], [-0.3, 0.35, 0.05], [0.2, -0.4, 0], [-0.5, 0.1, 0]]


@pytest.fixture
def dot_grid(tmp_path: Path) -> Path:
    folder = tmp_path / "grid"
    folder.mkdir()
    for number, tilt in enumerate(TILTS):
        cv2.imwrite(str(folder / f"{number}.png"), board_image(tuple(tilt)))
    (folder / "board.yaml").write_text(
        "format: rafl-board/1\npattern: {kind: dot-grid, dots: [9, 6], spacing_mm: 10}\n"
    )
    return folder


def test_an_image_that_is_there_twice_is_refused(dot_grid: Path, run: Run) -> None:
    (dot_grid / "copy.png").write_bytes((dot_grid / "3.png").read_bytes())
    assert_refused(run("rafl-calibrate", dot_grid, "--out", "calib.yaml"), "expected different images", "copy.png")


def test_dot_grid_calibrates_one_camera(dot_grid: Path, run: Run, tmp_path: Path) -> None:
    result = run("rafl-calibrate", dot_grid, "--out", "calib.yaml")
    assert result.returncode == 0, result.stderr
    assert "next: rafl-track" in result.stdout
    (camera,) = read_calibration(tmp_path / "calib.yaml").cameras.values()
    assert camera.scale == pytest.approx((9000.0, 9000.0), rel=1e-3)
    assert camera.residual < 0.1
    # The board in the first image is the world frame: its first dot is the origin, at pixel (100, 90).
    assert camera.offset == pytest.approx((100.0, 90.0), abs=0.1)
    # The axes start there: x is red and runs to the right, y is green and runs down.
    picture = cv2.imread(str(tmp_path / "calib-grid.png")).astype(int)
    assert picture.shape == (640, 900, 3)
    blue, green, red = np.moveaxis(picture, -1, 0)
    right, down = (red - green > 100) & (red - blue > 100), (green - red > 100) & (green - blue > 100)
    assert right[90, 160:300].all()
    assert down[160:250, 100].all()


def test_chessboard_calibration_is_checked_on_other_images(run: Run, tmp_path: Path) -> None:
    """A calibration from seven images fits two others; one with a wrong skew has at least twice the residual."""
    for folder, tilts in (("made", TILTS), ("held", [[0.25, 0.2, 0.03], [-0.2, 0.3, 0.0]])):
        (tmp_path / folder).mkdir()
        for number, tilt in enumerate(tilts):
            cv2.imwrite(str(tmp_path / folder / f"{number}.png"), board_image(tuple(tilt), "squares"))
        (tmp_path / folder / "board.yaml").write_text(
            "format: rafl-board/1\npattern: {kind: chessboard, corners: [9, 6], square_mm: 10}\n"
        )
    result = run("rafl-calibrate", "made", "--out", "calib.yaml")
    assert result.returncode == 0, result.stderr
    text = (tmp_path / "calib.yaml").read_text()
    (camera,) = read_calibration(tmp_path / "calib.yaml").cameras.values()
    assert camera.scale == pytest.approx((9000.0, 9000.0), rel=1e-3)
    (tmp_path / "calib.yaml").write_text(text.replace("made:", "held:"))
    result = run("rafl-calibrate", "held", "--check", "calib.yaml")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "check-held.png").stat().st_size > 5000
    residuals = [float(line.split("│")[4]) for line in result.stdout.splitlines() if "held/" in line]
    assert max(residuals) < 0.2
    wrong = re.sub(r"skew: .*", "skew: 0.3", text.replace("made:", "held:"))
    (tmp_path / "calib.yaml").write_text(wrong)
    result = run("rafl-calibrate", "held", "--check", "calib.yaml")
    wrong_residuals = [float(line.split("│")[4]) for line in result.stdout.splitlines() if "held/" in line]
    assert min(wrong_residuals) > 2 * max(residuals)


def test_bad_input_is_refused(dot_grid: Path, run: Run, tmp_path: Path) -> None:
    board = (dot_grid / "board.yaml").read_text()

    def refused(*parts: str) -> None:
        assert_refused(run("rafl-calibrate", dot_grid, "--out", "calib.yaml"), *parts)
        assert not (tmp_path / "calib.yaml").exists()

    assert_refused(run("rafl-calibrate", "nowhere"), "nowhere", "check the path")
    (dot_grid / "board.yaml").unlink()
    refused("board.yaml", "found nothing")
    (dot_grid / "board.yaml").write_text(board.replace("dot-grid", "circles"))
    refused("pattern", "circles")
    (dot_grid / "board.yaml").write_text(board.replace("[9, 6]", "[8, 6]"))
    refused(".png", "found one of 9 x 6 points", "correct the pattern")
    world = {"grid/9.png": {"origin_mm": [0, 0, 0], "x_axis": [1, 0, 0], "y_axis": [0, 1, 0]}}
    (dot_grid / "board.yaml").write_text(board + yaml.safe_dump({"world": world}))
    refused("grid/9.png", "not among the images")
    (dot_grid / "board.yaml").write_text(board)
    (dot_grid / "3.png").write_bytes(b"not an image")
    refused("3.png", "cannot be read")
    huge = bytearray(cv2.imencode(".bmp", np.zeros((8, 8), np.uint8))[1].tobytes())
    huge[18:26] = b"\0\0\1\0" * 2  # a header that claims 65536 x 65536 px; the file suffix does not matter
    (dot_grid / "3.png").write_bytes(huge)
    refused("3.png", "at most 100 megapixels")
    cv2.imwrite(str(dot_grid / "3.png"), np.zeros((100, 100), np.uint8))
    refused("images of one size", "100 x 100")
