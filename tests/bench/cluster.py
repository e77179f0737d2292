"""Sixty small recordings tracked by --on local and by real SLURM: throughput, disturbances, and the same bytes.

    python tests/bench/cluster.py [--recordings 60] [--rounds 6] [--no-slurm] [--out build/cluster]

On SLURM (Debian: slurm-wlm and munge; root), two nodes of one processor each track them while a command and a job are
killed, a job is put back into the queue, a node is drained, a node's daemon is killed, and the program itself is killed
and started again.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from slurm import loopback_slurm, missing

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from support import draw_frame, write_video

from rafl.calibration.camera import OrthographicCamera, Plane
from rafl.calibration.rig import Rig, write_calibration

SIZE, FRAMES = (200, 160), 24
PROGRAM = Path(sys.executable).parent / "rafl-track"
CLUSTER = "format: rafl-cluster/1\nmemory_gb: 1\nminutes: 30\nat_once: 8\n"


def make_recordings(folder: Path, count: int) -> None:
    """Videos of twelve dots that swing, each with its own amplitude and noise, and their calibration."""
    (folder / "videos").mkdir(parents=True)
    for number in range(count):
        random = np.random.default_rng(number)
        shift = random.uniform(2.0, 5.0) * np.sin(2.0 * np.pi * np.arange(FRAMES) / 12.0)
        frames = [
            draw_frame(
                [(40.0 + 30 * i + shift[k], 40.0 + 35 * j, 6.0, 6.0, 0.0) for i in range(4) for j in range(3)],
                SIZE,
                noise=1.0,
                seed=1000 * number + k,
            )
            for k in range(FRAMES)
        ]
        write_video(folder / "videos" / f"take {number:02d}.mp4", "libx264", "yuv420p", frames=frames)
    plane = Plane((0.0, 0.0, 1.0), 0.0, 5e-4)
    camera = OrthographicCamera(image_size=SIZE, scale=(1e4, 1e4), rotation_vector=(0.0, 0.0, 0.0), plane=plane)
    write_calibration(folder / "calib.yaml", Rig({"front": camera}))
    (folder / "cluster.yaml").write_text(CLUSTER)


def line(out: str, *more: str) -> list[str]:
    """The command that tracks the recordings."""
    return [str(PROGRAM), "videos", "--calib", "calib.yaml", "--out", out, "--export", "csv", *more]


def throughput(folder: Path, count: int, rounds: int) -> None:
    """Time the recordings with one and with two jobs, in turns, because other programs use the machine too."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for number in range(rounds):
        chosen = [f"--recording=take {k:02d}" for k in range(number, count, rounds)]
        for jobs in (1, 2) if number % 2 else (2, 1):
            begin = time.monotonic()
            command = line(f"jobs{jobs}", "--on", "local", "--jobs", str(jobs), *chosen)
            subprocess.run(command, cwd=folder, check=True, capture_output=True)
            seconds[jobs].append(time.monotonic() - begin)
    one, two = (np.array(seconds[jobs]) for jobs in (1, 2))
    print(f"{count} recordings: jobs 1 {one.sum():.0f} s, jobs 2 {two.sum():.0f} s, ratio {one.sum() / two.sum():.2f}")
    print(f"ratio of each round: {', '.join(f'{ratio:.2f}' for ratio in one / two)}; load {os.getloadavg()[1]:.1f}")
    units = [json.loads(path.read_text()) for path in (folder / "jobs1" / "units").glob("take*.json")]
    print(f"a unit takes {np.median([unit['seconds'] for unit in units]):.1f} s (median)")


def jobs(folder: Path, status: str) -> list[tuple[str, str]]:
    """Names and jobs of the units of a status."""
    read = [(path.stem, json.loads(path.read_text())) for path in (folder / "units").glob("take*.json")]
    return [(name, unit["job"]) for name, unit in read if unit["status"] == status]


def control(*words: str) -> None:
    """A command of SLURM."""
    subprocess.run(words, check=True, capture_output=True)


def kill_command(name: str) -> bool:
    """Kill the command of a unit, and only that; returns whether it was found."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if name.encode() in words and any(word.endswith(b"rafl-track") for word in words):
            os.kill(int(path.parent.name), signal.SIGKILL)
            return True
    return False


def on_slurm(folder: Path, count: int, work: Path) -> None:
    """Track the recordings on SLURM, with disturbances, and compare the files with those of the local run."""
    out, disturbed = folder / "slurm", dict[str, str]()
    command = line("slurm", "--on", "slurm", "--cluster", "cluster.yaml")
    with loopback_slurm(work) as nodes:
        begin = time.monotonic()

        def start() -> subprocess.Popen[bytes]:
            return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        program = start()
        steps = ["command", "job", "requeue", "drain", "resume", "program", "daemon"]
        after = dict(zip(steps, np.linspace(0.06, 0.6, len(steps)) * count, strict=True))
        while program.poll() is None:
            time.sleep(0.2)
            if not steps or len(jobs(out, "done")) < after[steps[0]]:
                continue
            step, running = steps[0], jobs(out, "running")
            if step in ("command", "job", "requeue") and not running:
                continue
            if step == "command":
                if not kill_command(running[0][0]):
                    continue
            elif step == "job":
                control("scancel", "--signal=KILL", "--full", running[0][1])
            elif step == "requeue":
                control("scontrol", "requeue", running[0][1])
            elif step == "drain":
                control("scontrol", "update", "nodename=node2", "state=drain", "reason=test")
            elif step == "resume":
                control("scontrol", "update", "nodename=node2", "state=resume")
            elif step == "program":
                program.kill()
                program.wait()
                program = start()
            else:
                nodes["node2"].kill()
            if step in ("command", "job", "requeue"):
                disturbed[running[0][0]] = step
            print(f"{time.monotonic() - begin:4.0f} s, {len(jobs(out, 'done'))} done: {step}", flush=True)
            steps.pop(0)
        seconds = time.monotonic() - begin
    assert program.returncode == 0, program.returncode
    assert not steps, steps
    print(f"SLURM: {count} recordings in {seconds:.0f} s, {len(disturbed)} disturbed: {disturbed}")
    again = 0
    for path in sorted((out / "units").glob("take*.json")):
        attempts = json.loads(path.read_text())["attempts"]
        log = path.with_suffix(".log").read_text()
        assert log.count("wrote 1 tracks files") == 1, path.stem
        again += attempts > 1
        assert attempts == 1 or path.stem in disturbed, (path.stem, attempts)
    print(f"all done, {again} started again, none finished twice")
    for path in sorted((folder / "jobs1").glob("take*")):
        assert path.read_bytes() == (out / path.name).read_bytes(), path.name
    print("tracks and tables are the bytes of the local run")


def main() -> None:
    """Make the recordings, time them on this machine, and run them on SLURM."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--recordings", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--no-slurm", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("build/cluster"))
    arguments = parser.parse_args()
    folder = arguments.out.absolute()
    shutil.rmtree(folder, ignore_errors=True)
    make_recordings(folder, arguments.recordings)
    throughput(folder, arguments.recordings, arguments.rounds)
    if arguments.no_slurm:
        return
    if missing() or os.geteuid() != 0:
        raise SystemExit(f"SLURM needs root, and the programs {', '.join(missing()) or 'that are here'}")
    on_slurm(folder, arguments.recordings, folder / "daemons")


if __name__ == "__main__":
    main()
