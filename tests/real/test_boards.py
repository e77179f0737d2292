"""Photographs of calibration boards: a chessboard held by hand, and a dot target seen by two cameras."""

from pathlib import Path

import numpy as np
import pytest
from support import SHARED

from rafl.calibration.board import BoardFile
from rafl.calibration.board_images import board_views
from rafl.calibration.camera import PinholeCamera
from rafl.calibration.solve import solve_rig

CHESSBOARD = SHARED / "real" / "checkerboard"
TARGET = SHARED / "real" / "dot_target"

pytestmark = pytest.mark.real


def description(simultaneous: bool, **pattern: object) -> BoardFile:
    return BoardFile.model_validate({"format": "rafl-board/1", "pattern": pattern, "simultaneous": simultaneous})


@pytest.mark.slow
@pytest.mark.skipif(not CHESSBOARD.is_dir(), reason=f"no photographs in {CHESSBOARD}")
def test_handheld_chessboard_calibrates_a_pinhole() -> None:
    """The board has 14 x 19 inner corners. OpenCV's calibrateCamera leaves 0.30 px in each coordinate."""
    board = description(False, kind="chessboard", corners=[14, 19], square_mm=10)
    views, sizes = board_views(CHESSBOARD, board)
    assert [len(view.points) for view in views["checkerboard"]] == [14 * 19] * 12
    camera = solve_rig(views, sizes, board, {}, "pinhole").rig.cameras["checkerboard"]
    assert isinstance(camera, PinholeCamera)
    assert camera.residual < 0.3
    assert camera.focal == pytest.approx((2600.0, 2603.0), rel=0.01)


@pytest.mark.skipif(not TARGET.is_dir(), reason=f"no photographs in {TARGET}")
def test_ringed_target_calibrates_two_cameras(tmp_path: Path) -> None:
    """The target is larger than the images and not printed exactly."""
    for path in sorted(TARGET.glob("*.jpeg")):
        number, camera = path.stem.split("-")
        (tmp_path / camera).mkdir(exist_ok=True)
        (tmp_path / camera / f"{number}.jpeg").symlink_to(path)
    board = description(True, kind="dot-grid", rings=[5, -3], spacing_mm=10)
    views, sizes = board_views(tmp_path, board)
    for own in views.values():
        assert len(own) == 8
        assert all(view.origin_known and len(view.points) >= 80 for view in own)
    solution = solve_rig(views, sizes, board, {}, "pinhole")
    assert max(camera.residual for camera in solution.rig.cameras.values()) < 0.1
    assert solution.board_error == pytest.approx(0.02e-3, rel=0.2)
    left, right = (camera.rotation for camera in solution.rig.cameras.values())
    angle = np.degrees(np.arccos((np.trace(left @ right.T) - 1.0) / 2.0))
    assert angle == pytest.approx(26.0, abs=1.5)
