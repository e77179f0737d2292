"""The commands `rafl-fit` and `rafl-eval`: their options, and the checks that need no heavy import."""

import os
from pathlib import Path
from typing import Annotated

import typer

from rafl.batch.options import Batch, ClusterOption, JobsOption, OnOption, PrintOption, StatusOption, Where
from rafl.common.command_line import SharedCommand, create_app, report_errors
from rafl.common.errors import InputError
from rafl.common.files import require_file
from rafl.simulation.device import CPU, check_device_name

METHODS = ("auto", "rafl", "srl", "sysid", "sysid-e", "sysid-damping", "sysid-loss", "sysid-branches", "constitutive")
OBJECTIVES = ("image", "3d")
INTEGRATORS = ("implicit-euler", "generalised-alpha")
DEVICES = "Where to simulate: cpu, or cuda for a graphics card (cuda:1 for the second)."
DATASET = "a dataset (.h5, written by rafl-capture)"

fit_app = create_app("Fit a model to recordings.")
eval_app = create_app("Evaluate fitted models on recordings.")


@fit_app.command(cls=SharedCommand)
@report_errors
def fit(
    datasets: Annotated[list[Path], typer.Argument(help="Dataset files (.h5) to train on.", metavar="DATASET...")],
    method: Annotated[
        str,
        typer.Option(
            help="auto: the simplest of several models that predicts left-out recordings as well as any; "
            "constitutive: material with a learned strain energy and viscosity; rafl: residual acceleration field; "
            "srl: supervised baseline; sysid: E and nu, sysid-e: E at nu = 0.499, sysid-damping: E, nu and viscosity, "
            "sysid-loss: E, nu and loss factor, sysid-branches: E, nu and Maxwell branches."
        ),
    ] = "auto",
    out: Annotated[Path | None, typer.Option(help="Run folder [runs/DATASET-METHOD].")] = None,
    epochs: Annotated[
        int | None,
        typer.Option(min=1, help="Maximum number of passes over the recordings (iterations of sysid) [by method]."),
    ] = None,
    learning_rate: Annotated[float, typer.Option(min=1e-8, help="Initial learning rate of Adam (rafl).")] = 1e-3,
    weight_decay: Annotated[float, typer.Option(min=0.0, help="Weight decay of Adam (rafl, srl).")] = 1e-5,
    patience: Annotated[
        int, typer.Option(min=1, help="Epochs without a better validation error before training stops (rafl).")
    ] = 20,
    frames: Annotated[
        int, typer.Option(min=0, help="Number of leading frames that training simulates (0: all frames).")
    ] = 0,
    seed: Annotated[int, typer.Option(help="Random seed of weights and recording order (rafl, srl).")] = 0,
    batch: Annotated[
        int, typer.Option(min=1, help="Recordings per update (rafl), which the processes of torchrun share.")
    ] = 1,
    force_penalty: Annotated[
        float, typer.Option(min=0.0, help="Penalty on squared residual forces [m2/N2] (rafl).")
    ] = 1e-8,
    warm_start: Annotated[
        int, typer.Option(min=0, help="Passes of pre-training on residual targets before the first simulation (rafl).")
    ] = 20,
    start: Annotated[
        Path | None,
        typer.Option("--from", help="Run to fine-tune, or sysid run whose material the field corrects (rafl)."),
    ] = None,
    integrator: Annotated[
        str,
        typer.Option(
            help="Time integration: implicit-euler, whose numerical damping the field learns to undo, or "
            "generalised-alpha, which hardly damps [as the datasets say]."
        ),
    ] = "",
    by_sigma: Annotated[
        bool, typer.Option("--by-sigma", help="Weight markers by their uncertainty (rafl, sysid).")
    ] = False,
    objective: Annotated[
        str,
        typer.Option(
            help="Compare the pixels that the cameras measured (image) or 3-D positions (3d) [image where a dataset "
            "has pixels]."
        ),
    ] = "",
    limit_energy: Annotated[
        bool, typer.Option(help="Limit the energy that the field adds to a motion by that in training (rafl).")
    ] = True,
    device: Annotated[str, typer.Option(help=DEVICES)] = CPU,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Also write the history for TensorBoard into the run folder.")
    ] = False,
    resume: Annotated[bool, typer.Option(help="Continue an interrupted run, or start it if there is none.")] = False,
    each: Annotated[
        bool, typer.Option("--each", help="Fit each dataset by itself, into runs in the folder --out [runs].")
    ] = False,
    on: OnOption = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    print_commands: PrintOption = False,
    status: StatusOption = False,
) -> None:
    """Train on the `train` recordings, validate on the `val` recordings and keep the best model.

    Example: rafl-fit datasets/thick.h5 --out runs/thick

    Example of several fits at the same time: rafl-fit datasets/*.h5 --each --jobs 2

    Example of one fit by several processes: torchrun --standalone --nproc-per-node 2 --no-python rafl-fit FILE.h5
    """
    given = dict(locals())
    if method not in METHODS:
        raise InputError(f"--method: expected {', '.join(METHODS)}, found {method!r}")
    if integrator and integrator not in INTEGRATORS:
        raise InputError(f"--integrator: expected {' or '.join(INTEGRATORS)}, found {integrator!r}")
    if objective and objective not in OBJECTIVES:
        raise InputError(f"--objective: expected {' or '.join(OBJECTIVES)}, found {objective!r}")
    check_device_name(device, "--device")
    if frames == 1:
        raise InputError("--frames: expected 0 (all) or at least 2, found 1")
    for path in datasets:
        require_file(path, DATASET)
    how = Batch.of(Where.local if each and on is None else on, jobs, cluster, print_commands, status)
    if how.apart:
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise InputError(
                "torchrun: expected one fit, found --each, --on or --status, which are for many; leave one of them out"
            )
        from rafl import unit_commands

        unit_commands.fit(given, how)
        return
    from rafl import commands

    options = {
        "epochs": epochs,
        "learning_rate": learning_rate,
        "weight_decay": weight_decay,
        "patience": patience,
        "frames": frames,
        "seed": seed,
        "batch": batch,
        "force_penalty": force_penalty,
        "warm_start": warm_start,
        "start": start,
        "integrator": integrator,
        "by_sigma": by_sigma,
        "objective": objective,
        "limit_energy": limit_energy,
        "device": device,
    }
    commands.fit(datasets, out, method, tensorboard, resume, options)


@eval_app.command()
@report_errors
def evaluate(
    paths: Annotated[
        list[Path], typer.Argument(help="Run folders and dataset files (.h5).", metavar="RUN... DATASET...")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for errors.csv and report.html [the first run].")] = None,
    report: Annotated[bool, typer.Option(help="Write evaluation.h5 and report.html.")] = True,
    device: Annotated[str, typer.Option(help=DEVICES)] = CPU,
    on: OnOption = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    print_commands: PrintOption = False,
    status: StatusOption = False,
) -> None:
    """Compare the baseline simulator and fitted models with the recordings.

    With --on, each dataset is a unit, with tables in OUT/DATASET. OUT/errors.csv and OUT/motions.csv join them.

    Example: rafl-eval runs/thick datasets/thick.h5 datasets/thin.h5
    """
    given = dict(locals())
    runs = [path for path in paths if path.suffix != ".h5"]
    files = [path for path in paths if path.suffix == ".h5"]
    if not runs or not files:
        absent = "run folder" if files else "dataset (.h5)"
        raise InputError(
            f"expected at least one run folder and one dataset (.h5), found no {absent} among "
            f"{', '.join(map(str, paths))}; for instance rafl-eval runs/thick datasets/thick.h5"
        )
    check_device_name(device, "--device")
    for run in runs:
        require_file(run / "model.pt", "a fitted model (written by rafl-fit)")
    for file in files:
        require_file(file, DATASET)
    how = Batch.of(on, jobs, cluster, print_commands, status)
    if how.apart:
        from rafl import unit_commands

        unit_commands.evaluate(given, runs, files, out or runs[0], how)
        return
    from rafl import commands

    commands.evaluate(runs, files, out or runs[0], report, device)
