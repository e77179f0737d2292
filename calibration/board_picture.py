"""A picture that shows where a calibration puts the world: the points found on the board, and the world's axes."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rafl.calibration.board import View
from rafl.calibration.camera import Camera, PinholeCamera

Array = NDArray[Any]

LONGEST_SIDE_PX = 1600  # of the picture
AXIS_SHARE = 0.4  # length of the axes, relative to the extent of the points on the board
POINT_COLOUR, ORIGIN_COLOUR = (60, 200, 60), (0, 215, 255)  # blue, green, red
AXIS_COLOURS = {"x": (60, 60, 255), "y": (60, 220, 60), "z": (255, 120, 60)}


def world_view(views: list[View]) -> View:
    """The view to draw: the first of known pose, or else the first whole board, which defines the world frame."""
    known = [view for view in views if view.known_pose is not None]
    return (known or [view for view in views if view.origin_known] or views)[0]


def draw_board(image: NDArray[np.uint8], view: View, camera: Camera) -> NDArray[np.uint8]:
    """Draw a view's points, the board's origin and the world's axes over its image.

    Args:
        image: grey levels, (H, W).
        view: the board in that image.
        camera: the calibrated camera.

    Returns:
        Blue, green and red, (h, w, 3), at most `LONGEST_SIDE_PX` wide and high.
    """
    shrink = min(1.0, LONGEST_SIDE_PX / max(image.shape))
    small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    canvas = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    width = max(round(max(canvas.shape) / 500), 1)

    def place(pixel: Array) -> tuple[int, int]:
        x, y = np.rint(np.clip((pixel + 0.5) * shrink - 0.5, -10 * LONGEST_SIDE_PX, 10 * LONGEST_SIDE_PX))
        return int(x), int(y)

    def label(text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
        for line, shade in ((4 * width, (0, 0, 0)), (width, colour)):
            cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * width, shade, line, cv2.LINE_AA)

    for pixel in view.pixels:
        cv2.circle(canvas, place(pixel), 2 * width, POINT_COLOUR, width, cv2.LINE_AA)
    length = AXIS_SHARE * float(np.ptp(view.points, axis=0).max())
    ends = np.vstack([np.zeros(3), length * np.eye(3)])
    in_front = not isinstance(camera, PinholeCamera) or (camera.to_camera_frame(ends)[:, 2] > 0.0).all()
    if in_front:
        origin, *tips = (place(pixel) for pixel in camera.project(ends))
        for (name, colour), tip in zip(AXIS_COLOURS.items(), tips, strict=True):
            cv2.arrowedLine(canvas, origin, tip, colour, 2 * width, cv2.LINE_AA, tipLength=0.08)
            label(name, (tip[0] + 4 * width, tip[1] - 4 * width), colour)
    if view.known_pose is not None:
        corner = place(camera.project(view.known_pose.origin))
        cv2.drawMarker(canvas, corner, ORIGIN_COLOUR, cv2.MARKER_TILTED_CROSS, 12 * width, 2 * width, cv2.LINE_AA)
        label("board origin", (corner[0] + 8 * width, corner[1] + 14 * width), ORIGIN_COLOUR)
    lines = [f"{view.name}: {len(view.points)} points", f"axes of the world, {1e3 * length:.0f} mm"]
    for number, text in enumerate(reversed(lines)):
        label(text, (8 * width, canvas.shape[0] - (number + 1) * 16 * width), (255, 255, 255))
    return np.asarray(canvas, dtype=np.uint8)


def board_picture(image: NDArray[np.uint8], view: View, camera: Camera) -> bytes:
    """`draw_board` as a PNG file."""
    return bytes(cv2.imencode(".png", draw_board(image, view, camera))[1].tobytes())
