"""The board images of a calibration: what they show of the board, and how well the cameras explain it."""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.calibration.board import read_board
from rafl.calibration.board_images import find_board, image_paths
from rafl.calibration.detection.image_file import image_size
from rafl.calibration.rig import read_board_source, read_calibration
from rafl.calibration.validation import CheckedView, check_known_pose, check_view
from rafl.calibration.views import fit_affine
from rafl.common.errors import InputError

Array = NDArray[Any]

CELLS = 12  # along the longer side of an image; a cell without any corner is not covered


@dataclass(frozen=True)
class CheckedBoard:
    """A board image beside the calibration.

    Attributes:
        reason: why the image does not serve; empty if it does.
        pixels: found points of the board [px], (P, 2); also of a board that does not serve.
        best: with the board where it fits best, the camera unchanged; None if the image does not serve.
        known: with the board where `board.yaml` says; None if it does not say.
        origin: pixel of the board's origin at the pose in `board.yaml`, (2).
        tilt: of the board from the image plane [rad].
    """

    reason: str
    pixels: Array
    best: CheckedView | None = None
    known: CheckedView | None = None
    origin: Array | None = None
    tilt: float = np.nan

    @property
    def residual(self) -> Array:
        """Measured minus predicted pixels at the pose in `board.yaml`, or else at the best one, (P, 2)."""
        shown = self.known or self.best
        return np.zeros((0, 2)) if shown is None else shown.residual


class Boards:
    """A calibration and its board images. Images are examined when they are asked for, one at a time.

    Args:
        calib: calib.yaml.
        images: folder of board images; None where `rafl-calibrate` found them.
        board: board description; None for that of `rafl-calibrate`, or with `images`, `board.yaml` in it.

    Raises:
        InputError: a file cannot be read, or there are no images of these cameras.
    """

    def __init__(self, calib: Path, images: Path | None, board: Path | None) -> None:
        self.calib, self.rig = calib, read_calibration(calib)
        if images is None:
            source = read_board_source(calib)
            if source is None:
                raise InputError(
                    f"{calib} does not say where its board images are; give their folder with --images (a calibration "
                    "without a board has none)"
                )
            if not source.images.is_dir():
                raise InputError(f"{calib}: expected its board images at {source.images}; give them with --images")
            images, board = source.images, board or source.board
        self.folder = images
        self.description = read_board(board or images / "board.yaml")
        found = image_paths(images)
        if unknown := [camera for camera in found if camera not in self.rig.cameras]:
            raise InputError(
                f"{images}: expected images of {', '.join(self.rig.cameras)} as in {calib}, found camera {unknown[0]!r}"
            )
        root = images.resolve()
        self.paths = {
            name: path for own in found.values() for name, path in own.items() if path.resolve().is_relative_to(root)
        }
        self.checked: dict[str, CheckedBoard] = {}
        self.checking = threading.Lock()

    def names(self, camera: str) -> list[str]:
        """The images of a camera, `camera/file`.

        Raises:
            InputError: there is no such camera.
        """
        if camera not in self.rig.cameras:
            raise InputError("expected a camera of the calibration, found another; load the page again")
        return [name for name in self.paths if name.partition("/")[0] == camera]

    def path(self, name: str) -> Path:
        """The file of an image.

        Raises:
            InputError: there is no such image.
        """
        if name not in self.paths:
            raise InputError("expected the name of a board image, found another; load the page again")
        return self.paths[name]

    def check(self, name: str) -> CheckedBoard:
        """What an image shows of the board.

        Raises:
            InputError: there is no such image.
        """
        path = self.path(name)
        with self.checking:
            if name not in self.checked:
                self.checked[name] = self._examine(name, path)
            return self.checked[name]

    def _examine(self, name: str, path: Path) -> CheckedBoard:
        camera = self.rig.cameras[name.partition("/")[0]]
        try:
            size = image_size(path)
            if size != camera.image_size:
                wanted = f"expected an image of {camera.image_size[0]} x {camera.image_size[1]} px as calibrated"
                return CheckedBoard(f"{wanted}, found {size[0]} x {size[1]}", np.zeros((0, 2)))
            found = find_board(name, path, self.description)
        except InputError as error:
            return CheckedBoard(str(error), np.zeros((0, 2)))
        view = found.view
        if view is None:
            return CheckedBoard(found.reason, found.detection.pixels)
        pose = view.known_pose
        origin = None if pose is None else camera.project(pose.origin)
        best, known = check_view(camera, view), check_known_pose(camera, view)
        return CheckedBoard("", view.pixels, best, known, origin, fit_affine(view).tilt)

    def covered(self, camera: str) -> NDArray[np.bool_]:
        """Which cells of a camera's image have points of a board, (rows, columns).

        Raises:
            InputError: there is no such camera.
        """
        width, height = self.rig.cameras[camera].image_size
        cell = max(width, height) / CELLS
        shape = max(round(height / cell), 1), max(round(width / cell), 1)
        result = np.zeros(shape, bool)
        for name in self.names(camera):
            board = self.check(name)
            if board.best is not None:
                u, v = board.pixels.T + 0.5
                rows, columns = v / height * shape[0], u / width * shape[1]
                inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
                result[rows[inside].astype(int), columns[inside].astype(int)] = True
        return result
