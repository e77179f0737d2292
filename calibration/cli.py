"""The command `rafl-calibrate`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from calibration.board import BoardFile, View, find_board, read_board
from calibration.camera import OrthographicCamera, PinholeCamera
from calibration.check import check_view, write_picture
from calibration.rig import read_rig, write_rig
from calibration.solve import PERSPECTIVE, Solution, solve_rig
from groundwork import InputError, command_line, progress, user_command

PICTURES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}
MODELS = ("orthographic", "pinhole")
HARMLESS_BIAS = 20e-6  # m: what a lens's perspective may cost before it is worth a warning

app = command_line("Calibrate cameras.")


@app.command()
@user_command
def calibrate(
    images: Annotated[Path, typer.Argument(help="Folder with a sub-folder of pictures per camera.")],
    board: Annotated[Path | None, typer.Option(help="Board description [IMAGES/board.yaml].")] = None,
    out: Annotated[Path, typer.Option(help="Calibration to write.")] = Path("calib.yaml"),
    model: Annotated[str, typer.Option(help="orthographic or pinhole.")] = "orthographic",
    tilt_sign: Annotated[
        list[str] | None,
        typer.Option(help="CAMERA=+ where the right (or lower) edge of its reference board is farther away; CAMERA=-."),
    ] = None,
    depth_mm: Annotated[float, typer.Option(min=0.0, help="Depth of the specimen, for the lens check.")] = 30.0,
    check: Annotated[Path | None, typer.Option(help="calib.yaml to judge by these pictures instead.")] = None,
) -> None:
    """Solve a rig from pictures of a ChArUco board, a chessboard or a dot grid.

    Example: rafl-calibrate calibration-images/ --out calib.yaml

    With --check CALIB nothing is solved: residuals on pictures the calibration was not made from.
    """
    if not images.is_dir():
        raise InputError(f"expected a folder of board pictures at {images}, found none; check the path")
    if model not in MODELS:
        raise InputError(f"--model: expected {' or '.join(MODELS)}, found {model!r}")
    description = read_board(board or images / "board.yaml")
    pictures = _pictures(images)
    _known_pictures(description, pictures, images)
    views, sizes = {}, {}
    for name, names in pictures.items():
        views[name], sizes[name] = _views(name, names, description)
    if check is not None:
        _check(check, views, sizes)
        return
    if not _placed(views):
        raise InputError(
            f"camera {list(views)[1]}: with several cameras expected a picture with a known place of the board, found "
            "none; list one per camera under `world` in board.yaml, or say `simultaneous: true` where pictures of one "
            "name were taken together"
        )
    solution = solve_rig(views, sizes, description, _signs(tilt_sign or [], views), model)
    write_rig(out, solution.rig)
    Console(width=110).print(_table(solution, views))
    for line in _lens(solution, 1e-3 * depth_mm, model):
        typer.echo(line)
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


def _known_pictures(description: BoardFile, pictures: dict[str, dict[str, Path]], images: Path) -> None:
    present = {name for names in pictures.values() for name in names}
    named = [(name, "world") for name in description.world]
    named += [(name, "moved") for move in description.moved for name in (move.from_, move.to)]
    for name, key in named:
        if name not in present:
            raise InputError(
                f"board.yaml names {name}, which is not among the pictures in {images}; correct it under `{key}`"
            )


def _placed(views: dict[str, list[View]]) -> bool:
    """Whether every camera is tied to the world, by itself or through boards seen with another."""
    if len(views) == 1:
        return True
    tied = {name for name, own in views.items() if any(view.pose for view in own)}
    boards = {name: {view.board for view in own} for name, own in views.items()}
    known = {view.board for own in views.values() for view in own if view.pose}
    tied |= {name for name in views if boards[name] & known}
    while True:
        more = {name for name in views if name not in tied and any(boards[name] & boards[other] for other in tied)}
        if not more:
            return tied == set(views)
        tied |= more


def _signs(given: list[str], views: dict[str, list[View]]) -> dict[str, int]:
    signs = {}
    for text in given:
        camera, _, sign = text.rpartition("=")
        if not camera and len(views) == 1:
            camera = next(iter(views))
        if camera not in views or sign not in ("+", "-"):
            raise InputError(
                f"--tilt-sign: expected CAMERA=+ or CAMERA=- with one of {', '.join(views)}, found {text!r}"
            )
        signs[camera] = 1 if sign == "+" else -1
    return signs


def _views(camera: str, pictures: dict[str, Path], description: BoardFile) -> tuple[list[View], tuple[int, int]]:
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
    return views, next(iter(sizes))


def _table(solution: Solution, views: dict[str, list[View]]) -> Table:
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


def _lens(solution: Solution, depth: float, model: str) -> list[str]:
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


def _check(calib: Path, views: dict[str, list[View]], sizes: dict[str, tuple[int, int]]) -> None:
    rig = read_rig(calib)
    table = Table("camera", "picture", "points", "residual [px]", "largest [px]", "calibration's [px]")
    for name, own in views.items():
        if name not in rig.cameras:
            raise InputError(f"expected pictures of {', '.join(rig.cameras)} as in {calib}, found camera {name!r}")
        camera = rig.cameras[name]
        if camera.image_size != sizes[name]:
            raise InputError(
                f"camera {name}: expected pictures of {camera.image_size[0]} x {camera.image_size[1]} as calibrated, "
                f"found {sizes[name][0]} x {sizes[name][1]}; take them at the calibrated size"
            )
        if not own:
            raise InputError(f"camera {name}: expected pictures that show the board, found none; check board.yaml")
        with progress() as bar:
            checked = [check_view(camera, view) for view in bar.track(own, description=f"{name}: placing the board")]
        for item in checked:
            largest = float(np.linalg.norm(item.residual, axis=1).max())
            numbers = (str(len(item.residual)), f"{item.size:.3f}", f"{largest:.3f}", f"{camera.residual:.3f}")
            table.add_row(name, item.view.name, *numbers)
        path = Path(f"check-{name}.png")
        write_picture(path, camera.image_size, checked, name)
        typer.echo(f"wrote {path}")
    Console(width=110).print(table)
