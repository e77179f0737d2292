"""Result tables and messages of a calibration."""

import numpy as np
from rich.table import Table

from rafl.calibration.board import View
from rafl.calibration.camera import OrthographicCamera, PinholeCamera
from rafl.calibration.rig import Rig
from rafl.calibration.solve import MIN_PERSPECTIVE_SIGMAS, Solution
from rafl.calibration.validation import CheckedView
from rafl.common.command_line import create_table

MAX_SILENT_BIAS_M = 20e-6  # a larger marker error from a lens's perspective gives a warning
# Where markers are not where the specimen has them, and the board's pose may be right: the cause, and how to check it.
OTHER_SET_UP = (
    "the calibration belongs to another set-up, or a camera was moved after it (to check, open rafl-review calib.yaml: "
    "the pixel where the axes start must show the specimen's lower corner at the clamp in the films too)"
)


def camera_table(solution: Solution, views: dict[str, list[View]]) -> Table:
    """The calibrated cameras: scale and its sigma, residual, and range of board tilts."""
    table = create_table(
        "camera", "model", "views", "residual [px]", "px/mm along u, v", "sigma [px/mm]", "tilts [deg]"
    )
    for name, camera in solution.rig.cameras.items():
        tilts = np.degrees([solution.tilts[view.name] for view in views[name]])
        if isinstance(camera, OrthographicCamera):
            scale, model = camera.scale, "orthographic"
        else:
            assert isinstance(camera, PinholeCamera)
            scale, model = (camera.focal[0] / camera.translation[2], camera.focal[1] / camera.translation[2]), "pinhole"
        sigma = f"{np.sqrt(camera.covariance[0][0]):.4f}" if camera.covariance else "-"
        table.add_row(
            name,
            model,
            str(len(tilts)),
            f"{camera.residual:.3f}",
            f"{1e-3 * scale[0]:.4f}, {1e-3 * scale[1]:.4f}",
            sigma,
            f"{tilts.min():.0f} to {tilts.max():.0f}",
        )
    return table


def perspective_messages(solution: Solution, depth: float, model: str) -> list[str]:
    """Distance of each pinhole camera, or a warning for each orthographic camera whose views show perspective."""
    lines = []
    for name, (inverse_distance, sigma) in solution.inverse_distances.items():
        significant = inverse_distance > MIN_PERSPECTIVE_SIGMAS * sigma
        if model == "pinhole":
            lines.append(
                f"camera {name}: {1.0 / inverse_distance:.3f} +- {sigma / inverse_distance**2:.3f} m from the origin"
            )
        elif significant and solution.perspective_bias(name, depth) > MAX_SILENT_BIAS_M:
            lines.append(
                f"warning: camera {name}: the images show perspective, as from {1.0 / inverse_distance:.2f} m away; "
                f"at the image border, a marker {1e3 * depth:.0f} mm off its plane gets an error of up to "
                f"{1e3 * solution.perspective_bias(name, depth):.2f} mm; move the camera farther away and use a longer "
                "lens, or calibrate with --model pinhole"
            )
    if solution.board_error:
        lines.append(
            f"the printed board is {1e3 * solution.board_error:.3f} mm RMS off its description; the calibration allows "
            "for it"
        )
    return lines


def check_table(rig: Rig, checked: dict[str, list[CheckedView]]) -> Table:
    """Residuals of images that the calibration was not made from, beside the residual of the calibration."""
    table = create_table("camera", "image", "points", "residual [px]", "largest [px]", "in calibration [px]")
    for name, views in checked.items():
        for item in views:
            largest = float(np.linalg.norm(item.residual, axis=1).max())
            numbers = (f"{item.rms:.3f}", f"{largest:.3f}", f"{rig.cameras[name].residual:.3f}")
            table.add_row(name, item.view.name, str(len(item.residual)), *numbers)
    return table
