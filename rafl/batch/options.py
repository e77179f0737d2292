"""The options by which a command runs its units apart."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rafl.common.errors import InputError
from rafl.common.files import require_file


class Where(StrEnum):
    """Where units run."""

    local = "local"
    slurm = "slurm"


OnOption = Annotated[
    Where | None,
    typer.Option("--on", help="Run the units apart, each once and resumed: in processes of this machine, or by SLURM."),
]
ClusterOption = Annotated[
    Path | None, typer.Option("--cluster", help="With --on slurm: partition, time and memory (cluster.yaml).")
]
JobsOption = Annotated[int | None, typer.Option("--jobs", min=1, help="With --on local: units at the same time [1].")]
PrintOption = Annotated[
    bool, typer.Option("--print-commands", help="Only print the command of every unit, for other programs to run.")
]
StatusOption = Annotated[
    bool, typer.Option("--status", help="Only print which units are done, running or failed, and why.")
]
OWN = ("on", "jobs", "cluster", "print_commands", "status")  # parameters of a command that its units do not get


@dataclass(frozen=True)
class Batch:
    """How a command runs its units.

    Attributes:
        on: where; None if nothing is run, or all of it in this process.
        jobs: units at the same time on this machine.
        cluster: file with the settings of the cluster.
        print_commands: whether only their commands are printed.
        status: whether only their status is printed.
    """

    on: Where | None
    jobs: int
    cluster: Path | None
    print_commands: bool
    status: bool

    @staticmethod
    def of(on: Where | None, jobs: int | None, cluster: Path | None, print_commands: bool, status: bool) -> "Batch":
        """The options of a command, checked.

        Raises:
            InputError: options that contradict each other, or no file of settings.
        """
        if print_commands and status:
            raise InputError("expected --print-commands or --status, found both; leave one out")
        if cluster is not None:
            if on != Where.slurm:
                raise InputError("expected --cluster with --on slurm only; leave it out")
            require_file(cluster, "the settings of a cluster (cluster.yaml)")
        if jobs is not None and on == Where.slurm:
            raise InputError("--jobs: expected --on local; set `at_once` in cluster.yaml instead")
        return Batch(on, jobs or 1, cluster, print_commands, status)

    @property
    def apart(self) -> bool:
        """Whether the command deals with units instead of doing all in this process."""
        return self.on is not None or self.print_commands or self.status
