"""The command `rafl-calibrate`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from calibration.board import BoardFile, View, find_board, read_board
from calibration.rig import Rig, write_rig
from calibration.solve import Solution, solve_camera
from groundwork import InputError, command_line, progress, user_command

PICTURES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}

app = command_line("Calibrate cameras.")


@app.command()
@user_command
def calibrate(
    images: Annotated[Path, typer.Argument(help="Folder with a sub-folder of pictures per camera.")],
    board: Annotated[Path | None, typer.Option(help="Board description [IMAGES/board.yaml].")] = None,
    out: Annotated[Path, typer.Option(help="Calibration to write.")] = Path("calib.yaml"),
) -> None:
    """Solve an orthographic rig from pictures of a ChArUco board or a dot grid.

    Example: rafl-calibrate calibration-images/ --out calib.yaml
    """
    if not images.is_dir():
        raise InputError(f"expected a folder of board pictures at {images}, found none; check the path")
    description = read_board(board or images / "board.yaml")
    pictures = _pictures(images)
    unknown = set(description.world) - {name for names in pictures.values() for name in names}
    if unknown:
        raise InputError(
            f"board.yaml places the board in {sorted(unknown)[0]}, which is not among the pictures in "
            f"{images}; correct the name under `world`"
        )
    without = [name for name, names in pictures.items() if not set(names) & set(description.world)]
    if len(pictures) > 1 and without:
        raise InputError(
            f"camera {without[0]}: with several cameras expected a picture with a known place of the board, "
            "found none; list one under `world` in board.yaml"
        )
    solutions = {name: _solve(name, names, description) for name, names in pictures.items()}
    write_rig(out, Rig({name: solution.camera for name, solution in solutions.items()}))
    Console(width=100).print(_table(solutions))
    typer.echo(f"wrote {out}")
    typer.echo(f"next: rafl-track videos/ --calib {out}")


def _pictures(images: Path) -> dict[str, dict[str, Path]]:
    """By camera, the pictures by `camera/file`; a folder without sub-folders is one camera."""
    folders = sorted(path for path in images.iterdir() if path.is_dir())
    found = {
        folder.name: {
            f"{folder.name}/{path.name}": path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES
        }
        for folder in folders or [images]
    }
    found = {name: pictures for name, pictures in found.items() if pictures}
    if not found:
        raise InputError(f"expected pictures of the board in {images}/<camera>/, found none; check the path")
    return found


def _solve(camera: str, pictures: dict[str, Path], description: BoardFile) -> Solution:
    views: list[View] = []
    sizes: dict[tuple[int, int], str] = {}
    with progress() as bar:
        for name, path in bar.track(pictures.items(), description=f"{camera}: finding the board"):
            view, size = find_board(path, name, description)
            sizes.setdefault(size, name)
            if view is not None:
                views.append(view)
            elif name in description.world:
                raise InputError(
                    f"{path}: board.yaml places the board in it, but it is not to be found there; "
                    "check the pattern in board.yaml, or take the picture again"
                )
    if len(sizes) > 1:
        found = ", ".join(f"{name} {w} x {h}" for (w, h), name in sizes.items())
        raise InputError(f"camera {camera}: expected pictures of one size, found {found}; sort them")
    return solve_camera(camera, views, next(iter(sizes)))


def _table(solutions: dict[str, Solution]) -> Table:
    table = Table("camera", "views", "residual [px]", "px/mm along u, v", "+-", "tilts [deg]")
    for name, solution in solutions.items():
        camera = solution.camera
        tilts = np.degrees(list(solution.tilts.values()))
        sigma = np.sqrt(camera.covariance[0][0]) if camera.covariance else float("nan")
        table.add_row(
            name,
            str(len(tilts)),
            f"{camera.residual:.3f}",
            f"{1e-3 * camera.scale[0]:.4f}, {1e-3 * camera.scale[1]:.4f}",
            f"{sigma:.4f}",
            f"{tilts.min():.0f} to {tilts.max():.0f}",
        )
    return table
