"""`rafl-track` when it is killed, runs twice at once, or reads damaged files: no incomplete file, no traceback."""

import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
import yaml
from started import Started
from support import draw_frame, error_lines
from typer.testing import CliRunner

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig, write_calibration
from rafl.tracking.cli import track_app

SIZE = (200, 160)


def write_recording(path: Path, frames: int, start: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=100)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for frame in range(frames):
            dots = [(40.0 + 30 * i + start + frame, 40.0 + 35 * j, 6.0, 6.0, 0.0) for i in range(4) for j in range(3)]
            image = av.VideoFrame.from_ndarray(draw_frame(dots, SIZE, noise=1.0, seed=frame), format="gray")
            output.mux(stream.encode(image.reformat(format="yuv420p")))
        output.mux(stream.encode())


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Folder with three recordings, a calibration and a specimen."""
    for number in range(3):
        write_recording(tmp_path / f"videos/take{number}.mp4", 12, 3.0 * number)
    camera = OrthographicCamera(
        image_size=SIZE, scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0), plane=Plane((0.0, 0.0, 1.0), 0.0, 5e-4)
    )
    write_calibration(tmp_path / "calib.yaml", Rig({"front": camera}))
    markers = [{"name": f"m{i}{j}", "at_mm": [4.0 + 3 * i, 4.0 + 3.5 * j, 0.0]} for i in range(4) for j in range(3)]
    specimen = {"format": "rafl-specimen/1", "markers": markers}
    (tmp_path / "specimen.yaml").write_text(yaml.safe_dump(specimen))
    return tmp_path


def command(lab: Path, out: str = "tracks") -> list[str]:
    return [str(lab / "videos"), "--calib", str(lab / "calib.yaml"), "--out", str(lab / out), "--jobs", "2"]


def start(lab: Path, out: str = "tracks") -> Started:
    return Started(lab, "rafl-track", *command(lab, out))


def track(lab: Path, out: str) -> None:
    """Run `rafl-track` in its own process: kernels compiled in this process round differently from cached kernels."""
    result = start(lab, out).result()
    assert result.returncode == 0, result.stderr


def tracks_content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix == ".h5"}


def test_killed_run_is_completed_by_the_next(lab: Path) -> None:
    """After kills at several moments, the next run gives the same tracks as an undisturbed run."""
    track(lab, "first")  # compiles the kernels
    began = time.monotonic()
    track(lab, "undisturbed")
    took = time.monotonic() - began
    for share in (0.5, 0.7, 0.8, 0.9):
        process = start(lab)
        time.sleep(share * took)
        process.kill()
    track(lab, "tracks")
    assert tracks_content(lab / "tracks") == tracks_content(lab / "undisturbed")
    assert {path.name for path in (lab / "tracks").iterdir()} == {"report.html", *tracks_content(lab / "undisturbed")}


def test_two_runs_at_once_write_the_same_tracks(lab: Path) -> None:
    results = [process.result() for process in [start(lab), start(lab)]]
    assert [(result.returncode, error_lines(result.stderr)) for result in results] == [(0, []), (0, [])]
    track(lab, "undisturbed")
    assert tracks_content(lab / "tracks") == tracks_content(lab / "undisturbed")
    assert not [path for path in (lab / "tracks").iterdir() if path.name.startswith(".")]


def test_interruption_cancels_running_and_waiting_recordings(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[float] = []

    def endless(_videos: object, _rig: object, _settings: object, tick: Callable[[], None]) -> None:
        started.append(time.monotonic())
        if len(started) == 2:
            signal.pthread_kill(threading.get_ident(), signal.SIGINT)  # does not wake a thread that waits
        while time.monotonic() < started[0] + 60.0:
            tick()
            time.sleep(0.01)

    monkeypatch.setattr("rafl.tracking.commands.track_recording", endless)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores SIGINT
    try:
        result = CliRunner().invoke(track_app, command(lab))
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() < started[0] + 30.0
    assert (result.exit_code, len(started)) == (130, 2)
    assert not (lab / "tracks").exists()


@pytest.mark.parametrize("name", ["calib.yaml", "specimen.yaml", "videos/take1.mp4"])
def test_mutated_file_gives_tracks_or_an_error(lab: Path, name: str, random: np.random.Generator) -> None:
    """Changed, truncated, repeated or removed bytes give tracks or an error message, never a traceback."""
    path = lab / name
    original = path.read_bytes()
    for name in ("take0", "take2"):
        (lab / f"videos/{name}.mp4").unlink()
    refused = 0
    for number in range(70):
        mutated = bytearray(original)
        kind = number % 4
        position = int(random.integers(0, len(original)))
        if kind == 0:
            for index in random.integers(0, len(original), int(random.integers(1, 12))):
                mutated[int(index)] = int(random.integers(0, 256))
        elif kind == 1:
            mutated = mutated[:position]
        elif kind == 2:
            mutated[position:position] = original[position : position + int(random.integers(1, 200))]
        else:
            del mutated[position : position + int(random.integers(1, 60))]
        path.write_bytes(mutated)
        out = f"out{number}"
        result = CliRunner().invoke(track_app, [*command(lab, out), "--specimen", str(lab / "specimen.yaml")])
        assert result.exception is None or isinstance(result.exception, SystemExit), "".join(
            traceback.format_exception(result.exception)
        )
        assert result.exit_code in (0, 2)
        folder = lab / out
        written = {item.name for item in folder.iterdir()} if folder.exists() else set()
        if result.exit_code:
            refused += 1
            assert "error: " in result.output
            assert not written
        else:
            assert written == {"take1.h5", "report.html"}
    assert refused > 10
    path.write_bytes(original)


def test_temporary_files_of_killed_runs_are_deleted(lab: Path) -> None:
    out = lab / "tracks"
    out.mkdir()
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    stale = out / f".take0-{os.uname().nodename}-{process.pid}-abcdefgh.h5"
    running = out / f".take0-{os.uname().nodename}-{os.getpid()}-abcdefgh.h5"
    stale.write_bytes(b"incomplete")
    running.write_bytes(b"incomplete")
    assert CliRunner().invoke(track_app, command(lab)).exit_code == 0
    assert not stale.exists()
    assert running.exists()
