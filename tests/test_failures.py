"""Killed programs, damaged files, two programs at once: nothing half-written, nobody harmed, no traceback."""

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
from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig, write_rig
from rafl.tracking.cli import track_app
from support import picture
from typer.testing import CliRunner

SIZE = (200, 160)


def write_recording(path: Path, frames: int, start: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=100)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for frame in range(frames):
            dots = [(40.0 + 30 * i + start + frame, 40.0 + 35 * j, 6.0, 6.0, 0.0) for i in range(4) for j in range(3)]
            image = av.VideoFrame.from_ndarray(picture(dots, SIZE, noise=1.0, seed=frame), format="gray")
            output.mux(stream.encode(image.reformat(format="yuv420p")))
        output.mux(stream.encode())


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Three recordings, a calibration and a specimen."""
    for number in range(3):
        write_recording(tmp_path / f"videos/take{number}.mp4", 12, 3.0 * number)
    camera = OrthographicCamera(
        image_size=SIZE, scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0), plane=Plane((0.0, 0.0, 1.0), 0.0, 5e-4)
    )
    write_rig(tmp_path / "calib.yaml", Rig({"front": camera}))
    markers = [{"name": f"m{i}{j}", "at_mm": [4.0 + 3 * i, 4.0 + 3.5 * j, 0.0]} for i in range(4) for j in range(3)]
    specimen = {"format": "rafl-specimen/1", "markers": markers}
    (tmp_path / "specimen.yaml").write_text(yaml.safe_dump(specimen))
    return tmp_path


def command(lab: Path, out: str = "tracks") -> list[str]:
    return [str(lab / "videos"), "--calib", str(lab / "calib.yaml"), "--out", str(lab / out), "--jobs", "2"]


def track(lab: Path, out: str) -> None:
    """In a program of its own: kernels that are compiled here and those that are loaded round differently."""
    program = Path(sys.executable).parent / "rafl-track"
    subprocess.run([program, *command(lab, out)], check=True, capture_output=True)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix == ".h5"}


def test_killed_and_started_again(lab: Path) -> None:
    """Killed at several moments; what is left is whole, and the end is what it would have been."""
    track(lab, "first")  # compiles
    program = [str(Path(sys.executable).parent / "rafl-track"), *command(lab)]
    for wait in (1.5, 2.2, 2.6, 3.0):
        process = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(wait)
        process.send_signal(signal.SIGKILL)
        process.wait()
    track(lab, "tracks")
    track(lab, "afresh")
    assert content(lab / "tracks") == content(lab / "afresh")
    assert {path.name for path in (lab / "tracks").iterdir()} == {"report.html", *content(lab / "afresh")}


def test_two_at_once(lab: Path) -> None:
    program = [str(Path(sys.executable).parent / "rafl-track"), *command(lab)]
    both = [subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) for _ in range(2)]
    assert [(process.wait(), process.stderr.read().strip()) for process in both if process.stderr] == [(0, b"")] * 2
    track(lab, "afresh")
    assert content(lab / "tracks") == content(lab / "afresh")
    assert not [path for path in (lab / "tracks").iterdir() if path.name.startswith(".")]


def test_who_is_stopped_gives_up_what_runs_and_what_waits(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[float] = []

    def endless(_videos: object, _rig: object, _settings: object, tick: Callable[[], None]) -> None:
        begun.append(time.monotonic())
        if len(begun) == 2:
            signal.pthread_kill(threading.get_ident(), signal.SIGINT)  # who waits is not woken by it
        while time.monotonic() < begun[0] + 60.0:
            tick()
            time.sleep(0.01)

    monkeypatch.setattr("rafl.tracking.commands.track_recording", endless)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # who runs in a shell's background ignores it
    try:
        result = CliRunner().invoke(track_app, command(lab))
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() < begun[0] + 30.0
    assert (result.exit_code, len(begun)) == (130, 2)
    assert not (lab / "tracks").exists()


@pytest.mark.parametrize("name", ["calib.yaml", "specimen.yaml", "videos/take1.mp4"])
def test_mutated_files(lab: Path, name: str, random: np.random.Generator) -> None:
    """Bytes changed, cut, doubled or lost: tracks or one line that says what is wrong, never a traceback."""
    path = lab / name
    whole = path.read_bytes()
    for name in ("take0", "take2"):
        (lab / f"videos/{name}.mp4").unlink()
    refused = 0
    for number in range(70):
        mutated = bytearray(whole)
        kind = number % 4
        place = int(random.integers(0, len(whole)))
        if kind == 0:
            for spot in random.integers(0, len(whole), int(random.integers(1, 12))):
                mutated[int(spot)] = int(random.integers(0, 256))
        elif kind == 1:
            mutated = mutated[:place]
        elif kind == 2:
            mutated[place:place] = whole[place : place + int(random.integers(1, 200))]
        else:
            del mutated[place : place + int(random.integers(1, 60))]
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
    path.write_bytes(whole)


def test_temporary_files_of_killed_programs_go(lab: Path) -> None:
    out = lab / "tracks"
    out.mkdir()
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    dead = out / f".take0-{os.uname().nodename}-{process.pid}-abcdefgh.h5"
    living = out / f".take0-{os.uname().nodename}-{os.getpid()}-abcdefgh.h5"
    dead.write_bytes(b"half")
    living.write_bytes(b"half")
    assert CliRunner().invoke(track_app, command(lab)).exit_code == 0
    assert not dead.exists()
    assert living.exists()
