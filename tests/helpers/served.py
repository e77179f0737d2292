"""A running `rafl-review`."""

import signal
import subprocess
from dataclasses import dataclass


@dataclass
class Served:
    """A running `rafl-review`.

    Attributes:
        process: of the command.
        address: that it printed.
    """

    process: subprocess.Popen[str]
    address: str

    def kill(self) -> None:
        """End it without a warning."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> int:
        """End it as Ctrl-C does; returns the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20)
