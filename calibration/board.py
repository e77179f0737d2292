"""Calibration boards: their patterns, their known poses, and the views of them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator, model_validator

from rafl.calibration.detection.charuco import find_charuco
from rafl.calibration.detection.chessboard import find_chessboard
from rafl.calibration.detection.dots import find_dot_lattice
from rafl.calibration.detection.lattice import Lattice, place_by_rings, place_by_size
from rafl.calibration.fields import Direction
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

    def find(self, image: NDArray[np.uint8]) -> "Detection":
        """Detect the board in a grey image, (H, W). Boards of OpenCV before 4.6 are recognised too."""
        return Detection(*find_charuco(image, self.opencv_board()))


class DotGridPattern(StrictModel):
    """A grid of dark dots, numbered by `dots` columns x rows or by three ringed dots.

    With `dots`, the origin is the corner dot nearest the top left of the image. With `rings`, it is the ringed dot at
    the corner of the three; the others are `rings[0]` dots along x and `rings[1]` along y. x is right and y down.
    """

    kind: Literal["dot-grid"]
    dots: tuple[int, int] | None = None
    rings: tuple[int, int] | None = None
    spacing_mm: float = Field(gt=0)

    @model_validator(mode="after")
    def _check_numbering(self) -> "DotGridPattern":
        if (self.dots is None) == (self.rings is None):
            raise ValueError("expected either `dots` (columns and rows) or `rings` (places of the ringed dots)")
        if self.rings is not None and 0 in self.rings:
            raise ValueError("expected `rings` that are not 0: spacings from the corner ring to the others")
        return self

    def find(self, image: NDArray[np.uint8]) -> "Detection":
        """Detect the board in a grey image, (H, W)."""
        found = find_dot_lattice(image)
        if found is None:
            return Detection()
        if self.dots is not None:
            return _detection(found[0], self.dots, self.spacing_mm, image)
        assert self.rings is not None
        placed, origin_known = place_by_rings(*found, self.rings)
        return Detection(1e-3 * self.spacing_mm * placed.indices, placed.pixels, origin_known)


class ChessboardPattern(StrictModel):
    """A chessboard of `corners` columns x rows of inner corners. Origin: that nearest the top left of the image."""

    kind: Literal["chessboard"]
    corners: tuple[int, int]
    square_mm: float = Field(gt=0)

    def find(self, image: NDArray[np.uint8]) -> "Detection":
        """Detect the board in a grey image, (H, W)."""
        found = find_chessboard(image, self.corners)
        return Detection() if found is None else _detection(found, self.corners, self.square_mm, image)


@dataclass(frozen=True)
class Detection:
    """What was found of a board in an image.

    Attributes:
        points: board frame [m], (P, 2).
        pixels: of the points, (P, 2).
        origin_known: whether the board's origin is; else that of the points is a corner of the part that is seen.
        other_size: columns and rows of a board of another size, if one was found; there are no points then.
    """

    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))
    origin_known: bool = True
    other_size: tuple[int, int] | None = None


def _detection(found: Lattice, size: tuple[int, int], spacing_mm: float, image: NDArray[np.uint8]) -> Detection:
    """Detection of a board of `size` columns x rows from the lattice of its points in an image."""
    placed, whole = place_by_size(found, size, (image.shape[1], image.shape[0]))
    if placed is None:
        return Detection(other_size=found.size)
    return Detection(1e-3 * spacing_mm * placed.indices, placed.pixels, whole)


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
        origin_known: whether the points are relative to the board's origin; else a part of the board is seen, and they
            are relative to a corner of that part.
    """

    name: str
    pose_key: str
    points: Array
    pixels: Array
    known_pose: WorldPose | None
    origin_known: bool = True


def read_board(path: Path) -> BoardFile:
    """Read `board.yaml`.

    Raises:
        InputError: the file is missing, damaged or of a newer version.
    """
    return read_yaml(path, BoardFile, "a board description (board.yaml)", FORMAT)
