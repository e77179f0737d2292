"""Calibration boards: what is printed on them, where they stood, and their points in a picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator, model_validator
from rafl.calibration.fields import Direction
from scipy.spatial import cKDTree

from rafl.common.errors import InputError
from rafl.common.yaml_files import StrictModel, read_yaml

Array = NDArray[Any]

FORMAT = "rafl-board/1"
FEWEST_POINTS = 8


class WorldPose(StrictModel):
    """Where the board stood in one picture: its origin and the directions of its axes."""

    origin_mm: tuple[float, float, float]
    x_axis: Direction
    y_axis: Direction

    @model_validator(mode="after")
    def _square(self) -> "WorldPose":
        if not abs(np.dot(self.x_axis, self.y_axis)) < 1e-3:
            raise ValueError("expected axes at a right angle")
        return self

    @property
    def rotation(self) -> Array:
        """Board to world, (3, 3)."""
        x, y = np.asarray(self.x_axis), np.asarray(self.y_axis)
        return np.stack([x, y, np.cross(x, y)], axis=1)

    @property
    def origin(self) -> Array:
        """World position of the board's origin [m], (3)."""
        return 1e-3 * np.asarray(self.origin_mm)


class CharucoPattern(StrictModel):
    """A ChArUco board: `squares` columns x rows; origin at the top left corner, x right, y down."""

    kind: Literal["charuco"]
    squares: tuple[int, int]
    square_mm: float = Field(gt=0)
    marker_mm: float = Field(gt=0)
    dictionary: str = "DICT_4X4_250"

    @field_validator("dictionary")
    @classmethod
    def _known(cls, name: str) -> str:
        if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
            raise ValueError("expected the name of an OpenCV dictionary, for instance DICT_4X4_250")
        return name

    def opencv_board(self) -> "cv2.aruco.CharucoBoard":
        """OpenCV's description of it, lengths in metres."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard(self.squares, 1e-3 * self.square_mm, 1e-3 * self.marker_mm, dictionary)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Board points (P, 2) [m] and their pixels (P, 2) in a grey image."""
        board = self.opencv_board()
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is None or len(ids) < FEWEST_POINTS:
            return np.zeros((0, 2)), np.zeros((0, 2))
        points = np.asarray(board.getChessboardCorners(), dtype=float)[ids.ravel(), :2]
        # OpenCV 4 counts these corners from a pixel's edge, OpenCV 5 from its centre: refined here, they
        # are from the centre in both.
        apart = cKDTree(corners.reshape(-1, 2)).query(corners.reshape(-1, 2), 2)[0][:, 1].min()
        half = int(np.clip(0.15 * apart, 2, 10))
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        refined = cv2.cornerSubPix(image, np.array(corners, dtype=np.float32), (half, half), (-1, -1), stop)
        return points, np.asarray(refined, dtype=float).reshape(-1, 2)


class DotGridPattern(StrictModel):
    """A grid of `dots` columns x rows of dark dots; origin at the dot nearest the picture's top left."""

    kind: Literal["dot-grid"]
    dots: tuple[int, int]
    spacing_mm: float = Field(gt=0)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Board points (P, 2) [m] and their pixels (P, 2) in a grey image."""
        columns, rows = self.dots
        found, centres = cv2.findCirclesGrid(image, (columns, rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 2))
        return _from_top_left(np.asarray(centres, dtype=float), self.dots, self.spacing_mm)


class ChessboardPattern(StrictModel):
    """A chessboard of `corners` inner columns x rows; origin at the inner corner nearest the picture's top left."""

    kind: Literal["chessboard"]
    corners: tuple[int, int]
    square_mm: float = Field(gt=0)

    def find(self, image: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Board points (P, 2) [m] and their pixels (P, 2) in a grey image."""
        flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(image, self.corners, flags=flags)
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 2))
        return _from_top_left(np.asarray(corners, dtype=float), self.corners, self.square_mm)


def _from_top_left(found: Array, size: tuple[int, int], pitch_mm: float) -> tuple[Array, Array]:
    """A regular grid's points [m] and pixels, its origin the end nearest the picture's top left, never mirrored."""
    columns, rows = size
    grid = found.reshape(rows, columns, 2)
    if grid[0, 0].sum() > grid[-1, -1].sum():
        grid = grid[::-1, ::-1]
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    points = 1e-3 * pitch_mm * np.stack([j, i], axis=-1)
    return points.reshape(-1, 2), grid.reshape(-1, 2)


class Move(StrictModel):
    """A board that was moved, without turning, along a stated direction of the world by an unknown distance."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    from_: str = Field(alias="from")
    to: str
    along: Direction


class BoardFile(StrictModel):
    """`board.yaml`: the pattern, and by picture (`camera/file`) where the board stood in the world."""

    format: str
    pattern: Annotated[CharucoPattern | ChessboardPattern | DotGridPattern, Field(discriminator="kind")]
    world: dict[str, WorldPose] = Field(default_factory=dict)
    moved: list[Move] = Field(default_factory=list)
    simultaneous: bool = False

    @field_validator("moved")
    @classmethod
    def _from_where_it_stood(cls, moves: list[Move]) -> list[Move]:
        reached = [move.to for move in moves]
        for move in moves:
            if move.from_ in reached or reached.count(move.to) > 1:
                raise ValueError(f"expected every move to start where no other ends, found {move.from_} to {move.to}")
        return moves


@dataclass(frozen=True)
class View:
    """The board in one picture.

    Attributes:
        name: `camera/file`.
        board: key of the place where the board stood; the same for pictures taken together.
        points: on the board [m], (P, 2).
        pixels: (P, 2).
        pose: where the board stood, if known.
    """

    name: str
    board: str
    points: Array
    pixels: Array
    pose: WorldPose | None


def read_board(path: Path) -> BoardFile:
    """Read `board.yaml`.

    Raises:
        InputError: missing, damaged, or of a newer version.
    """
    return read_yaml(path, BoardFile, "a board description (board.yaml)", FORMAT)


def find_board(path: Path, name: str, board: BoardFile) -> tuple[View | None, tuple[int, int]]:
    """The board in a picture (None where too little of it is seen), and the picture's size.

    Raises:
        InputError: the picture cannot be read.
    """
    try:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # its header claims a picture too large for OpenCV
        image = None
    if image is None:
        raise InputError(f"expected a picture of the board in {path}, which cannot be read; replace it")
    size = (image.shape[1], image.shape[0])
    points, pixels = board.pattern.find(image)
    if len(points) < FEWEST_POINTS:
        return None, size
    place = name.partition("/")[2] if board.simultaneous else name
    return View(name, place, points, pixels, board.world.get(name)), size
