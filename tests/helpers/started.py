"""Console scripts in processes of their own, started at once: each is a fork of a process that has the imports."""

import multiprocessing
import subprocess
import tempfile
from contextlib import ExitStack
from multiprocessing.reduction import DupFd
from pathlib import Path

from support import run_console_script

LONGEST = 600  # [s] that a command may take

# The server process imports the modules once. Every command is a fork of it.
COMMANDS = multiprocessing.get_context("forkserver")
COMMANDS.set_forkserver_preload(["support", "rafl.capture.commands", "rafl.commands", "rafl.tracking.commands"])


class Started:
    """A console script that runs.

    Args:
        folder: to run in.
        line: name of the script and its arguments.
    """

    def __init__(self, folder: Path, *line: object) -> None:
        self.line = [*map(str, line)]
        with ExitStack() as stack:
            self._out, self._err = (stack.enter_context(tempfile.TemporaryFile("w+")) for _ in range(2))
            self._files = stack.pop_all()  # closed with the result
        handles = DupFd(self._out.fileno()), DupFd(self._err.fileno())
        self._process = COMMANDS.Process(target=run_console_script, args=(self.line, folder, *handles))
        self._process.start()

    def kill(self) -> None:
        """Kill it, at whatever it does."""
        self._process.kill()
        self.result()

    def result(self) -> subprocess.CompletedProcess[str]:
        """What it returned and printed, after its end.

        Raises:
            TimeoutError: it did not end.
        """
        with self._files:
            self._process.join(LONGEST)
            if self._process.exitcode is None:
                self._process.kill()
                raise TimeoutError(f"{self.line} did not end")
            self._out.seek(0)
            self._err.seek(0)
            return subprocess.CompletedProcess(self.line, self._process.exitcode, self._out.read(), self._err.read())
