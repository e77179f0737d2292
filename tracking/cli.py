"""The command `rafl-track`."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from calibration.rig import Rig, read_rig
from groundwork import InputError, command_line, progress, user_command
from tracking.export import WRITERS, export_name
from tracking.layout import read_layout
from tracking.overlay import write_overlay
from tracking.pipeline import TrackingSettings, finished, track_recording
from tracking.recordings import find_recordings
from tracking.report import summary_cells, write_report
from tracking.tracks import Tracks, write_tracks
from tracking.video import Video

app = command_line("Follow dots in videos.")


@app.command()
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
    with progress() as bar, ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        waiting = {
            name: pool.submit(_one, out / f"{name}.h5", sources, rig, settings, bar)
            for name, sources in recordings.items()
        }
        for name, future in waiting.items():
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


def _one(
    path: Path, sources: dict[str, Video], rig: Rig, settings: TrackingSettings, bar: Progress
) -> tuple[Tracks, bool]:
    """Tracks of one recording, and whether they were there already."""
    before = finished(path, sources, rig, settings)
    if before is not None:
        return before, True
    total = sum(video.frames for video in sources.values())
    task = bar.add_task(path.stem, total=total or None)
    try:
        tracks = track_recording(sources, rig, settings, lambda: bar.advance(task))
        write_tracks(path, tracks)
        return tracks, False
    finally:
        bar.remove_task(task)


def _summary(done: dict[str, Tracks]) -> Table:
    table = Table("recording", "frames", "markers", "measured", "filled", "missing", "sigma [px]", "residual [px]")
    for name, tracks in done.items():
        table.add_row(name, *summary_cells(tracks))
    return table
