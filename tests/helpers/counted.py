"""Units of a small program that writes down every time it runs."""

from collections.abc import Callable
from pathlib import Path

from rafl.batch.unit import Unit

# Appends a line to a file, does what the second argument says, and writes the output.
PROGRAM = """
import os, signal, sys, time
from pathlib import Path
folder, name, action = sys.argv[1:]
with open(os.path.join(folder, "runs.txt"), "a") as runs:
    runs.write(name + "\\n")
exec(action)
Path(folder, name + ".out").write_text(name)
"""

Make = Callable[..., Unit]


def runs(folder: Path) -> list[str]:
    """Names of the units whose commands ran, in order, as often as they ran."""
    path = folder / "runs.txt"
    return path.read_text().splitlines() if path.exists() else []
