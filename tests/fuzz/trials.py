"""One trial: a good laboratory, one file of it changed or one fault of the system, one command, and what must hold."""

import errno
import hashlib
import os
import shutil
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import click
import numpy as np
import stereo
import typer
from mutations import BY_SUFFIX, pick
from support import error_lines
from typer.testing import CliRunner

from rafl.batch.cluster import read_cluster
from rafl.calibration.board import read_board
from rafl.calibration.detection.image_file import read_grey_image
from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rig import Rig
from rafl.capture.cli import capture_app
from rafl.capture.dataset.naming import read_marker_names
from rafl.capture.specimen.specimen import read_specimen
from rafl.cli import eval_app, fit_app
from rafl.common.command_line import report_errors
from rafl.data.dataset_file import read_dataset
from rafl.evaluation.evaluation_file import EVALUATION_FILE, read_evaluation
from rafl.evaluation.page_data import PageData
from rafl.evaluation.page_file import page_file
from rafl.fitting.run_folder import load_model
from rafl.sweep.cli import sweep_app
from rafl.tracking.cli import track_app
from rafl.tracking.reconstruction.tracks import read_tracks

APPS = {
    "rafl-capture": capture_app,
    "rafl-fit": fit_app,
    "rafl-eval": eval_app,
    "rafl-sweep": sweep_app,
    "rafl-track": track_app,
}


def read_foreign(path: Path) -> Rig:
    """The calibration of another program, of cameras that were filmed."""
    unit = None if path.suffix == ".mat" else "mm"
    return read_any_calibration(path, unit, lambda count: dict.fromkeys(list(stereo.MATRICES)[:count], stereo.SIZE))


def page_of_evaluation(path: Path) -> str:
    """The page that shows an evaluation."""
    return page_file(PageData.of_evaluation(read_evaluation(path), "x"))


READERS: dict[str, Callable[[Path], object]] = {
    "read_specimen": read_specimen,
    "read_board": read_board,
    "read_cluster": read_cluster,
    "read_marker_names": read_marker_names,
    "load_model": load_model,
    "page_of_evaluation": page_of_evaluation,
    "read_grey_image": read_grey_image,
    "read_foreign": read_foreign,
}
CAPTURE = ("rafl-capture", "small.yaml")
OUT = ("--recordings", "recordings.csv", "--out", "out/data.h5")
FIT = ("--method", "sysid-e", "--epochs", "1", "--frames", "3", "--out")

# What is run, by name: the changed file, and the command line, or a reader and its argument.
TARGETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "specimen": ("small.yaml", (*CAPTURE, "tracks", *OUT)),
    "recordings": ("recordings.csv", (*CAPTURE, "tracks", *OUT)),
    "tracks": ("tracks/take1.h5", (*CAPTURE, "tracks", *OUT)),
    "corrections": ("tracks/take1.corrections.yaml", (*CAPTURE, "tracks", *OUT)),
    "csv": ("csv/take1.csv", (*CAPTURE, "csv", *OUT)),
    "c3d": ("c3d/take1.c3d", (*CAPTURE, "c3d", *OUT)),
    "trc": ("trc/take1.trc", (*CAPTURE, "trc", *OUT)),
    "npy": ("npy/take1.npy", (*CAPTURE, "npy", *OUT)),
    "update": ("out/data.h5", (*CAPTURE, "tracks", *OUT, "--update")),
    "names": ("names.csv", ("read_marker_names", "names.csv")),
    "surface description": ("body.yaml", ("read_specimen", "body.yaml")),
    "surface": ("body.stl", ("read_specimen", "body.yaml")),
    "board": ("board.yaml", ("read_board", "board.yaml")),
    "dataset, inspect": ("data.h5", ("rafl-capture", "--inspect", "data.h5", "--verify", "data.h5")),
    "dataset, fit": ("data.h5", ("rafl-fit", "data.h5", *FIT, "new-run")),
    "dataset, evaluate": ("data.h5", ("rafl-eval", "run", "data.h5", "--out", "out")),
    "model": ("run/model.pt", ("load_model", "run")),
    "field": ("field/model.pt", ("load_model", "field")),
    "model, evaluate": ("run/model.pt", ("rafl-eval", "run", "data.h5", "--out", "out")),
    "evaluation": ("run/evaluation.h5", ("page_of_evaluation", "run/evaluation.h5")),
    "settings": ("run/config.yaml", ("rafl-fit", "data.h5", *FIT, "run", "--resume")),
    "checkpoint": ("run/checkpoint.pt", ("rafl-fit", "data.h5", *FIT, "run", "--resume")),
    "plan": ("plan.yaml", ("rafl-sweep", "plan.yaml", "--out", "out", "--print-commands")),
    "cluster": ("cluster.yaml", ("read_cluster", "cluster.yaml")),
    "units": ("sweep/units/units.json", ("rafl-sweep", "sweep", "--status")),
    "state of a unit": ("sweep/units/one.json", ("rafl-sweep", "sweep", "--status")),
    "calibration": ("calib.yaml", ("rafl-track", "videos", "--calib", "calib.yaml", "--specimen", "dots.yaml")),
    "aniposelib": ("stereo.toml", ("read_foreign", "stereo.toml")),
    "OpenCV": ("left.yml", ("read_foreign", "left.yml")),
    "MATLAB": ("stereo.mat", ("read_foreign", "stereo.mat")),
    "DLT": ("dlt.csv", ("read_foreign", "dlt.csv")),
    "png": ("board.png", ("read_grey_image", "board.png")),
    "jpg": ("board.jpg", ("read_grey_image", "board.jpg")),
    "layout": ("dots.yaml", ("rafl-track", "videos", "--calib", "calib.yaml", "--specimen", "dots.yaml")),
    "video": ("videos/take1.mp4", ("rafl-track", "videos", "--calib", "calib.yaml", "--specimen", "dots.yaml")),
}
# Targets of which one trial takes seconds are chosen less often than the others.
WEIGHTS = {name: 0.25 if "evaluate" in name or name == "video" else 1.0 for name in TARGETS}
FAULTS = ("space", "write", "flush", "rename", "memory", "interruption")
# Faults at a time when some of several files are in their places, all of them whole.
LATE_FAULTS = ("fault: rename", "fault: flush", "fault: interruption")
FAULT_SHARE = 0.12  # of the trials

Content = dict[str, str]


@dataclass(frozen=True)
class Outcome:
    """What a trial did.

    Attributes:
        target, kind: what was run, and what was changed.
        code: the exit code.
        message: the last line of standard error.
        wrong: what must not have happened, empty if nothing.
    """

    target: str
    kind: str
    code: int
    message: str
    wrong: str


def run_line(line: tuple[str, ...]) -> tuple[int, str, BaseException | None]:
    """Exit code, standard error, and an error that came through."""
    if line[0] in APPS:
        result = CliRunner().invoke(APPS[line[0]], list(line[1:]))
    else:
        app = typer.Typer(pretty_exceptions_enable=False)
        app.command()(report_errors(lambda: print(READERS[line[0]](Path(line[1])))))
        result = CliRunner().invoke(app, [])
    through = result.exception if not isinstance(result.exception, (SystemExit, click.exceptions.Exit)) else None
    return result.exit_code, result.stderr, through


def contents(folder: Path) -> Content:
    """Hashes of all files, by path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in folder.rglob("*")
    }


@contextmanager
def fault(kind: str, random: np.random.Generator) -> Iterator[None]:
    """The system fails at one of the first calls of a function that writes, or at one that reads."""
    last = int(random.integers(0, 4))
    calls = 0

    def failing(function: Callable[..., Any], error: BaseException) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls > last:
                raise error
            return function(*arguments, **options)

        return call

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    denied = OSError(errno.EACCES, os.strerror(errno.EACCES))
    damaged = OSError(errno.EIO, os.strerror(errno.EIO))
    patches = {
        "space": (shutil, "disk_usage", lambda path: mock.Mock(free=100)),
        "write": (Path, "write_bytes", failing(Path.write_bytes, full)),
        "flush": (os, "fsync", failing(os.fsync, damaged)),
        "rename": (Path, "replace", failing(Path.replace, denied)),
        "memory": (Path, "read_text", failing(Path.read_text, MemoryError())),
        "interruption": (os, "fsync", failing(os.fsync, KeyboardInterrupt())),
    }
    owner, name, replacement = patches[kind]
    with mock.patch.object(owner, name, replacement):
        yield


def trial(seed: int, laboratory: Path, folder: Path) -> Outcome:
    """Run the trial of a seed.

    Args:
        seed: of all that is random in it.
        laboratory: good files, with a dataset in `out` and a run in `run`.
        folder: to work in; it is made, and removed.
    """
    random = np.random.default_rng(seed)
    shares = np.array(list(WEIGHTS.values()))
    target = pick(random, random.choice(list(TARGETS), 1, p=shares / shares.sum()).tolist())
    name, line = TARGETS[target]
    work = folder / "a" / "b"  # where two folders up are still the trial's own
    shutil.copytree(laboratory, work)
    settings = work / "run" / "config.yaml"  # has the absolute path of the dataset
    settings.write_text(settings.read_text().replace(str(laboratory.resolve()), str(work.resolve())))
    before_folder = Path.cwd()
    os.chdir(work)
    try:
        with ExitStack() as stack:
            if random.random() < FAULT_SHARE:
                kind = f"fault: {pick(random, FAULTS)}"
                before = contents(folder)
                stack.enter_context(fault(kind.removeprefix("fault: "), random))
            else:
                mutations = BY_SUFFIX[Path(name).suffix]
                kind = pick(random, list(mutations))
                try:
                    mutations[kind](Path(name), random)
                except Exception:  # a change that HDF5 or YAML does not allow is none
                    kind = f"{kind} (not possible)"
                before = contents(folder)
            code, stderr, through = run_line(line)
        wrong = _wrong(code, stderr, through) or _wrong_files(before, contents(folder), code, line, work, kind)
    finally:
        os.chdir(before_folder)
        shutil.rmtree(folder)
    lines = error_lines(stderr)
    return Outcome(target, kind, code, lines[-1] if lines else "", wrong)


def _wrong(code: int, stderr: str, through: BaseException | None) -> str:
    """What is wrong with how a command ended."""
    if through is not None:
        return "".join(traceback.format_exception(through))
    lines = error_lines(stderr)
    if code not in (0, 1, 2, 130):
        return f"exit code {code}: {lines}"
    errors = [line for line in lines if line.startswith("error: ")]
    others = [line for line in lines if not line.startswith(("error: ", "epoch ", "pre-training "))]
    if code == 2 and (others or len(errors) != 1):
        return f"expected one line, found {lines}"
    return f"expected a message, found {lines}" if code == 1 and not errors else ""


def _wrong_files(before: Content, after: Content, code: int, line: tuple[str, ...], work: Path, kind: str) -> str:
    """What is wrong with the files after a command."""
    changed = sorted(path for path in {*before, *after} if before.get(path) != after.get(path))
    hidden = [path for path in changed if Path(path).name.startswith(".")]
    outside = [path for path in changed if not path.startswith(("a/b/out", "a/b/new-run", "a/b/tracks", "a/b/run"))]
    if hidden or outside:
        return f"files that no one asked for: {hidden or outside}"
    whole = "--resume" in line or "new-run" in line or line[0] == "rafl-track" or kind in LATE_FAULTS
    if code and changed and not whole:  # commands that write several files, of which some may be there already
        return f"exit code {code}, and files changed: {changed}"
    if code and any(path.startswith("a/b/new-run") for path in changed) and not any(p.endswith(".pt") for p in changed):
        return f"a run folder that the next start refuses: {changed}"
    for path in changed:
        if (work.parents[1] / path).exists() and path.endswith(".h5"):
            read = read_evaluation if path.endswith(EVALUATION_FILE) else read_dataset
            (read_tracks if "/tracks/" in path else read)(work.parents[1] / path)
    return ""
