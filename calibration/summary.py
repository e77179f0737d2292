"""What a calibration found, in tables and sentences."""

import numpy as np
from rafl.calibration.board import View
from rafl.calibration.camera import OrthographicCamera, PinholeCamera
from rafl.calibration.rig import Rig
from rafl.calibration.solve import PERSPECTIVE, Solution
from rafl.calibration.validation import CheckedView
from rich.table import Table

HARMLESS_BIAS = 20e-6  # m: what a lens's perspective may cost before it is worth a warning


def camera_table(solution: Solution, views: dict[str, list[View]]) -> Table:
    """The cameras that board views gave."""
    table = Table("camera", "model", "views", "residual [px]", "px/mm along u, v", "+-", "tilts [deg]")
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


def lens_lines(solution: Solution, depth: float, model: str) -> list[str]:
    """What the lenses' own perspective costs, where it shows."""
    lines = []
    for name, (nearness, sigma) in solution.nearness.items():
        shown = nearness > PERSPECTIVE * sigma
        if model == "pinhole":
            lines.append(f"camera {name}: stands {1.0 / nearness:.3f} +- {sigma / nearness**2:.3f} m from the origin")
        elif shown and solution.bias(name, depth) > HARMLESS_BIAS:
            lines.append(
                f"warning: camera {name}: its lens is not orthographic: it seems to stand {1.0 / nearness:.2f} m "
                f"away, and a marker {1e3 * depth:.0f} mm off its plane is up to "
                f"{1e3 * solution.bias(name, depth):.2f} mm wrong at the picture's edge; stand farther away with a "
                "longer lens, or calibrate with --model pinhole"
            )
    return lines


def check_table(rig: Rig, checked: dict[str, list[CheckedView]]) -> Table:
    """Residuals of pictures that the calibration was not made from, by camera."""
    table = Table("camera", "picture", "points", "residual [px]", "largest [px]", "calibration's [px]")
    for name, views in checked.items():
        for item in views:
            largest = float(np.linalg.norm(item.residual, axis=1).max())
            numbers = (f"{item.size:.3f}", f"{largest:.3f}", f"{rig.cameras[name].residual:.3f}")
            table.add_row(name, item.view.name, str(len(item.residual)), *numbers)
    return table
