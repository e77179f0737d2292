"""What `rafl-track` does once its options are checked: call the library, print and write."""

import os
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
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

from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rig import Rig
from rafl.common.command_line import create_table, next_command, progress
from rafl.common.errors import InputError
from rafl.common.files import require_writable
from rafl.common.kernels import announce_compilation
from rafl.tracking.linking.layout import MarkerLayout, read_layout
from rafl.tracking.linking.naming import with_face_planes
from rafl.tracking.overlay import write_overlay
from rafl.tracking.pipeline import TrackingSettings, existing_tracks, track_recording
from rafl.tracking.reconstruction.corrected_tracks import with_corrections
from rafl.tracking.reconstruction.export import WRITERS, export_name
from rafl.tracking.reconstruction.tracks import Tracks, write_tracks
from rafl.tracking.report import summary_cells, write_report
from rafl.tracking.video.reader import Video
from rafl.tracking.video.recordings import filmed_cameras, find_videos, open_videos

# Time [s] between two checks for a signal while waiting for a recording: not every signal interrupts the wait.
SIGNAL_CHECK_S = 1.0
# Longest time [s] that a thread waits for the interpreter. A decoder that waits for it decodes nothing.
THREAD_SWITCH_S = 1e-4


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
    only: list[str],
) -> None:
    """Track every recording that has no tracks yet; write tracks, exports, overlays and a report.

    Exports, overlays and report contain the corrections that lie beside the tracks.

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
        only: names of the recordings to track, without a report; empty for all.

    Raises:
        InputError: a file cannot be read, a name is of no recording, or no recording could be tracked.
        typer.Exit: some recordings could not be tracked; code 1.
    """
    announce_compilation()
    require_writable(out)
    settings = TrackingSettings(read_layout(specimen) if specimen else None, fps, fill, sync)
    layout = settings.layout
    rig = read_rig(calib, unit, videos, layout)
    places = dict(zip(layout.names, layout.positions, strict=True)) if layout else {}
    found = find_videos(videos, rig, calib)
    check_recordings(only, found)
    recordings: dict[str, dict[str, Video]] = {}
    done: dict[str, Tracks] = {}
    failed: dict[str, str] = {}
    for name, paths in found.items():
        if only and name not in only:
            continue
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
                tracked, was_there = future.result()
                done[name] = with_corrections(tracked, out / f"{name}.h5").tracks
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
    if not only:
        write_report(out / "report.html", done, rig)
    print_results(out, done, failed, len(kept), specimen, report=not only)
    if failed:
        raise typer.Exit(1)


def check_recordings(only: Iterable[str], found: Mapping[str, object]) -> None:
    """Check names that a user gives against the recordings that were found.

    Raises:
        InputError: there is no such recording.
    """
    if absent := set(only) - found.keys():
        raise InputError(f"--recording: expected some of {', '.join(found)}, found {sorted(absent)[0]!r:.80}")


def read_rig(calib: Path, unit: str | None, videos: Path, layout: MarkerLayout | None) -> Rig:
    """The cameras of a calibration, with the faces that they film if a layout tells them; as in `track`.

    Raises:
        InputError: the calibration cannot be read.
    """
    rig = read_any_calibration(calib, unit, partial(_announce_filmed, calib, videos))
    return with_face_planes(rig, layout) if layout else rig


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


def print_results(
    out: Path, done: dict[str, Tracks], failed: dict[str, str], kept: int, specimen: Path | None, report: bool = True
) -> None:
    """Print a table of tracks, their notes, what failed, and what follows.

    Args:
        out: folder of the tracks.
        done: tracks by recording.
        failed: reasons by recording.
        kept: number of recordings whose tracks were there before.
        specimen: that named the markers; None for none.
        report: whether report.html was written.
    """
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
    typer.echo(f"wrote {len(done) - kept} tracks files to {out}/" + (f"; look at {out}/report.html" if report else ""))
    if specimen:
        beside = out.parent / "recordings.csv"
        table = beside if beside.exists() else beside.name
        typer.echo(next_command("rafl-capture", specimen, out, "--recordings", table))
    else:
        still = min(done, key=lambda name: _extent(done[name]))
        remark = "(of the body in mm), if it is at rest"
        typer.echo(next_command("rafl-specimen", out / f"{still}.h5", "--box", "LENGTHxWIDTHxHEIGHT", remark=remark))


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
