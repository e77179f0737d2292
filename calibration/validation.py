"""Validation of a calibration on views that it was not made from."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rafl.calibration.board import View
from rafl.calibration.camera import Camera
from rafl.common.files import write_bytes

Array = NDArray[Any]

rcParams["text.parse_math"] = False  # a name with $ is a name

START_TILTS = np.radians([0.0, 25.0])  # initial tilts of the board in the search for its pose
ARROW_SCALE = 200.0  # enlargement of the residuals drawn as arrows


@dataclass(frozen=True)
class CheckedView:
    """One view with the residuals that remain at the best board pose.

    Attributes:
        view: the view.
        residual: measured minus predicted pixels [px], (P, 2).
    """

    view: View
    residual: Array

    @property
    def rms(self) -> float:
        """Root mean square residual of a coordinate [px]."""
        return float(np.sqrt((self.residual**2).mean()))


def check_view(camera: Camera, view: View) -> CheckedView:
    """Find the board pose that fits a view best, with the camera unchanged, and return the residuals."""
    camera_to_world = camera.rotation.T
    to_centre = camera.undistort(view.pixels.mean(0)) - camera.project_undistorted(np.zeros(3))
    centre = np.linalg.lstsq(camera.projection_jacobian(np.zeros(3)), to_centre, rcond=None)[0]
    middle = np.append(view.points.mean(0), 0.0)

    def residuals(x: Array) -> Array:
        board = Rotation.from_rotvec(x[:3]).as_matrix()
        world = centre + x[3:] + (np.column_stack([view.points, np.zeros(len(view.points))]) - middle) @ board.T
        return (view.pixels - camera.project(world)).ravel()

    best = None
    along = view.pixels[np.argmax(view.points[:, 0])] - view.pixels[np.argmin(view.points[:, 0])]
    spin = np.arctan2(along[1], along[0])
    for direction in np.arange(0.0, 2 * np.pi, np.pi / 3):
        for tilt in START_TILTS:
            axis = np.array([np.cos(direction), np.sin(direction), 0.0])
            in_plane = Rotation.from_rotvec([0, 0, spin]).as_matrix()
            board = camera_to_world @ Rotation.from_rotvec(tilt * axis).as_matrix() @ in_plane
            start = np.concatenate([Rotation.from_matrix(board).as_rotvec(), np.zeros(3)])
            found = least_squares(residuals, start, x_scale=[1, 1, 1, 0.01, 0.01, 0.01], loss="huber", f_scale=0.5)
            if best is None or found.cost < best.cost:
                best = found
            if tilt == 0.0 and direction > 0.0:
                break
    assert best is not None
    return CheckedView(view, residuals(best.x).reshape(-1, 2))


def check_known_pose(camera: Camera, view: View) -> CheckedView | None:
    """The residuals of a view with the board where `board.yaml` says; None if it does not say."""
    if view.known_pose is None:
        return None
    world = view.known_pose.origin + view.points @ view.known_pose.rotation[:, :2].T
    return CheckedView(view, view.pixels - camera.project(world))


def write_residual_plot(path: Path, size: tuple[int, int], checked: list[CheckedView], title: str) -> None:
    """Write a PNG of one camera's residuals: enlarged arrows over the image area, and a histogram."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    for item in checked:
        u, v = item.view.pixels.T
        left.quiver(u, v, *(ARROW_SCALE * item.residual.T), angles="xy", scale_units="xy", scale=1, width=1.5e-3)
    left.set(xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal", title=f"{title}: residuals x {ARROW_SCALE:.0f}")
    right.hist(np.concatenate([item.residual.ravel() for item in checked]), bins=50, color="#1f6fb2")
    right.set(xlabel="residual of a coordinate [px]", yticks=[])
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    write_bytes(path, content.getvalue())
