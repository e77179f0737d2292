"""Calibration boards: their patterns, their known poses, and the detection of their points in an image."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator, model_validator
from scipy.spatial import cKDTree

from rafl.calibration.fields import Direction
from rafl.common.errors import InputError
from rafl.common.yaml_files import StrictModel, read_yaml

Array = NDArray[Any]

FORMAT = "rafl-board/1"
MIN_POINTS = 8


class WorldPose(StrictModel):
    """Pose of the board in one image: its origin and the directions of its axes, in the world frame."""

    origin_mm: tuple[float, float, float]
    x_axis: Direction
    y_axis: Direction

    @model_validator(mode="after")
    def _check_right_angle(self) -> "WorldPose":
        if not abs(np.dot(self.x_axis, self.y_axis)) < 1e-3:
            raise ValueError("expected axes at a right angle")
        return self

    @property
    def rotation(self) -> Array:
        """Rotation from board to world, (3, 3)."""
        x, y = np.asarray(self.x_axis), np.asarray(self.y_axis)
        return np.stack([x, y, np.cross(x, y)], axis=1)

    @property
    def origin(self) -> Array:
        """World position of the board's origin [m], (3)."""
        return 1e-3 * np.asarray(self.origin_mm)


class CharucoPattern(StrictModel):
    """A ChArUco board of `squares` columns x rows. Origin: top left corner; x right, y down."""

    kind: Literal["charuco"]
    squares: tuple[int, int]
    square_mm: float = Field(gt=0)
    marker_mm: float = Field(gt=0)
    dictionary: str = "DICT_4X4_250"

    @field_validator("dictionary")
    @classmethod
    def _check_dictionary(cls, name: str) -> str:
        if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
            raise ValueError("expected the name of an OpenCV dictionary, for instance DICT_4X4_250")
        return name

    def opencv_board(self) -> "cv2.aruco.CharucoBoard":
        """The board as an OpenCV object, lengths in metres."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard(self.squares, 1e-3 * self.square_mm, 1e-3 * self.marker_mm, dictionary)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Detect the board in a grey image: its points (P, 2) [m] and their pixels (P, 2)."""
        board = self.opencv_board()
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is None or len(ids) < MIN_POINTS:
            return np.zeros((0, 2)), np.zeros((0, 2))
        points = np.asarray(board.getChessboardCorners(), dtype=float)[ids.ravel(), :2]
        # The pixel origin of these corners is a pixel's edge in OpenCV 4 and its centre in OpenCV 5. Refined corners
        # are relative to the centre in both.
        spacing = cKDTree(corners.reshape(-1, 2)).query(corners.reshape(-1, 2), 2)[0][:, 1].min()
        half = int(np.clip(0.15 * spacing, 2, 10))
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        refined = cv2.cornerSubPix(image, np.array(corners, dtype=np.float32), (half, half), (-1, -1), stop)
        return points, np.asarray(refined, dtype=float).reshape(-1, 2)


class DotGridPattern(StrictModel):
    """A grid of `dots` columns x rows of dark dots. Origin: the corner dot nearest the top left of the image."""

    kind: Literal["dot-grid"]
    dots: tuple[int, int]
    spacing_mm: float = Field(gt=0)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Detect the board in a grey image: its points (P, 2) [m] and their pixels (P, 2)."""
        columns, rows = self.dots
        found, centres = cv2.findCirclesGrid(image, (columns, rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 2))
        return _order_grid(np.asarray(centres, dtype=float), self.dots, self.spacing_mm)


class ChessboardPattern(StrictModel):
    """A chessboard of `corners` columns x rows of inner corners. Origin: that nearest the top left of the image."""

    kind: Literal["chessboard"]
    corners: tuple[int, int]
    square_mm: float = Field(gt=0)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Detect the board in a grey image: its points (P, 2) [m] and their pixels (P, 2)."""
        flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(image, self.corners, flags=flags)
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 2))
        return _order_grid(np.asarray(corners, dtype=float), self.corners, self.square_mm)


def _order_grid(found: Array, size: tuple[int, int], spacing_mm: float) -> tuple[Array, Array]:
    """Board points (P, 2) [m] and pixels (P, 2) of a detected grid.

    Of the two ends of the grid, the origin is the one nearer the top left of the image. A mirrored grid is flipped.
    """
    columns, rows = size
    grid = found.reshape(rows, columns, 2)
    if grid[0, 0].sum() > grid[-1, -1].sum():
        grid = grid[::-1, ::-1]
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    points = 1e-3 * spacing_mm * np.stack([j, i], axis=-1)
    return points.reshape(-1, 2), grid.reshape(-1, 2)


class Move(StrictModel):
    """A translation of the board, without rotation, along a known world direction by an unknown distance."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    from_: str = Field(alias="from")
    to: str
    along: Direction


class BoardFile(StrictModel):
    """`board.yaml`: the pattern, and the known poses of the board by image (`camera/file`)."""

    format: str
    pattern: Annotated[CharucoPattern | ChessboardPattern | DotGridPattern, Field(discriminator="kind")]
    world: dict[str, WorldPose] = Field(default_factory=dict)
    moved: list[Move] = Field(default_factory=list)
    simultaneous: bool = False

    @field_validator("moved")
    @classmethod
    def _check_moves(cls, moves: list[Move]) -> list[Move]:
        ends = [move.to for move in moves]
        for move in moves:
            if move.from_ in ends or ends.count(move.to) > 1:
                raise ValueError(
                    "expected moves that start where no other move ends, and end in different images, found "
                    f"{move.from_} to {move.to}"
                )
        return moves


@dataclass(frozen=True)
class View:
    """The board in one image.

    Attributes:
        name: `camera/file`.
        pose_key: identifies the pose of the board; simultaneous images of several cameras share it.
        points: detected points, board frame [m], (P, 2).
        pixels: their pixels, (P, 2).
        known_pose: pose of the board in the world, if known.
    """

    name: str
    pose_key: str
    points: Array
    pixels: Array
    known_pose: WorldPose | None


def read_board(path: Path) -> BoardFile:
    """Read `board.yaml`.

    Raises:
        InputError: the file is missing, damaged or of a newer version.
    """
    return read_yaml(path, BoardFile, "a board description (board.yaml)", FORMAT)


def find_board(path: Path, name: str, board: BoardFile) -> tuple[View | None, tuple[int, int]]:
    """Detect the board in an image (None if too few of its points are seen), and return the image size [px] too.

    Raises:
        InputError: the image cannot be read.
    """
    try:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # the header claims an image too large for OpenCV
        image = None
    if image is None:
        raise InputError(f"expected an image of the board in {path}, which cannot be read; replace it")
    size = (image.shape[1], image.shape[0])
    points, pixels = board.pattern.find(image)
    if len(points) < MIN_POINTS:
        return None, size
    pose_key = name.partition("/")[2] if board.simultaneous else name
    return View(name, pose_key, points, pixels, board.world.get(name)), size
