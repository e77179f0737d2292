"""The calls of the page of a calibration, all of which only read."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from fastapi import FastAPI, Response
from numpy.typing import NDArray

from rafl.calibration.camera import Camera, OrthographicCamera, Plane
from rafl.calibration.detection.image_file import read_grey_image
from rafl.common.errors import InputError
from rafl.review.calibration.boards import Boards, CheckedBoard
from rafl.review.calibration.plane_grid import plane_grid

Array = NDArray[Any]

QUALITY = 88
LONGEST_SIDE_PX = 4096  # of an image as it is sent
PIXEL_DIGITS, RESIDUAL_DIGITS = 2, 4  # of the numbers that are sent


class CalibrationView:
    """The view of a calibration; see `View`."""

    page = "calibration/calibration.html"

    def __init__(self, boards: Boards) -> None:
        self.boards = boards
        self.title = f"{boards.calib}: {len(boards.rig.cameras)} cameras, {len(boards.paths)} images in {boards.folder}"

    def add_calls(self, app: FastAPI) -> None:
        """Add the calls."""
        boards = self.boards

        @app.get("/api/calibration")
        def calibration() -> dict[str, object]:
            return {
                "file": boards.calib.name,
                "folder": str(boards.folder),
                "cameras": [
                    _about_camera(name, camera, boards.names(name)) for name, camera in boards.rig.cameras.items()
                ],
            }

        @app.get("/api/board")
        def board(name: str) -> dict[str, object]:
            found = boards.check(name)
            return _about_board(found, boards.rig.cameras[name.partition("/")[0]])

        @app.get("/api/coverage")
        def coverage(camera: str) -> dict[str, object]:
            cells = boards.covered(_known(boards, camera))
            return {"share": float(cells.mean()), "cells": cells.tolist()}

        @app.get("/api/image")
        def image(name: str) -> Response:
            return Response(_jpeg(boards.path(name)), media_type="image/jpeg")

    def close(self) -> None:
        """Nothing is open."""


def _known(boards: Boards, camera: str) -> str:
    boards.names(camera)  # refuses others
    return camera


def _about_camera(name: str, camera: Camera, images: list[str]) -> dict[str, object]:
    grid = plane_grid(camera)
    return {
        "name": name,
        "model": "orthographic" if isinstance(camera, OrthographicCamera) else "pinhole",
        "size": camera.image_size,
        "residual": camera.residual,
        "images": images,
        "plane": None if camera.plane is None else _equation(camera.plane),
        "grid": {
            "spacing": 1e3 * grid.spacing,
            "length": 1e3 * grid.length,
            "lines": [
                {"axis": axis, "value": round(1e3 * value, 6) + 0.0, "path": _rounded(path)}
                for axis, value, path in grid.lines
            ],
            "axes": {axis: _rounded(path) for axis, path in grid.axes.items()},
            "reason": grid.reason,
        },
    }


def _equation(plane: Plane) -> str:
    """A plane as it is spoken of: y = 0.0 mm, or with a normal along no axis its equation."""
    offset, sigma = 1e3 * plane.offset, f" (sigma {1e3 * plane.sigma:g} mm)"
    along = int(np.abs(plane.normal).argmax())
    if abs(plane.normal[along]) > 1.0 - 1e-9:
        return f"{'xyz'[along]} = {offset * np.sign(plane.normal[along]) + 0.0:.1f} mm{sigma}"
    x, y, z = plane.normal
    return f"{x:.3f} x + {y:.3f} y + {z:.3f} z = {offset + 0.0:.1f} mm{sigma}"


def _about_board(board: CheckedBoard, camera: Camera) -> dict[str, object]:
    found: dict[str, object] = {"reason": board.reason, "pixels": _rounded(board.pixels)}
    if board.best is None:
        return found
    residual, known = board.residual, board.known
    found |= {
        "residual": np.round(residual, RESIDUAL_DIGITS).tolist(),
        "rms": (known or board.best).rms,
        "largest": float(np.linalg.norm(residual, axis=1).max()),
        "best": board.best.rms,
        "tilt": float(np.degrees(board.tilt)),
        "known": known is not None,
        "origin": None if board.origin is None else board.origin.tolist(),
    }
    if known is not None and known.view.known_pose is not None and camera.plane is not None:
        pose, plane = known.view.known_pose, camera.plane
        world = pose.origin + known.view.points @ pose.rotation[:, :2].T
        found["off_plane"] = float(1e3 * np.abs(world @ np.asarray(plane.normal) - plane.offset).max())
    return found


def _rounded(pixels: Array) -> list[list[float]]:
    return np.round(np.clip(pixels, -1e6, 1e6), PIXEL_DIGITS).tolist()  # type: ignore[no-any-return]


def _jpeg(path: Path) -> bytes:
    """An image as a grey JPEG file, at most `LONGEST_SIDE_PX` wide and high."""
    image = read_grey_image(path)
    shrink = LONGEST_SIDE_PX / max(image.shape)
    if shrink < 1.0:
        image = np.asarray(cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), np.uint8)
    try:
        grey = np.ascontiguousarray(image)[..., None]
        return bytes(simplejpeg.encode_jpeg(grey, quality=QUALITY, colorspace="GRAY"))
    except ValueError as error:
        raise InputError(f"{path}: expected an image to show, found {error}") from None
