"""The project's commands as a lab types them."""

import os
import subprocess
import sys
from pathlib import Path


def command(name: str, *arguments: object) -> None:
    """Run one of this environment's commands; its failure ends the program."""
    line = [str(Path(sys.executable).parent / name), *map(str, arguments)]
    subprocess.run(line, check=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
