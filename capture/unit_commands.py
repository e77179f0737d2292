"""What `rafl-capture` does with --on: build the dataset as a unit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from rafl.batch.execute import end_of, execute
from rafl.batch.options import Batch
from rafl.batch.plain_command import plain_command
from rafl.batch.state import UNITS_FOLDER
from rafl.batch.unit import create_unit
from rafl.capture import cli
from rafl.capture.dataset.sources import find_sources
from rafl.capture.dataset.table import read_recording_rows
from rafl.capture.specimen.specimen import read_specimen
from rafl.common.command_line import next_command


def capture(given: Mapping[str, Any], how: Batch) -> None:
    """Build a dataset as a unit.

    Args:
        given: arguments of `rafl.capture.cli.capture`.
        how: where it runs.

    Raises:
        InputError: the specimen or the table of recordings is wrong, or a recording is missing.
        typer.Exit: the dataset could not be built; code 1.
    """
    specimen, tracks, recordings, names = (given[key] for key in ("specimen", "tracks", "recordings", "names"))
    path = given["out"] or Path("datasets") / f"{read_specimen(specimen).name}.h5"
    sources = [source for row in read_recording_rows(recordings) for source in find_sources(tracks, row.recording)]
    read = [specimen, recordings, *([names] if names else []), *sources]
    command = plain_command("rafl-capture", cli.capture, {**given, "out": path})
    unit = create_unit(path.stem, command, [path, path.with_suffix(".html")], read)
    ended = execute([unit], path.parent / UNITS_FOLDER, how)
    if ended is not None:
        end_of(ended, path.parent / UNITS_FOLDER)
        typer.echo(next_command("rafl-fit", path))
