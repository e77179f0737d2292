"""The command `rafl-track`."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from calibration.rig import Rig, read_rig
from groundwork import InputError, command_line, progress, user_command
from tracking.layout import read_layout
from tracking.overlay import write_overlay
from tracking.pipeline import TrackingSettings, track_recording
from tracking.recordings import find_recordings
from tracking.tracks import FILLED, MEASURED, Tracks, write_tracks
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
    overlay: Annotated[bool, typer.Option("--overlay", help="Also write videos with names drawn in.")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Recordings side by side.")] = 2,
) -> None:
    """Find the dots in every recording, follow and name them, and place them in 3-D.

    Example: rafl-track videos/ --calib calib.yaml --specimen specimen.yaml
    """
    rig = read_rig(calib)
    settings = TrackingSettings(read_layout(specimen) if specimen else None, fps, fill)
    recordings = find_recordings(videos, rig, calib)
    done: dict[str, Tracks] = {}
    failed: dict[str, str] = {}
    with progress() as bar, ThreadPoolExecutor(jobs) as pool:
        waiting = {name: pool.submit(_one, name, sources, rig, settings, bar) for name, sources in recordings.items()}
        for name, future in waiting.items():
            try:
                done[name] = future.result()
            except InputError as error:
                failed[name] = str(error)
                continue
            write_tracks(out / f"{name}.h5", done[name])
            if overlay:
                for camera, video in recordings[name].items():
                    task = bar.add_task(f"{name}: drawing {camera}", total=len(done[name].time))
                    path = out / f"{name}_{camera}_overlay.mp4"
                    write_overlay(path, video, camera, done[name], partial(bar.advance, task))
                    bar.remove_task(task)
    if not done:
        first = next(iter(failed))
        raise InputError(f"recording {first}: {failed[first]}")
    Console(width=110).print(_summary(done))
    for name, reason in failed.items():
        typer.echo(f"error: recording {name}: {reason}", err=True)
    typer.echo(f"wrote {len(done)} tracks files to {out}/")
    typer.echo(f"next: rafl-capture specimen.yaml {out} --recordings recordings.csv --out datasets/NAME.h5")
    if failed:
        raise typer.Exit(1)


def _one(name: str, sources: dict[str, Video], rig: Rig, settings: TrackingSettings, bar: Progress) -> Tracks:
    total = sum(video.frames for video in sources.values())
    task = bar.add_task(name, total=total or None)
    try:
        return track_recording(sources, rig, settings, lambda: bar.advance(task))
    finally:
        bar.remove_task(task)


def _summary(done: dict[str, Tracks]) -> Table:
    table = Table("recording", "frames", "markers", "measured", "filled", "gaps", "sigma [px]", "residual [px]")
    for name, tracks in done.items():
        state = tracks.state
        gone = state != MEASURED
        gaps = int((gone[1:] & ~gone[:-1]).sum() + gone[0].sum())
        residual = np.concatenate([values[np.isfinite(values)] for values in tracks.residual.values()])
        sigma = np.concatenate([values[np.isfinite(values)] for values in tracks.pixel_sigma.values()])
        table.add_row(
            name,
            str(len(tracks.time)),
            str(len(tracks.names)),
            f"{(state == MEASURED).mean():.1%}",
            f"{(state == FILLED).mean():.1%}",
            str(gaps),
            f"{np.median(sigma):.3f}",
            f"{np.sqrt((residual**2).mean()):.3f}",
        )
    return table
