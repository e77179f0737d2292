"""A unit: one command with results of its own, which any machine can run."""

import os
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

from rafl.common.errors import InputError
from rafl.common.names import Name, check_distinct, require_names
from rafl.common.yaml_files import StrictModel


class Unit(StrictModel):
    """One command whose results do not depend on any command that runs at the same time.

    Attributes:
        name: names its files; no two units of a list share it.
        command: program and arguments, as they are typed. No shell reads them.
        outputs: files that exist when the command has succeeded.
        inputs: files and folders that it reads. The unit waits for the units whose outputs they are, and is run again
            when one of them has changed.
    """

    name: Name
    command: tuple[str, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The command as a line for a POSIX shell."""
        return shlex.join(self.command)

    def fingerprint(self, base: Path) -> dict[str, tuple[int, int]]:
        """Size [bytes] and time of change [ns] of the inputs that exist; relative paths count from `base`."""
        found = {}
        for path in self.inputs:
            try:
                status = os.stat(base / path)
            except OSError:
                continue
            found[path] = (status.st_size, status.st_mtime_ns)
        return found


def create_unit(
    name: str, command: Sequence[str], outputs: Sequence[str | Path], inputs: Sequence[str | Path] = ()
) -> Unit:
    """A unit whose name comes from a file or from a user.

    Raises:
        InputError: the name cannot name a file.
    """
    require_names([name], "units are named after recordings, datasets and methods")
    return Unit(name=name, command=tuple(command), outputs=tuple(map(str, outputs)), inputs=tuple(map(str, inputs)))


def check_units(units: Sequence[Unit]) -> None:
    """Check that units can run beside each other.

    Raises:
        InputError: two units share a name or an output, or each waits for the other.
    """
    try:
        check_distinct(unit.name for unit in units)
    except ValueError as error:
        raise InputError(f"units: {error}; choose another name") from None
    owner: dict[str, str] = {}
    for unit in units:
        for path in map(os.path.abspath, unit.outputs):
            other = owner.setdefault(path, unit.name)
            if other != unit.name:
                raise InputError(
                    f"units {other!r:.80} and {unit.name!r:.80}: expected results of their own, found {path} for both; "
                    "rename one"
                )
    _check_order(producers(units))


def producers(units: Iterable[Unit]) -> dict[str, set[str]]:
    """For every unit, the names of the units whose outputs it reads."""
    units = list(units)
    owner = {os.path.abspath(path): unit.name for unit in units for path in unit.outputs}
    return {
        unit.name: {
            owner[path] for path in map(os.path.abspath, unit.inputs) if owner.get(path, unit.name) != unit.name
        }
        for unit in units
    }


def _check_order(waits_for: dict[str, set[str]]) -> None:
    """Raise InputError if some units wait for each other in a circle."""
    left = dict(waits_for)
    while left:
        free = [name for name, others in left.items() if not others & left.keys()]
        if not free:
            raise InputError(
                f"units {', '.join(sorted(left))[:120]}: expected an order, found that each reads another's"
            )
        for name in free:
            del left[name]
