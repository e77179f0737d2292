import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from rafl.calibration.board import BoardFile, CharucoPattern

PATTERN = CharucoPattern(kind="charuco", squares=(8, 5), square_mm=10, marker_mm=7.5)
PRINT = 40  # print pixels per square; the picture shows it at 1.5 times that


def test_corners_count_from_pixel_centres() -> None:
    """A corner drawn between print pixels k - 1 and k lies at 1.5 k + 19.5 of the enlarged picture.

    Enlarged by 1.5 about pixel edges and framed by 20 px: u = 1.5 * (k - 0.5 + 0.5) - 0.5 + 20.
    """
    print_ = PATTERN.opencv_board().generateImage((8 * PRINT, 5 * PRINT), marginSize=0)
    large = cv2.resize(print_, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)
    image = cv2.copyMakeBorder(large, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    points, pixels = PATTERN.find(image)
    assert len(points) == 7 * 4
    expected = 1.5 * PRINT * points / 0.01 + 19.5
    assert np.abs(pixels - expected).max() < 0.05
    assert (pixels - expected).mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)


def test_no_board() -> None:
    points, pixels = PATTERN.find(np.full((200, 300), 128, np.uint8))
    assert len(points) == len(pixels) == 0


PLAIN = {"format": "rafl-board/1", "pattern": {"kind": "dot-grid", "dots": [9, 6], "spacing_mm": 10}}


@pytest.mark.parametrize(
    ("more", "part"),
    [
        ({"moved": [{"from": "a/0", "to": "a/0", "along": [0, 0, 1]}]}, "start where no other ends"),
        (
            {
                "moved": [
                    {"from": "a/0", "to": "a/1", "along": [0, 0, 1]},
                    {"from": "a/1", "to": "a/2", "along": [0, 0, 1]},
                ]
            },
            "start where no other ends",
        ),
        ({"moved": [{"from": "a/0", "to": "a/1", "along": [0, 0, 2]}]}, "length 1"),
        ({"world": {"a/0": {"origin_mm": [0, 0, 0], "x_axis": [1, 0, 0], "y_axis": [0.6, 0.8, 0]}}}, "right angle"),
    ],
)
def test_impossible_places_are_refused(more: dict[str, object], part: str) -> None:
    with pytest.raises(ValidationError, match=part):
        BoardFile.model_validate(PLAIN | more)
