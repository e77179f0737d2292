"""Run the project's command-line tools."""

import os
import subprocess
import sys
from pathlib import Path


def run_command(name: str, *arguments: object) -> None:
    """Run a command of this environment with one BLAS thread.

    Raises:
        CalledProcessError: the command failed.
    """
    line = [str(Path(sys.executable).parent / name), *map(str, arguments)]
    subprocess.run(line, check=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
