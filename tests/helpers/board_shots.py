"""A calibration with its board images, drawn as its two cameras see the board."""

from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from rafl.calibration.board import CharucoPattern
from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import BoardSource, Rig, write_calibration

SIZE = (640, 480)
SCALE = 5000.0  # px/m
PATTERN = CharucoPattern(kind="charuco", squares=(9, 6), square_mm=10.0, marker_mm=7.5)
PRINT_PX = 60  # of a square
CORNER_MM = (-5.0, 0.0, 60.0)  # of the board in the first image, as the left camera sees it
TILTS = ((0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.35, 0.35, 0.1))  # of the board in the images after the first two [rad]


def _camera(axes: np.ndarray, plane: Plane) -> OrthographicCamera:
    rotation = tuple(Rotation.from_matrix(axes).as_rotvec().tolist())
    shift = (320.0 - SCALE * 0.04 * axes[0, 0], 240.0 + SCALE * 0.03)
    return OrthographicCamera(
        image_size=SIZE, scale=(SCALE, SCALE), rotation_vector=rotation, offset=shift, plane=plane, residual=0.03
    )


LEFT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
RIGHT = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
RIG = Rig(
    {
        "left": _camera(LEFT, Plane((0.0, -1.0, 0.0), 0.0, 5e-4)),
        "right": _camera(RIGHT, Plane((0.0, 1.0, 0.0), 0.03, 5e-4)),
    }
)


def board_image(camera: OrthographicCamera, origin: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The board as a camera sees it: `origin` [m] of its corner, `turn` (3, 3) from board to world."""
    columns, rows = PATTERN.squares
    print_size = (columns * PRINT_PX, rows * PRINT_PX)
    texture = PATTERN.opencv_board().generateImage(print_size, marginSize=0)
    per_px = 1e-3 * PATTERN.square_mm / PRINT_PX
    ends = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # in print pixels, whose first centre is half a pixel in
    pixels = camera.project(origin + per_px * (ends + 0.5) @ turn[:, :2].T)
    matrix = np.column_stack([pixels[1] - pixels[0], pixels[2] - pixels[0], pixels[0]])
    shown = cv2.warpAffine(texture, matrix, SIZE, flags=cv2.INTER_AREA, borderValue=128)
    return np.asarray(cv2.GaussianBlur(shown, None, 0.8), np.uint8)


def make_boards(folder: Path) -> Path:
    """Write calib.yaml, and five images for each camera of which `board.yaml` gives the pose in the first two."""
    world, images = {}, folder / "calibration"
    for name, camera in RIG.cameras.items():
        (images / name).mkdir(parents=True)
        axes = camera.rotation
        towards = -axes[2]
        corner = 1e-3 * np.array(CORNER_MM)
        if name == "right":
            corner = np.array([0.085, 0.03, 0.06])
        flat = axes.T
        for number, origin in enumerate((corner, corner + 0.02 * towards)):
            cv2.imwrite(str(images / name / f"{number:02d}.png"), board_image(camera, origin, flat))
            world[f"{name}/{number:02d}.png"] = {
                "origin_mm": np.round(1e3 * origin, 6).tolist(),
                "x_axis": axes[0].tolist(),
                "y_axis": axes[1].tolist(),
            }
        for number, tilt in enumerate(TILTS, start=2):
            turn = flat @ Rotation.from_rotvec(tilt).as_matrix()
            cv2.imwrite(str(images / name / f"{number:02d}.png"), board_image(camera, corner, turn))
    pattern = PATTERN.model_dump(mode="json")
    content = {"format": "rafl-board/1", "pattern": pattern, "world": world}
    (images / "board.yaml").write_text(yaml.safe_dump(content))
    write_calibration(folder / "calib.yaml", RIG, BoardSource(images, images / "board.yaml"))
    return folder / "calib.yaml"


def bend(path: Path) -> None:
    """Change an image as a board does that is bent: the last columns are some pixels off."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    moved = columns + 3.0 * np.sin(columns / 90.0)
    cv2.imwrite(str(path), cv2.remap(image, moved, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
