"""What `rafl-calibrate` does once its options are checked: call the library, print and write."""

from functools import partial
from pathlib import Path

import numpy as np
import typer
from rich.console import Console

from rafl.calibration.board import read_board
from rafl.calibration.board_images import board_views, check_shared_world, image_path
from rafl.calibration.board_picture import board_picture, world_view
from rafl.calibration.camera import Camera
from rafl.calibration.detection.image_file import read_grey_image
from rafl.calibration.foreign.placement import KnownPoints, place_rig
from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rest_pose import camera_from_points
from rafl.calibration.rig import BoardSource, Rig, read_board_source, write_calibration
from rafl.calibration.solve import solve_rig
from rafl.calibration.summary import camera_table, check_table, perspective_messages
from rafl.calibration.validation import check_view, write_residual_plot
from rafl.common.command_line import create_table, next_command, progress
from rafl.common.errors import InputError
from rafl.common.files import require_writable, written_files
from rafl.common.kernels import announce_compilation
from rafl.tracking.linking.layout import read_layout
from rafl.tracking.rest import FACES, RestView, match_rest_video, open_rest_videos
from rafl.tracking.video.reader import Video

# Residual of a camera [px] from which its calibration gets a warning. Good images leave 0.02 to 0.2 px.
LARGE_RESIDUAL_PX = 0.5


def calibrate(images: Path, board: Path, model: str, tilt_sign: list[str], depth: float, out: Path) -> None:
    """Calibrate a rig from board images, print its cameras and write it; draw the world beside it for each camera.

    Args:
        images: folder with one subfolder of board images per camera.
        board: board description.
        model: orthographic or pinhole.
        tilt_sign: CAMERA=+ or CAMERA=-, as the option says.
        depth: of the specimen [m].
        out: calibration to write.

    Raises:
        InputError: a file cannot be read, or the images do not determine the cameras.
    """
    require_writable(out)
    description = read_board(board)
    views, sizes = board_views(images, description)
    check_shared_world(views)
    solution = solve_rig(views, sizes, description, _tilt_signs(tilt_sign, list(views)), model)
    shown = {name: world_view(own) for name, own in views.items()}
    pictures = {
        out.with_name(f"{out.stem}-{name}.png"): board_picture(
            read_grey_image(image_path(images, shown[name].name)), shown[name], camera
        )
        for name, camera in solution.rig.cameras.items()
    }
    with written_files(pictures):
        write_calibration(out, solution.rig, BoardSource(images, board))
    Console(width=110).print(camera_table(solution, views))
    for name, camera in solution.rig.cameras.items():
        if camera.residual > LARGE_RESIDUAL_PX:
            typer.echo(
                f"warning: camera {name}: the residual of {camera.residual:.3f} px is large; check the positions under "
                "`world` and the pattern in board.yaml, and leave out blurred images",
                err=True,
            )
    for line in perspective_messages(solution, depth, model):
        typer.echo(line)
    typer.echo(f"wrote {', '.join(map(str, pictures))}: check the origin and the axes of the world there")
    where = "" if read_board_source(out) else f" --images {images} --board {board}"
    typer.echo(f"all images with their residuals: rafl-review {out}{where}")
    _print_next(out)


def calibrate_from_rest(folder: Path, specimen: Path, face: list[str], tilt_sign: list[str], out: Path) -> None:
    """Calibrate a rig from videos of the specimen at rest, print its cameras and write it.

    Args:
        folder: one video per camera.
        specimen: specimen description with the marker positions.
        face: CAMERA=FACE, the face that a camera films.
        tilt_sign: CAMERA=+ or CAMERA=-, as the option says.
        out: calibration to write.

    Raises:
        InputError: a file cannot be read, or the markers do not determine a camera.
    """
    require_writable(out)
    videos = open_rest_videos(folder)
    signs = _tilt_signs(tilt_sign, list(videos))
    table = create_table("camera", "face", "markers", "residual [px]", "px/mm", "sigma [px/mm]", "tilt [deg]")
    cameras: dict[str, Camera] = {}
    for name, view in _match_rest_videos(videos, specimen, face).items():
        fit = camera_from_points(view.points, view.pixels, videos[name].size, name, signs.get(name))
        camera = fit.camera
        cameras[name] = camera
        assert camera.covariance
        tilt = f"below {np.degrees(fit.undetected_tilt):.1f}" if fit.undetected_tilt else f"{np.degrees(fit.tilt):.1f}"
        numbers = (f"{camera.residual:.3f}", f"{1e-3 * camera.scale[0]:.4f}", f"{camera.covariance[0][0] ** 0.5:.4f}")
        table.add_row(name, view.face, str(len(view.points)), *numbers, tilt)
    write_calibration(out, Rig(cameras))
    Console(width=110).print(table)
    typer.echo("assumed: square pixels, no lens distortion, no perspective; only a board shows whether they hold")
    _print_next(out)


def place_calibration(calib: Path, unit: str | None, folder: Path, specimen: Path, face: list[str], out: Path) -> None:
    """Place a calibration in the specimen frame by videos of the specimen at rest, print its cameras and write it.

    Args:
        calib: calibration of pinhole cameras.
        unit: of the lengths in a calibration of another program that does not state it; None otherwise.
        folder: one video per camera.
        specimen: specimen description with the marker positions.
        face: CAMERA=FACE, the face that a camera films.
        out: calibration to write.

    Raises:
        InputError: a file cannot be read, or the markers do not determine the pose of the cameras.
    """
    require_writable(out)
    videos = open_rest_videos(folder)
    rig = read_any_calibration(calib, unit, lambda _: {name: video.size for name, video in videos.items()})
    if set(rig.cameras) != set(videos):
        raise InputError(
            f"{folder}: expected a video of every camera in {calib} ({', '.join(rig.cameras)}), found those of "
            f"{', '.join(videos)}; rename the videos after the cameras"
        )
    views = _match_rest_videos(videos, specimen, face)
    placed = place_rig(rig, {name: KnownPoints(view.points, view.pixels) for name, view in views.items()})
    write_calibration(out, placed)
    table = create_table("camera", "face", "markers", "residual [px]")
    for name, view in views.items():
        table.add_row(name, view.face, str(len(view.points)), f"{placed.cameras[name].residual:.3f}")
    Console(width=110).print(table)
    _print_next(out)


def _match_rest_videos(videos: dict[str, Video], specimen: Path, face: list[str]) -> dict[str, RestView]:
    """The markers that each camera sees of the specimen at rest, with a progress bar."""
    announce_compilation()
    layout = read_layout(specimen)
    faces = _values_by_camera("--face", face, list(videos), tuple(FACES))
    views = {}
    with progress() as bar:
        for name, video in videos.items():
            tick = partial(bar.advance, bar.add_task(name, total=video.frames or None))
            views[name] = match_rest_video(name, video, layout, faces.get(name), tick)
    return views


def check_calibration(calib: Path, unit: str | None, images: Path, board: Path) -> None:
    """Print the residuals of a calibration on board images, and draw them into check-CAMERA.png.

    Args:
        calib: calibration.
        unit: of the lengths in a calibration of another program that does not state it; None otherwise.
        images: folder with one subfolder of board images per camera.
        board: board description.

    Raises:
        InputError: a file cannot be read, or the images are not of the calibrated cameras.
    """
    views, sizes = board_views(images, read_board(board))
    rig = read_any_calibration(calib, unit, lambda _: sizes)
    checked = {}
    for name, own in views.items():
        if name not in rig.cameras:
            raise InputError(f"expected images of {', '.join(rig.cameras)} as in {calib}, found camera {name!r}")
        camera = rig.cameras[name]
        if camera.image_size != sizes[name]:
            raise InputError(
                f"camera {name}: expected images of {camera.image_size[0]} x {camera.image_size[1]} as calibrated, "
                f"found {sizes[name][0]} x {sizes[name][1]}; take them at the calibrated size"
            )
        if not own:
            raise InputError(f"camera {name}: expected images that show the board, found none; check board.yaml")
        with progress() as bar:
            placed = bar.track(own, description=f"{name}: locating the board")
            checked[name] = [check_view(camera, view) for view in placed]
        path = Path(f"check-{name}.png")
        write_residual_plot(path, camera.image_size, checked[name], name)
        typer.echo(f"wrote {path}")
    Console(width=110).print(check_table(rig, checked))


def _print_next(out: Path) -> None:
    typer.echo(f"wrote {out}")
    beside = out.parent / "videos"
    videos = beside if beside.is_dir() else "videos/"
    remark = "(with --specimen, once there is a specimen file)"
    typer.echo(next_command("rafl-track", videos, "--calib", out, remark=remark))


def _values_by_camera(option: str, given: list[str], cameras: list[str], allowed: tuple[str, ...]) -> dict[str, str]:
    """The values of CAMERA=VALUE options. A single camera need not be named."""
    values = {}
    for text in given:
        camera, _, value = text.rpartition("=")
        if not camera and len(cameras) == 1:
            camera = cameras[0]
        if camera not in cameras or value not in allowed:
            raise InputError(
                f"{option}: expected CAMERA=VALUE with one of {', '.join(cameras)} and one of {', '.join(allowed)}, "
                f"found {text!r}"
            )
        values[camera] = value
    return values


def _tilt_signs(given: list[str], cameras: list[str]) -> dict[str, int]:
    values = _values_by_camera("--tilt-sign", given, cameras, ("+", "-"))
    return {camera: 1 if sign == "+" else -1 for camera, sign in values.items()}
