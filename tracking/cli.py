"""The commands `rafl-calibrate` and `rafl-track`."""

import os
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rafl.calibration.board import View, read_board
from rafl.calibration.board_images import board_views, check_placed
from rafl.calibration.camera import Camera
from rafl.calibration.rig import Rig, read_rig, write_rig
from rafl.calibration.solve import solve_rig
from rafl.calibration.summary import camera_table, check_table, lens_lines
from rafl.calibration.validation import check_view, write_picture
from rafl.tracking.linking.layout import read_layout
from rafl.tracking.overlay import write_overlay
from rafl.tracking.pipeline import TrackingSettings, finished, track_recording
from rafl.tracking.reconstruction.export import WRITERS, export_name
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.report import summary_cells, write_report
from rafl.tracking.rest import FACES, camera_at_rest, rest_videos
from rafl.tracking.video.reader import Video
from rafl.tracking.video.recordings import find_recordings
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from threadpoolctl import threadpool_limits

from rafl.common.command_line import command_line, progress, user_command
from rafl.common.errors import InputError

MODELS = ("orthographic", "pinhole")
HEEDING = 1.0  # s after which whoever waits looks whether it was told to stop: not every signal wakes it
SOON = 1e-4  # s after which a thread that needs the interpreter has it: while a decoder waits, nothing is decoded

calibrate_app = command_line("Calibrate cameras.")
track_app = command_line("Follow dots in videos.")


@calibrate_app.command()
@user_command
def calibrate(
    images: Annotated[
        Path | None, typer.Argument(help="Folder with a sub-folder of board pictures per camera.")
    ] = None,
    board: Annotated[Path | None, typer.Option(help="Board description [IMAGES/board.yaml].")] = None,
    from_rest: Annotated[
        Path | None, typer.Option(help="Instead of IMAGES: folder with a video per camera of the specimen at rest.")
    ] = None,
    specimen: Annotated[
        Path | None, typer.Option(help="With --from-rest: specimen.yaml, where its markers sit.")
    ] = None,
    face: Annotated[
        list[str] | None, typer.Option(help="With --from-rest: CAMERA=y-min and the like, the face it films.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Calibration to write.")] = Path("calib.yaml"),
    model: Annotated[str, typer.Option(help="orthographic or pinhole.")] = "orthographic",
    tilt_sign: Annotated[
        list[str] | None,
        typer.Option(help="CAMERA=+ where the right (or lower) edge of its reference board is farther away; CAMERA=-."),
    ] = None,
    depth_mm: Annotated[float, typer.Option(min=0.0, help="Depth of the specimen, for the lens check.")] = 30.0,
    check: Annotated[Path | None, typer.Option(help="calib.yaml to judge by these pictures instead.")] = None,
) -> None:
    """Solve a rig from pictures of a ChArUco board, a chessboard or a dot grid, or from a specimen at rest.

    Example: rafl-calibrate calibration-images/ --out calib.yaml

    Without a board: rafl-calibrate --from-rest rest/ --specimen specimen.yaml --face left=y-min

    With --check CALIB nothing is solved: residuals on pictures the calibration was not made from.
    """
    if model not in MODELS:
        raise InputError(f"--model: expected {' or '.join(MODELS)}, found {model!r}")
    if (images is None) == (from_rest is None):
        raise InputError("expected a folder of board pictures, or --from-rest and a folder of videos; give one of them")
    if from_rest is not None:
        if board or check or model != "orthographic":
            raise InputError("--from-rest: expected neither --board, --check nor --model pinhole; leave them out")
        if specimen is None:
            raise InputError("--from-rest: expected --specimen specimen.yaml, which says where the markers sit")
        _calibrate_from_rest(from_rest, specimen, face or [], tilt_sign or [], out)
        return
    assert images is not None
    if specimen or face:
        raise InputError("expected --specimen and --face with --from-rest only; leave them out")
    description = read_board(board or images / "board.yaml")
    views, sizes = board_views(images, description)
    if check is not None:
        _check(check, views, sizes)
        return
    check_placed(views)
    solution = solve_rig(views, sizes, description, _signs(tilt_sign or [], list(views)), model)
    write_rig(out, solution.rig)
    Console(width=110).print(camera_table(solution, views))
    for line in lens_lines(solution, 1e-3 * depth_mm, model):
        typer.echo(line)
    _say_next(out)


def _calibrate_from_rest(folder: Path, specimen: Path, face: list[str], tilt_sign: list[str], out: Path) -> None:
    layout = read_layout(specimen)
    videos = rest_videos(folder)
    faces = _by_camera("--face", face, list(videos), tuple(FACES))
    signs = _signs(tilt_sign, list(videos))
    table = Table("camera", "face", "markers", "residual [px]", "px/mm", "+-", "tilt [deg]")
    cameras: dict[str, Camera] = {}
    with progress() as bar:
        for name, video in videos.items():
            task = bar.add_task(name, total=video.frames or None)
            tick = partial(bar.advance, task)
            view = camera_at_rest(name, video, layout, faces.get(name), signs.get(name), tick)
            camera, found = view.found.camera, view.found
            cameras[name] = camera
            assert camera.covariance
            tilt = f"below {np.degrees(found.unsure):.1f}" if found.unsure else f"{np.degrees(found.tilt):.1f}"
            numbers = (
                f"{camera.residual:.3f}",
                f"{1e-3 * camera.scale[0]:.4f}",
                f"{camera.covariance[0][0] ** 0.5:.4f}",
            )
            table.add_row(name, view.face, str(view.markers), *numbers, tilt)
    write_rig(out, Rig(cameras))
    Console(width=110).print(table)
    typer.echo("square pixels and a lens without distortion or perspective are taken for granted; a board tells them")
    _say_next(out)


def _say_next(out: Path) -> None:
    typer.echo(f"wrote {out}")
    typer.echo(f"next: rafl-track videos/ --calib {out}")


def _by_camera(option: str, given: list[str], cameras: list[str], allowed: tuple[str, ...]) -> dict[str, str]:
    """What CAMERA=VALUE options say; a single camera need not be named."""
    said = {}
    for text in given:
        camera, _, value = text.rpartition("=")
        if not camera and len(cameras) == 1:
            camera = cameras[0]
        if camera not in cameras or value not in allowed:
            raise InputError(
                f"{option}: expected CAMERA=VALUE with one of {', '.join(cameras)} and one of {', '.join(allowed)}, "
                f"found {text!r}"
            )
        said[camera] = value
    return said


def _signs(given: list[str], cameras: list[str]) -> dict[str, int]:
    said = _by_camera("--tilt-sign", given, cameras, ("+", "-"))
    return {camera: 1 if sign == "+" else -1 for camera, sign in said.items()}


def _check(calib: Path, views: dict[str, list[View]], sizes: dict[str, tuple[int, int]]) -> None:
    rig = read_rig(calib)
    checked = {}
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
            placed = bar.track(own, description=f"{name}: placing the board")
            checked[name] = [check_view(camera, view) for view in placed]
        path = Path(f"check-{name}.png")
        write_picture(path, camera.image_size, checked[name], name)
        typer.echo(f"wrote {path}")
    Console(width=110).print(check_table(rig, checked))


@track_app.command()
@user_command
def track(
    videos: Annotated[Path, typer.Argument(help="Folder of videos (or of pictures), or one video.")],
    calib: Annotated[Path, typer.Option(help="Calibration (calib.yaml).")],
    specimen: Annotated[Path | None, typer.Option(help="specimen.yaml: names the markers.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the tracks.")] = Path("tracks"),
    fps: Annotated[float | None, typer.Option(min=0.1, help="True frames per second.")] = None,
    fill: Annotated[int, typer.Option(min=0, help="Longest gap bridged [frames].")] = 5,
    sync: Annotated[bool, typer.Option("--sync", help="Find the cameras' delays from the motion.")] = False,
    export: Annotated[str, typer.Option(help="Also write these, by commas: csv, c3d, trc, npy.")] = "",
    overlay: Annotated[bool, typer.Option("--overlay", help="Also write videos with names drawn in.")] = False,
    jobs: Annotated[int | None, typer.Option(min=1, help="Recordings side by side [the cores].")] = None,
) -> None:
    """Find the dots in every recording, follow and name them, and place them in 3-D.

    Recordings that were tracked before from the same videos, cameras and settings are kept.

    Example: rafl-track videos/ --calib calib.yaml --specimen specimen.yaml
    """
    kinds = [kind.strip().lower() for kind in export.split(",") if kind.strip()]
    for kind in kinds:
        if kind not in WRITERS:
            raise InputError(f"--export: expected some of {', '.join(WRITERS)}, found {kind!r}")
    rig = read_rig(calib)
    settings = TrackingSettings(read_layout(specimen) if specimen else None, fps, fill, sync)
    recordings = find_recordings(videos, rig, calib)
    done: dict[str, Tracks] = {}
    failed: dict[str, str] = {}
    kept: list[str] = []
    cv2.setNumThreads(1)  # decoders and followers have the cores; BLAS threads that wait for work keep them busy
    sys.setswitchinterval(SOON)
    one_thread = threadpool_limits(1, user_api="blas")
    with one_thread, progress() as bar, _side_by_side(jobs or os.cpu_count() or 1) as (pool, stopped):
        waiting = {
            name: pool.submit(_one, out / f"{name}.h5", sources, rig, settings, bar, stopped)
            for name, sources in recordings.items()
        }
        for name, future in waiting.items():
            while not wait([future], HEEDING).done:
                pass
            try:
                done[name], was_there = future.result()
            except InputError as error:
                failed[name] = str(error)
                continue
            if was_there:
                kept.append(name)
            if overlay:
                for camera, video in recordings[name].items():
                    path = out / f"{name}_{camera}_overlay.mp4"
                    task = bar.add_task(f"{name}: drawing {camera}", total=len(done[name].time))
                    tick = partial(bar.advance, task)
                    write_overlay(path, video, camera, rig.cameras[camera], done[name], tick)
                    bar.remove_task(task)
            for kind in kinds:
                WRITERS[kind](out / export_name(kind, name, list(recordings).index(name)), done[name])
    if not done:
        first = next(iter(failed))
        raise InputError(f"recording {first}: {failed[first]}")
    write_report(out / "report.html", done, rig)
    Console(width=110).print(_summary(done))
    for name, tracks in done.items():
        for note in tracks.notes:
            typer.echo(f"note: recording {name}: {note}")
    for name, reason in failed.items():
        typer.echo(f"error: recording {name}: {reason}", err=True)
    if kept:
        typer.echo(f"kept {len(kept)} recordings that were tracked before")
    typer.echo(f"wrote {len(done) - len(kept)} tracks files to {out}/; look at {out}/report.html")
    typer.echo(f"next: rafl-capture specimen.yaml {out} --recordings recordings.csv --out datasets/NAME.h5")
    if failed:
        raise typer.Exit(1)


@contextmanager
def _side_by_side(jobs: int) -> Iterator[tuple[ThreadPoolExecutor, threading.Event]]:
    """Threads for so many jobs, and what tells these to give up: that whoever waits for them was stopped."""
    stopped = threading.Event()
    pool = ThreadPoolExecutor(jobs)
    try:
        yield pool, stopped
    finally:
        stopped.set()
        pool.shutdown(cancel_futures=True)


def _one(
    path: Path,
    sources: dict[str, Video],
    rig: Rig,
    settings: TrackingSettings,
    bar: Progress,
    stopped: threading.Event,
) -> tuple[Tracks, bool]:
    """Tracks of one recording, and whether they were there already."""
    before = finished(path, sources, rig, settings)
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


def _summary(done: dict[str, Tracks]) -> Table:
    table = Table("recording", "frames", "markers", "measured", "filled", "missing", "sigma [px]", "residual [px]")
    for name, tracks in done.items():
        table.add_row(name, *summary_cells(tracks))
    return table
