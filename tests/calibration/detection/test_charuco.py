import cv2
import numpy as np
import pytest

from rafl.calibration.board import CharucoPattern


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("squares", [(9, 6), (6, 8), (8, 5)])
def test_both_layouts_are_recognised(squares: tuple[int, int], legacy: bool, random: np.random.Generator) -> None:
    """A board in an image of 8 megapixels: each corner is found at its place, whichever OpenCV made the board."""
    pattern = CharucoPattern(kind="charuco", squares=squares, square_mm=10, marker_mm=7.5)
    board = pattern.opencv_board()
    board.setLegacyPattern(legacy)
    side = 60
    print_ = board.generateImage((squares[0] * side, squares[1] * side), marginSize=0)
    view = np.array([[4.2, 0.3, 300.0], [-0.3, 3.9, 350.0], [6e-5, 4e-5, 1.0]])
    image = cv2.warpPerspective(print_, view, (3280, 2464), flags=cv2.INTER_AREA, borderValue=200)
    image = cv2.GaussianBlur(image, (0, 0), 1.5)
    found = pattern.find(np.clip(image * 0.7 + 40 + random.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    assert len(found.points) == (squares[0] - 1) * (squares[1] - 1)
    expected = cv2.perspectiveTransform((side * found.points / 0.01 - 0.5)[None], view)[0]
    assert np.abs(found.pixels - expected).max() < 0.2
