"""What `rafl-track` does with --on: make a unit of every recording, run them, and report on all."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rafl.batch.execute import end_of, execute
from rafl.batch.options import Batch
from rafl.batch.plain_command import plain_command
from rafl.batch.state import UNITS_FOLDER, Status
from rafl.batch.unit import create_unit
from rafl.tracking import cli
from rafl.tracking.commands import check_recordings, print_results, read_rig
from rafl.tracking.linking.layout import read_layout
from rafl.tracking.reconstruction.corrected_tracks import with_corrections
from rafl.tracking.reconstruction.tracks import Tracks, read_tracks
from rafl.tracking.report import write_report
from rafl.tracking.video.recordings import find_videos


def track(given: Mapping[str, Any], how: Batch) -> None:
    """Track recordings as units, and write one report.

    Args:
        given: arguments of `rafl.tracking.cli.track`.
        how: where units run.

    Raises:
        InputError: a file cannot be read, or a name is of no recording.
        typer.Exit: some recordings could not be tracked; code 1.
    """
    videos, calib, specimen, out = (given[key] for key in ("videos", "calib", "specimen", "out"))
    layout = read_layout(specimen) if specimen else None
    rig = read_rig(calib, given["calib_unit"], videos, layout)
    found = find_videos(videos, rig, calib)
    names = given["recording"] or list(found)
    check_recordings(names, found)
    units = []
    for name in names:
        command = plain_command("rafl-track", cli.track, {**given, "recording": [name]})
        read = [*found[name].values(), calib, *([specimen] if specimen else [])]
        units.append(create_unit(name, command, [out / f"{name}.h5"], read))
    ended = execute(units, out / UNITS_FOLDER, how)
    if ended is None:
        return
    done = {name: _tracks(out / f"{name}.h5") for name in names if ended.status[name] == Status.done}
    if done:
        if len(names) == len(found):
            write_report(out / "report.html", done, rig)
        print_results(out, done, {}, 0, specimen, report=len(names) == len(found))
    end_of(ended, out / UNITS_FOLDER)


def _tracks(path: Path) -> Tracks:
    return with_corrections(read_tracks(path), path).tracks
