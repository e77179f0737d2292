"""The command `rafl-sweep`: its options, and the checks that need no heavy import."""

from pathlib import Path
from typing import Annotated

import typer

from rafl.batch.options import Batch, ClusterOption, JobsOption, OnOption, PrintOption, StatusOption, Where
from rafl.common.command_line import create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file

sweep_app = create_app("Run many fits and evaluations.")


@sweep_app.command()
@report_errors
def sweep(
    plan: Annotated[
        Path,
        typer.Argument(help="Plan of the sweep (plan.yaml). With --status also a folder of units.", metavar="PLAN"),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for runs and tables [the plan's name without .yaml].")
    ] = None,
    on: OnOption = Where.local,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    print_commands: PrintOption = False,
    status: StatusOption = False,
) -> None:
    """Fit the models of a plan, evaluate them, and gather their errors into one table.

    Every fit and every evaluation is a unit, run once. The same command goes on after an interruption, and runs again
    what failed.

    Example: rafl-sweep plan.yaml --jobs 2

    Example on a cluster: rafl-sweep plan.yaml --on slurm --cluster cluster.yaml
    """
    batch = Batch.of(on, jobs, cluster, print_commands, status)
    if status and plan.is_dir():
        from rafl.sweep import commands

        commands.show_folder(plan)
        return
    require_file(plan, "a plan of a sweep (plan.yaml)")
    if plan.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"expected a plan that ends with .yaml, found {plan}")
    from rafl.sweep import commands

    commands.sweep(plan, out or Path(plan.stem), batch)
