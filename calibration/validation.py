"""Judging a calibration by views that it was not made from."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rafl.calibration.board import View
from rafl.calibration.camera import Camera
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rafl.common.files import whole_file

Array = NDArray[Any]

TILTS = np.radians([0.0, 25.0])
ENLARGED = 200.0  # times the residuals are drawn


@dataclass(frozen=True)
class CheckedView:
    """One view, the board placed where the camera sees it best.

    Attributes:
        view: what was seen.
        residual: pixels seen minus pixels expected [px], (P, 2).
    """

    view: View
    residual: Array

    @property
    def size(self) -> float:
        """Root mean square of a coordinate [px]."""
        return float(np.sqrt((self.residual**2).mean()))


def check_view(camera: Camera, view: View) -> CheckedView:
    """Places the board freely before the camera, which stays as it is, and tells what is left."""
    back = camera.rotation.T
    centre = np.linalg.lstsq(
        camera.slopes(np.zeros(3)), camera.undistort(view.pixels.mean(0)) - camera.ideal(np.zeros(3)), rcond=None
    )[0]
    middle = np.append(view.points.mean(0), 0.0)

    def gaps(x: Array) -> Array:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        world = centre + x[3:] + (np.column_stack([view.points, np.zeros(len(view.points))]) - middle) @ turn.T
        return (view.pixels - camera.project(world)).ravel()

    best = None
    along = view.pixels[np.argmax(view.points[:, 0])] - view.pixels[np.argmin(view.points[:, 0])]
    spin = np.arctan2(along[1], along[0])
    for direction in np.arange(0.0, 2 * np.pi, np.pi / 3):
        for tilt in TILTS:
            axis = np.array([np.cos(direction), np.sin(direction), 0.0])
            turn = back @ Rotation.from_rotvec(tilt * axis).as_matrix() @ Rotation.from_rotvec([0, 0, spin]).as_matrix()
            start = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), np.zeros(3)])
            found = least_squares(gaps, start, x_scale=[1, 1, 1, 0.01, 0.01, 0.01], loss="huber", f_scale=0.5)
            if best is None or found.cost < best.cost:
                best = found
            if tilt == 0.0 and direction > 0.0:
                break
    assert best is not None
    return CheckedView(view, gaps(best.x).reshape(-1, 2))


def write_picture(path: Path, size: tuple[int, int], checked: list[CheckedView], title: str) -> None:
    """A PNG of all residuals of one camera over its picture, as arrows drawn larger, and their histogram."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    for item in checked:
        u, v = item.view.pixels.T
        left.quiver(u, v, *(ENLARGED * item.residual.T), angles="xy", scale_units="xy", scale=1, width=1.5e-3)
    left.set(xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal", title=f"{title}: residuals, {ENLARGED:.0f} times")
    right.hist(np.concatenate([item.residual.ravel() for item in checked]), bins=50, color="#1f6fb2")
    right.set(xlabel="residual of a coordinate [px]", yticks=[])
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    with whole_file(path) as temporary:
        temporary.write_bytes(content.getvalue())
