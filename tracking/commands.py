"""What `rafl-calibrate` and `rafl-track` do once their options are checked: call the library, print and write."""

import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from threadpoolctl import threadpool_limits

from rafl.calibration.board import read_board
from rafl.calibration.board_images import board_views, check_shared_world, image_path
from rafl.calibration.board_picture import board_picture, world_view
from rafl.calibration.camera import Camera
from rafl.calibration.detection.image_file import read_grey_image
from rafl.calibration.foreign.placement import KnownPoints, place_rig
from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rest_pose import camera_from_points
from rafl.calibration.rig import Rig, write_calibration
from rafl.calibration.solve import solve_rig
from rafl.calibration.summary import camera_table, check_table, perspective_messages
from rafl.calibration.validation import check_view, write_residual_plot
from rafl.common.command_line import create_table, progress
from rafl.common.errors import InputError
from rafl.common.files import require_writable, written_files
from rafl.common.kernels import announce_compilation
from rafl.tracking.linking.layout import read_layout
from rafl.tracking.linking.naming import with_face_planes
from rafl.tracking.overlay import write_overlay
from rafl.tracking.pipeline import TrackingSettings, existing_tracks, track_recording
from rafl.tracking.reconstruction.export import WRITERS, export_name
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.report import summary_cells, write_report
from rafl.tracking.rest import FACES, RestView, match_rest_video, open_rest_videos
from rafl.tracking.video.reader import Video
from rafl.tracking.video.recordings import filmed_cameras, find_videos, open_videos

# Time [s] between two checks for a signal while waiting for a recording: not every signal interrupts the wait.
SIGNAL_CHECK_S = 1.0
# Longest time [s] that a thread waits for the interpreter. A decoder that waits for it decodes nothing.
THREAD_SWITCH_S = 1e-4
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
        write_calibration(out, solution.rig)
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
    typer.echo(f"next: rafl-track videos/ --calib {out} (with --specimen, once there is a specimen file)")


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


def track(
    videos: Path,
    calib: Path,
    unit: str | None,
    specimen: Path | None,
    out: Path,
    fps: float | None,
    fill: int,
    sync: bool,
    exports: list[str],
    overlay: bool,
    jobs: int | None,
) -> None:
    """Track every recording that has no tracks yet; write tracks, exports, overlays and a report.

    Args:
        videos: folder of videos, or one video.
        calib: calibration.
        unit: of the lengths in a calibration of another program that does not state it; None otherwise.
        specimen: specimen description that names the markers; None to name them by row and column.
        out: folder for the tracks.
        fps: true frames per second; None to trust the videos.
        fill: longest gap to fill [frames].
        sync: whether to find the time offsets of the cameras from the motion.
        exports: keys of `WRITERS`.
        overlay: whether to write overlay videos.
        jobs: recordings tracked at the same time; None for the number of cores.

    Raises:
        InputError: a file cannot be read, or no recording could be tracked.
        typer.Exit: some recordings could not be tracked; code 1.
    """
    announce_compilation()
    require_writable(out)
    rig = read_any_calibration(calib, unit, partial(_announce_filmed, calib, videos))
    settings = TrackingSettings(read_layout(specimen) if specimen else None, fps, fill, sync)
    layout = settings.layout
    rig = with_face_planes(rig, layout) if layout else rig
    places = dict(zip(layout.names, layout.positions, strict=True)) if layout else {}
    found = find_videos(videos, rig, calib)
    recordings: dict[str, dict[str, Video]] = {}
    done: dict[str, Tracks] = {}
    failed: dict[str, str] = {}
    for name, paths in found.items():
        try:
            recordings[name] = open_videos(paths, rig)
        except InputError as error:
            failed[name] = str(error)
    kept: list[str] = []
    cv2.setNumThreads(1)  # the decoding and tracking threads use the cores; BLAS threads would keep them busy
    sys.setswitchinterval(THREAD_SWITCH_S)
    one_thread = threadpool_limits(1, user_api="blas")
    with one_thread, progress() as bar, _thread_pool(jobs or os.cpu_count() or 1) as (pool, stopped):
        waiting = {
            name: pool.submit(_track_one, out / f"{name}.h5", sources, rig, settings, bar, stopped)
            for name, sources in recordings.items()
        }
        for name, future in waiting.items():
            while not wait([future], SIGNAL_CHECK_S).done:
                pass
            try:
                done[name], was_there = future.result()
            except InputError as error:
                failed[name] = str(error)
                continue
            if was_there:
                kept.append(name)
            try:
                if overlay:
                    _write_overlays(out, name, recordings[name], rig, done[name], bar)
                for kind in exports:
                    WRITERS[kind](out / export_name(kind, name, list(found).index(name)), done[name], places)
            except InputError as error:
                failed[name] = str(error)
    if not done:
        first = next(iter(failed))
        raise InputError(f"recording {first}: {failed[first]}")
    write_report(out / "report.html", done, rig)
    _print_results(out, done, failed, len(kept), specimen)
    if failed:
        raise typer.Exit(1)


def _write_overlays(out: Path, name: str, videos: dict[str, Video], rig: Rig, tracks: Tracks, bar: Progress) -> None:
    """Draw the tracks of one recording over the video of each camera."""
    for camera, video in videos.items():
        task = bar.add_task(f"{name}: drawing {camera}", total=len(tracks.time))
        path = out / f"{name}_{camera}_overlay.mp4"
        try:
            write_overlay(path, video, camera, rig.cameras[camera], tracks, partial(bar.advance, task))
        finally:
            bar.remove_task(task)


def _announce_filmed(calib: Path, videos: Path, count: int) -> dict[str, tuple[int, int]]:
    """The filmed cameras and their image sizes, which the calibration does not tell."""
    filmed = filmed_cameras(videos, count)
    typer.echo(
        f"camera names and image sizes that {calib} lacks are those of the videos: {', '.join(filmed)}, in order"
    )
    return filmed


def _print_results(
    out: Path, done: dict[str, Tracks], failed: dict[str, str], kept: int, specimen: Path | None
) -> None:
    Console(width=110).print(_summary_table(done))
    with_note: dict[str, list[str]] = {}
    for name, tracks in done.items():
        for note in tracks.notes:
            with_note.setdefault(note, []).append(name)
    for note, names in with_note.items():
        typer.echo(f"note: recording{'s' if len(names) > 1 else ''} {', '.join(names)}: {note}")
    for name, reason in failed.items():
        typer.echo(f"error: recording {name}: {reason}", err=True)
    if kept:
        typer.echo(f"kept the tracks of {kept} recordings: nothing changed since they were tracked")
    typer.echo(f"wrote {len(done) - kept} tracks files to {out}/; look at {out}/report.html")
    if specimen:
        typer.echo(f"next: rafl-capture {specimen} {out} --recordings recordings.csv")
    else:
        still = min(done, key=lambda name: _extent(done[name]))
        typer.echo(
            f"next: rafl-specimen {out}/{still}.h5 --box LENGTHxWIDTHxHEIGHT (of the body in mm), if it is at rest"
        )


def _extent(tracks: Tracks) -> float:
    """How far the markers move, in the mean of those that are seen [m]."""
    spread = [
        np.ptp(one[np.isfinite(one[:, 0])], axis=0).max()
        for one in np.moveaxis(tracks.position, 1, 0)
        if np.isfinite(one[:, 0]).any()
    ]
    return float(np.mean(spread))


@contextmanager
def _thread_pool(jobs: int) -> Iterator[tuple[ThreadPoolExecutor, threading.Event]]:
    """A pool of threads, and an event that is set when the command is stopped, which ends their work."""
    stopped = threading.Event()
    pool = ThreadPoolExecutor(jobs)
    try:
        yield pool, stopped
    finally:
        stopped.set()
        pool.shutdown(cancel_futures=True)


def _track_one(
    path: Path,
    sources: dict[str, Video],
    rig: Rig,
    settings: TrackingSettings,
    bar: Progress,
    stopped: threading.Event,
) -> tuple[Tracks, bool]:
    """The tracks of one recording, and whether they were there before."""
    before = existing_tracks(path, sources, rig, settings)
    if before is not None:
        return before, True
    total = sum(video.frames for video in sources.values())
    task = bar.add_task(path.stem, total=total or None)

    def tick() -> None:
        if stopped.is_set():
            raise CancelledError
        bar.advance(task)

    try:
        tracks = track_recording(sources, rig, settings, tick)
        write_tracks(path, tracks)
        return tracks, False
    finally:
        bar.remove_task(task)


def _summary_table(done: dict[str, Tracks]) -> Table:
    table = create_table(
        "recording", "frames", "markers", "measured", "filled", "missing", "sigma [px]", "residual [px]"
    )
    for name, tracks in done.items():
        table.add_row(name, *summary_cells(tracks))
    return table
