"""Commands in several processes that form a group, as under torchrun but started faster.

As torchrun does, the others are terminated when one fails.
"""

import multiprocessing
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import Any

from support import run_console_script

LONGEST = 120  # [s] that a group may take
INTERRUPTED = 130  # exit code after Ctrl-C, which all processes get


def run_member(environment: dict[str, str], line: list[str], folder: Path, out: Any, err: Any) -> None:
    """Run a console script with more environment variables; the other arguments as in `run_console_script`."""
    os.environ.update(environment)
    run_console_script(line, folder, out, err)


def run_together(
    count: int,
    folder: Path,
    *line: object,
    during: Callable[[list[BaseProcess]], None] = lambda processes: None,
) -> list[subprocess.CompletedProcess[str]]:
    """What each of the processes returned and printed, by its number.

    Args:
        count: number of processes.
        folder: to run in.
        line: name of the console script and its arguments.
        during: called with the processes after their start.

    Raises:
        TimeoutError: a process did not end.
    """
    words = [*map(str, line)]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(count)}
    context = multiprocessing.get_context("forkserver")
    with ExitStack() as stack:
        files = [[stack.enter_context(tempfile.TemporaryFile("w+")) for _ in range(2)] for _ in range(count)]
        processes: list[BaseProcess] = []
        for rank, own in enumerate(files):
            environment = shared | {"RANK": str(rank), "LOCAL_RANK": str(rank), "LOCAL_WORLD_SIZE": str(count)}
            handles = [DupFd(file.fileno()) for file in own]
            processes.append(context.Process(target=run_member, args=(environment, words, folder, *handles)))
            processes[-1].start()
        try:
            during(processes)
            limit = time.monotonic() + LONGEST
            while any(process.is_alive() for process in processes):
                wait([process.sentinel for process in processes if process.is_alive()], 1.0)
                if any(process.exitcode not in (None, 0, INTERRUPTED) for process in processes):
                    for process in processes:
                        process.terminate()
                if time.monotonic() > limit:
                    raise TimeoutError(f"{words} did not end")
        finally:
            for process in processes:
                process.kill()
        results = []
        for process, own in zip(processes, files, strict=True):
            for file in own:
                file.seek(0)
            assert process.exitcode is not None
            results.append(subprocess.CompletedProcess(words, process.exitcode, *(file.read() for file in own)))
    return results
