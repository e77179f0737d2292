"""The commands `rafl-fit` and `rafl-eval`."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import torch
import typer
from rich.console import Console
from rich.table import Table

from rafl.common.command_line import command_line, progress, user_command
from rafl.common.errors import InputError, SimulationError
from rafl.common.files import write_text
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_dataset
from rafl.evaluation.metrics import (
    Comparison,
    Transfer,
    compare_those_that_simulate,
    error_table,
    held_out_errors,
    latex_table,
    motion_table,
    split_table,
)
from rafl.evaluation.report import write_report
from rafl.fitting.distributed import process_count, rank
from rafl.fitting.methods import EPOCHS, METHODS, check_inputs
from rafl.fitting.run_folder import FittedModel, Settings, load_model, read_settings, write_settings
from rafl.fitting.sysid import spoken
from rafl.fitting.train_field import nothing_to_follow
from rafl.fitting.warm_start import LARGEST

# The network is small; the other core serves the element kernels.
TORCH_THREADS = 1

fit_app = command_line("Fit a model to recordings.")
eval_app = command_line("Measure a fitted model.")


def _simulating(error: SimulationError) -> typer.Exit:
    typer.echo(f"error: {error}", err=True)
    return typer.Exit(1)


@fit_app.command()
@user_command
def fit(
    datasets: Annotated[list[Path], typer.Argument(help="Dataset files (.h5) to train on.", metavar="DATASET...")],
    method: Annotated[
        str,
        typer.Option(
            help="rafl: residual field; srl: supervised baseline; sysid: E and nu, sysid-e: E at nu = 0.499, "
            "sysid-damping: E, nu and viscosity."
        ),
    ] = "rafl",
    out: Annotated[Path | None, typer.Option(help="Run folder [runs/DATASET-METHOD].")] = None,
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Passes over the recordings (iterations of sysid), at most [by method].")
    ] = None,
    learning_rate: Annotated[float, typer.Option(min=1e-8, help="Adam's, at the start (rafl).")] = 1e-3,
    weight_decay: Annotated[float, typer.Option(min=0.0, help="Adam's (rafl, srl).")] = 1e-5,
    patience: Annotated[int, typer.Option(min=1, help="Epochs without gain before stopping (rafl).")] = 20,
    frames: Annotated[int, typer.Option(min=0, help="Leading frames to simulate in training (0: all).")] = 0,
    seed: Annotated[int, typer.Option(help="Of weights and order (rafl, srl).")] = 0,
    batch: Annotated[int, typer.Option(min=1, help="Recordings an update (rafl); torchrun shares them out.")] = 1,
    force_penalty: Annotated[float, typer.Option(min=0.0, help="On squared residual forces [m2/N2] (rafl).")] = 1e-8,
    warm_start: Annotated[
        int, typer.Option(min=0, help="Passes over the forces that follow the recordings step by step, first (rafl).")
    ] = 20,
    start: Annotated[
        Path | None, typer.Option("--from", help="Run to fine-tune, or a sysid run whose material to correct (rafl).")
    ] = None,
    integrator: Annotated[
        str,
        typer.Option(
            help="By which the simulator steps: implicit-euler, whose damping the field learns to make up for, or "
            "generalised-alpha, which hardly damps [the datasets' own]."
        ),
    ] = "",
    by_sigma: Annotated[
        bool, typer.Option("--by-sigma", help="Weigh markers by their uncertainty (rafl, sysid).")
    ] = False,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Write the history for TensorBoard too, into the run folder.")
    ] = False,
    resume: Annotated[bool, typer.Option(help="Go on with a run that was interrupted.")] = False,
) -> None:
    """Train on the `train` recordings, watch the `val` ones, keep the best.

    Example: rafl-fit datasets/thick.h5 --out runs/thick
    """
    torch.set_num_threads(TORCH_THREADS)
    if frames == 1:
        raise InputError("--frames: expected 0 (all) or at least 2, found 1")
    loaded = [read_dataset(path) for path in datasets]
    run = out or Path("runs") / f"{loaded[0].name}-{method}"
    check_inputs(method, loaded, start, integrator)
    epochs = epochs or EPOCHS[method]
    settings = Settings(
        method,
        tuple(str(path.resolve()) for path in datasets),
        epochs,
        learning_rate,
        weight_decay,
        patience,
        frames,
        seed,
        batch,
        force_penalty,
        warm_start,
        str(start.resolve()) if start else "",
        by_sigma,
        integrator,
    )
    first = rank() == 0  # of the processes that torchrun started
    open_writer = _summary_writer() if tensorboard else None
    if first:
        _open_run(run, settings, resume)
        if process_count() > batch:
            typer.echo(f"{process_count()} processes share out {batch}: give --batch to use them all", err=True)
        if method == "rafl" and nothing_to_follow(loaded, settings):
            typer.echo(
                f"no warm start: it needs implicit-euler, one substep, no viscosity and at most {LARGEST} vertices",
                err=True,
            )
    writer = open_writer(run) if open_writer and first else None
    with progress() as bar:
        task = bar.add_task("epoch", total=epochs)

        def report(row: dict[str, float]) -> None:
            kind = "epoch" if "epoch" in row else "warm_start"
            bar.update(task, completed=row.get("epoch", 0))
            values = ", ".join(f"{key} {value:.5g}" for key, value in row.items() if key != kind)
            label = kind.replace("_", " ")
            if not first:
                return
            bar.console.print(f"{label} {row[kind]:3.0f}: {values}", highlight=False, soft_wrap=True)
            if writer is not None:
                for key, value in row.items():
                    writer.add_scalar(f"{kind}/{key}", value, int(row[kind]))
                writer.flush()

        try:
            model = METHODS[method](loaded, settings, run, report)
        except SimulationError as error:
            raise _simulating(error) from None
    if not first:
        return
    typer.echo(_described(model))
    if (run / "parameters.csv").exists():
        for line in spoken(pd.read_csv(run / "parameters.csv")):
            typer.echo(line)
    typer.echo(f"wrote {run}/ (model.pt, history.csv, config.yaml)")
    typer.echo(f"next: rafl-eval {run} {' '.join(str(path) for path in datasets)}")


def _summary_writer() -> Any:
    """TensorBoard's writer, where it is installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter  # only here: an optional package
    except ImportError:
        raise InputError(
            "--tensorboard: expected the package tensorboard, found none; pip install tensorboard, or do without "
            "(history.csv holds the same)"
        ) from None
    return SummaryWriter


def _open_run(run: Path, settings: Settings, resume: bool) -> None:
    """Make or reopen the run folder; never mix two runs in one."""
    if resume:
        earlier = read_settings(run)
        if earlier != settings:
            raise InputError(f"expected the settings in {run}/config.yaml to resume, found others; use the same")
        return
    if (run / "config.yaml").exists():
        raise InputError(f"{run} already holds a run; choose another --out, or go on with --resume")
    write_settings(run, settings)


def _described(model: FittedModel) -> str:
    if model.network is not None:
        return f"trained a supervised residual network for meshes of {model.network.nodes} vertices"
    parts = [] if model.field is None else ["trained a residual acceleration field"]
    if model.material is not None:
        e, nu = model.material["youngs_modulus"], model.material["poissons_ratio"]
        identified = f"identified E = {e / 1e3:.1f} kPa, nu = {nu:.4f}"
        if "viscosity" in model.material:
            identified += f", viscosity = {model.material['viscosity']:.0f} Pa s"
        parts.append(identified)
    stepping = f", stepped by {model.stepping['integrator']}" if model.stepping else ""
    return " on ".join(parts) + stepping


@eval_app.command()
@user_command
def evaluate(
    paths: Annotated[
        list[Path], typer.Argument(help="Run folders and dataset files (.h5).", metavar="RUN... DATASET...")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for errors.csv and report.html [the first run].")] = None,
) -> None:
    """Compare original and fitted simulators with the recordings.

    Example: rafl-eval runs/thick datasets/thick.h5 datasets/thin.h5
    """
    torch.set_num_threads(TORCH_THREADS)
    runs = [path for path in paths if path.suffix != ".h5"]
    files = [path for path in paths if path.suffix == ".h5"]
    if not runs or not files:
        absent = "run folder" if files else "dataset (.h5)"
        raise InputError(
            f"expected at least one run folder and one dataset (.h5), found no {absent} among "
            f"{', '.join(map(str, paths))}; for instance rafl-eval runs/thick datasets/thick.h5"
        )
    models = _named_models(runs)
    datasets = [read_dataset(path) for path in files]
    try:
        comparisons, failed = _compare_all(datasets, models)
    except SimulationError as error:
        raise _simulating(error) from None
    folder = out or runs[0]
    recordings, splits = error_table(comparisons), split_table(comparisons)
    write_text(folder / "errors.csv", recordings.to_csv(index=False, float_format="%.6f"))
    described = "; ".join(f"{name}: {_described(model)}" for name, model in models.items())
    motions = motion_table(comparisons)
    write_text(folder / "motions.csv", motions.to_csv(index=False, float_format="%.6f"))
    write_text(folder / "errors.tex", latex_table(splits))
    write_report(folder / "report.html", comparisons, splits, recordings, motions, described)
    table = Table("dataset", "split", "recordings", "method", "error [mm]")
    for row in splits.itertuples():
        value = f"{row.mean_mm:.3f} +- {row.std_mm:.3f}"
        table.add_row(str(row.dataset), str(row.split), str(row.recordings), str(row.method), value)
    Console(width=100).print(table)
    transfer = Transfer.of(splits)
    if transfer.errors.shape[1] > 1:
        write_text(folder / "transfer.csv", transfer.errors.to_csv(float_format="%.6f"))
    for name, count in transfer.negative.items():
        failing = f"; its simulation fails on {failed[name]} more" if name in failed else ""
        typer.echo(f"{name}: worse than the original simulator on {count} of {transfer.tried[name]} datasets{failing}")
    typer.echo(f"wrote {folder}/errors.csv, motions.csv, errors.tex")
    held_out = held_out_errors(comparisons)
    if held_out:
        values = ", ".join(f"{name} {1e3 * error:.3f} mm" for name, error in held_out.items())
        typer.echo(f"held-out marker error: {values}")
    else:
        typer.echo("no recording has split `test`: nothing was held out", err=True)
    typer.echo(f"report: {folder / 'report.html'} (open it in a browser)")


def _compare_all(datasets: list[Dataset], models: dict[str, FittedModel]) -> tuple[list[Comparison], Counter[str]]:
    """Every dataset with the models that simulate it; on how many datasets a model fails, which is said.

    Raises:
        SimulationError: the untouched simulator fails, or a model fails wherever it acts.
    """
    fitting = _acting(datasets, models)
    comparisons: list[Comparison] = []
    failed: Counter[str] = Counter()
    with progress() as bar:
        for k, dataset in enumerate(bar.track(datasets, description="simulating")):
            compared, failures = compare_those_that_simulate(dataset, fitting[k])
            comparisons += compared
            for name, error in failures.items():
                failed[name] += 1
                if failed[name] == sum(name in acting for acting in fitting):
                    raise SimulationError(f"{name} on {dataset.name}: {error}")
                typer.echo(f"left out on {dataset.name}: {name}: {error}", err=True)
    return comparisons, failed


def _acting(datasets: list[Dataset], models: dict[str, FittedModel]) -> list[dict[str, FittedModel]]:
    """The models that act on each dataset; says which are left out.

    Raises:
        InputError: a model that acts on none.
    """
    fitting = [dict(models) for _ in datasets]
    for name, model in models.items():
        left_out = {}
        for dataset, own in zip(datasets, fitting, strict=True):
            try:
                model.residual(dataset.simulator)
            except InputError as error:
                left_out[dataset.name] = error
                own.pop(name)
        if len(left_out) == len(datasets):
            raise next(iter(left_out.values()))
        for where, reason in left_out.items():
            typer.echo(f"left out on {where}: {reason}", err=True)
    return fitting


def _named_models(runs: list[Path]) -> dict[str, FittedModel]:
    """Models by method; by method and folder where a method occurs twice."""
    models = [load_model(run) for run in runs]
    methods = [model.method for model in models]
    return {
        model.method if methods.count(model.method) == 1 else f"{model.method} ({run.name})": model
        for run, model in zip(runs, models, strict=True)
    }
