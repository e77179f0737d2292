import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from rafl.calibration.board import BoardFile, CharucoPattern

PATTERN = CharucoPattern(kind="charuco", squares=(8, 5), square_mm=10, marker_mm=7.5)
PIXELS_PER_SQUARE = 40  # of the drawn board, which is then enlarged by 1.5


def test_corner_coordinates_are_relative_to_pixel_centres() -> None:
    """A corner drawn between pixels k - 1 and k lies at 1.5 k + 19.5 in the enlarged image.

    The image is enlarged by 1.5 about pixel edges and gets a border of 20 px: u = 1.5 * (k - 0.5 + 0.5) - 0.5 + 20.
    """
    drawn = PATTERN.opencv_board().generateImage((8 * PIXELS_PER_SQUARE, 5 * PIXELS_PER_SQUARE), marginSize=0)
    enlarged = cv2.resize(drawn, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)
    image = cv2.copyMakeBorder(enlarged, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    found = PATTERN.find(image)
    points, pixels = found.points, found.pixels
    assert len(points) == 7 * 4
    expected = 1.5 * PIXELS_PER_SQUARE * points / 0.01 + 19.5
    assert np.abs(pixels - expected).max() < 0.05
    assert (pixels - expected).mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)


def test_image_without_a_board_gives_no_points() -> None:
    found = PATTERN.find(np.full((200, 300), 128, np.uint8))
    assert len(found.points) == len(found.pixels) == 0


BOARD_FILE = {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [9, 6], "spacing_mm": 10}}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"moved": [{"from": "a/0", "to": "a/0", "along": [0, 0, 1]}]}, "start where no other move ends"),
        (
            {
                "moved": [
                    {"from": "a/0", "to": "a/1", "along": [0, 0, 1]},
                    {"from": "a/1", "to": "a/2", "along": [0, 0, 1]},
                ]
            },
            "start where no other move ends",
        ),
        ({"moved": [{"from": "a/0", "to": "a/1", "along": [0, 0, 2]}]}, "length 1"),
        ({"world": {"a/0": {"origin_mm": [0, 0, 0], "x_axis": [1, 0, 0], "y_axis": [0.6, 0.8, 0]}}}, "right angle"),
    ],
)
def test_impossible_poses_and_moves_are_refused(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        BoardFile.model_validate(BOARD_FILE | keys)
